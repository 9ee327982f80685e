"""The documentation site's own parts: what looks through it, and the pages that are made from the code."""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path

import pytest

import tauext

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
sys.path[:0] = [str(DOCS), str(DOCS / "_extensions")]
check_site, cli_pages, cpp_pages, python_page, root_pages, rst_text, made_pages = (
    importlib.import_module(name)
    for name in ("check_site", "cli_pages", "cpp_pages", "python_page", "root_pages", "rst_text", "made_pages")
)

GOOD = '<a href="other.html#there">x</a><a href="#top">x</a><a href="https://example.org">x</a><img src="a.png">'
BOX = """usage: tauext made [-h] [OPTIONS]

Says what it does.

╭─ options ────────────────────────╮
│ -h, --help        show this      │
│ --rate-hz FLOAT                  │
│       Samples a second, *any*    │
│       rate. (default: 1.0)       │
│ --kind {one,two,three,           │
│ four}                            │
│       Which kind. (required)     │
╰──────────────────────────────────╯
"""


@pytest.mark.parametrize(
    ("added", "told"),
    [
        ("", []),
        ('<a href="gone.html">x</a>', ["index.html: gone.html is not there"]),
        ('<a href="other.html#gone">x</a>', ["index.html: other.html#gone has no such anchor"]),
        ('<img src="gone.png">', ["index.html: gone.png is not there"]),
        ('<script src="https://cdn.example.org/x.js"></script>', ["index.html: loads https://cdn.example.org/x.js"]),
        ('<link rel="stylesheet" href="//fonts.example.org/x">', ["index.html: loads //fonts.example.org/x"]),
        ('<link rel="canonical" href="https://example.org/">', []),
        ("<style></style>", []),
    ],
)
def test_what_is_broken_or_loaded_from_elsewhere_is_told(tmp_path, added, told):
    (tmp_path / "index.html").write_text(GOOD + added)
    (tmp_path / "other.html").write_text('<p id="there">')
    (tmp_path / "a.png").write_text("")
    (tmp_path / "site.css").write_text("a { background: url(a.png) }")
    found, outside = check_site.problems(tmp_path)
    assert found == told and outside == 1
    (tmp_path / "site.css").write_text("@import 'https://example.org/x.css';")
    assert check_site.problems(tmp_path)[0] == [*told, "site.css: loads https://example.org/x.css"]


def test_a_help_text_becomes_options_with_their_help():
    head, found = cli_pages.boxes(BOX)
    assert head.partition("\n\n")[2].strip() == "Says what it does." and [title for title, _ in found] == ["options"]
    assert [entry for _, lines in found for entry in cli_pages.entries(lines)[1]] == [
        ("-h, --help", "show this"),
        ("--rate-hz FLOAT", "Samples a second, *any* rate. (default: 1.0)"),
        ("--kind {one,two,three,four}", "Which kind. (required)"),
    ]
    assert made_pages.prose("a *b* of `c_*`") == r"a \*b\* of `c_*`"


def test_every_option_of_a_verb_is_on_its_page():
    assert {"train", "import", "monitor", "fleet run"} <= set(cli_pages.verbs())
    page = "\n".join(cli_pages.page("simulate"))
    options = set(re.findall(r"^│ {1,2}(--[\w.-]+)", cli_pages.help_text("simulate"), re.MULTILINE))
    assert len(options) > 5 and options <= set(re.findall(r"^````\{option\} (--[\w.-]+)", page, re.MULTILINE))


def test_every_name_of_the_front_door_is_in_one_group():
    names = [name for group in python_page.groups().values() for name in group]
    assert sorted([*names, "__version__"]) == sorted(tauext.__all__)


def test_docstrings_keep_their_sections_and_lose_no_sign():
    lines = ["|dq| of `q_*`, x_j.", "", "Args:", "    rate: how", "        often.", "Raises:", "    E: where."]
    rst_text.plain(None, "function", "f", None, None, lines)
    assert lines == [r"\|dq\| of ``q_*``, x_j.", "", "", ":param rate: how", "    often.", "", ":raises E: where."]


def test_pages_of_headers_show_every_public_name_and_nothing_private():
    page = "\n".join(cpp_pages.page(cpp_pages.HEADERS / "monitor.hpp"))
    assert "## Monitor" in page and "set_limit_factors(" in page and "}  // namespace" not in page
    assert "private:" not in page and "observe_;" not in page
    wrench = "\n".join(cpp_pages.page(cpp_pages.HEADERS / "wrench.hpp"))
    assert "```text\n  tau_ext = J^T w + e," in wrench
    bundle = "\n".join(cpp_pages.page(cpp_pages.HEADERS / "bundle.hpp"))
    for name in re.findall(
        r"^(?:struct|class|enum class) (\w+)[^;]*$", (cpp_pages.HEADERS / "bundle.hpp").read_text(), re.M
    ):
        assert f"## {name}" in bundle, name


def test_links_of_root_pages_lead_to_pages_of_the_site_or_nowhere():
    text = "[a](docs/words.md) [b](https://example.org) [c](LICENSE) [d](SECURITY.md#x) [e](CHANGELOG.md)"
    moved = "[a](../../../words.md) [b](https://example.org) c d [e](changelog.md)"
    assert root_pages.page(text, ("CHANGELOG",)) == moved


def test_every_page_is_in_the_contents():
    contents = "".join(page.read_text() for page in DOCS.rglob("*.md"))
    listed = "\n".join(re.findall(r"```\{toctree\}\n(.*?)```", contents, re.DOTALL)).splitlines()
    for page in DOCS.rglob("*.md"):
        name = page.relative_to(DOCS).with_suffix("").as_posix()
        if not name.startswith(("reference/made/", "results/real-arms/")) and name != "index":
            assert name in listed or f"../{name}" in listed, name
