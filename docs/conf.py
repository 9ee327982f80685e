"""Settings of the documentation site: `make docs` builds it, with warnings as errors."""

import re
import shutil
import sys
from importlib.metadata import version as version_of
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_extensions"))

project = "tauext"
author = "The tauext developers"
copyright = "the tauext developers"


def copy_reports(app, error):
    """The reports that are kept beside their results, for pages that link to them."""
    for report in sorted(Path(app.srcdir).glob("results/*/report.html")):
        if error is None and app.builder.name == "html":
            target = Path(app.outdir) / report.relative_to(app.srcdir)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(report, target)


CONTENTS = {
    "index": {
        "Start": "words install quickstarts/ur quickstarts/ros2 quickstarts/lerobot quickstarts/cpp your-robot",
        "Guides": "data training running loop commission loads contacts servo-arms fleets twin troubleshooting",
        "Paper": "paper results/mocca",
        "Method": "method/theory method/alarms method/training method/loads-and-forces references",
        "Results": "results/index",
        "Reference": "reference/cli reference/api reference/ros2 reference/files "
        "reference/files-bundle reference/files-results",
        "Project": "architecture reference/made/project/*",
    },
    "reference/cli": {
        "": "made/cli/*",
    },
    "reference/api": {
        "": "made/cpp/*",
    },
    "results/index": {
        "": "comparison bench real-arms servo-arms forces pressing loads false-alarms commission checks speed",
    },
}
"""Pages below a page, by the captions of the menu; pages of a folder are in the order of their names."""
INCLUDED = {"reference/cli": ["cli"], "reference/api": ["python", "cpp"]}
"""Indices in reference/made at the end of a page."""
TERM = re.compile(r"(?:^|(?<=, )|(?<=; ))([a-z][a-z-]*(?: [a-z-]+){0,3})(?=,|;| \(|$)")
"""One term of a cell of the glossary, such as `trained detector` and `model file`."""
HEADER = re.compile(r"\]\((?:\.\./)+cpp/include/tauext/(\w+)\.(hpp|h)\)")


def add_contents(app, name, source):
    """Adds what only Sphinx reads and no page shows in the repository.

    These are contents, the index of a reference that is made from the code, and links to the pages of headers in place
    of the headers.
    """
    for index in INCLUDED.get(name, []):
        source[0] += f"\n```{{include}} made/{index}.inc\n```\n"
    for caption, pages in CONTENTS.get(name, {}).items():
        lines = [":hidden:", ":glob:", f":caption: {caption}" if caption else "", "", *pages.split()]
        source[0] += "\n```{toctree}\n" + "\n".join(lines) + "\n```\n"
    if name == "words":
        source[0] = searchable(source[0])
    source[0] = HEADER.sub(lambda to: f"](/reference/made/cpp/{to[1] if to[2] == 'hpp' else 'c'}.md)", source[0])


def searchable(glossary):
    """The glossary with index entries for its terms and their names in code: the search lists the glossary first."""
    lines, columns = [], []
    for line in glossary.splitlines():
        cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)]
        if cells[1:2] == ["term"]:
            columns = [1, cells.index("in code")]
        elif line.startswith("| ") and columns:
            for column in columns:
                cells[column] = TERM.sub(r"{index}`!\1`", cells[column])
            line = " | ".join(cells).strip()
        lines.append(line)
    return "\n".join(lines)


def setup(app):
    app.connect("source-read", add_contents)
    app.connect("build-finished", copy_reports)


version = release = version_of("tauext")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "cli_pages",
    "python_page",
    "cpp_pages",
    "root_pages",
    "rst_text",
]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_extensions", "_static"]
nitpicky = True
# Only names of the front door have a page. Other packages' pages are on other hosts, other modules of ours have none.
nitpick_ignore_regex = [("py:.*", r"(?!tauext\.\w+$).*")]

myst_enable_extensions = ["deflist", "colon_fence", "attrs_inline", "attrs_block"]
myst_heading_anchors = 4
highlight_language = "none"  # blocks that are only indented: commands, equations, files

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "fully-qualified"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True

html_theme = "furo"
html_title = "tauext"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_show_copyright = False
html_copy_source = False
# Excerpts of found pages would be fetched, which a browser refuses from file://.
html_show_search_summary = False
# One family of fonts, which every system has: nothing is asked of another host.
html_theme_options = {"navigation_with_keys": True}
pygments_style = "friendly"
pygments_dark_style = "monokai"
