"""The documentation site's own parts: what looks through it, and the pages that are made from the code."""

from __future__ import annotations

import importlib
import json
import re
import sys
from dataclasses import fields
from pathlib import Path

import pytest
from doc_pages import Page, complaint, parses

import tauext
from tauext.cli.commands import all_commands

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
sys.path[:0] = [str(DOCS), str(DOCS / "_extensions")]
(
    check_site,
    cli_pages,
    cpp_pages,
    python_page,
    root_pages,
    rst_text,
    made_pages,
    fill,
    paper_tables,
    conf,
    file_tables,
) = (
    importlib.import_module(name)
    for name in (
        "check_site",
        "cli_pages",
        "cpp_pages",
        "python_page",
        "root_pages",
        "rst_text",
        "made_pages",
        "fill",
        "paper_tables",
        "conf",
        "file_tables",
    )
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
def test_what_is_broken_or_loaded_from_elsewhere_is_reported(tmp_path, added, told):
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


def test_every_group_of_the_front_door_has_a_page_and_every_name_a_row_of_the_index():
    found = python_page.groups()
    index = "\n".join(python_page.index(found))
    contents = re.findall(r"^made/python/(\w+)$", index, re.MULTILINE)
    assert contents == [heading.lower() for heading in found]
    assert re.findall(r"^\| \{py:obj\}`~tauext\.(\w+)` \| \S", index, re.MULTILINE) == sum(found.values(), [])
    for heading, names in found.items():
        page = "\n".join(python_page.page(heading, names))
        assert re.findall(r"^## (\w+)$", page, re.MULTILINE) == names
        assert re.findall(r"^\.\. auto\w+:: tauext\.(\w+)$", page, re.MULTILINE) == names


def test_a_row_of_the_index_is_the_first_sentence():
    assert python_page.first_sentence("load_recording").endswith("`path`")
    assert "." not in python_page.first_sentence("Bundle") and "\n" not in python_page.first_sentence("Monitor")


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


RESULTS = {
    "steps": 186500,
    "counts": [471, 500, 0],
    "bundles": [{"name": "a", "l1_nm": [0.314, -0.126]}, {"name": "b", "l1_nm": [0.628, None]}],
}


@pytest.fixture
def results(tmp_path):
    (tmp_path / "r.json").write_text(json.dumps(RESULTS))
    return tmp_path


@pytest.mark.parametrize(
    ("source", "shown"),
    [
        ("steps", "186500"),
        ("steps|,d", "186,500"),
        (r"counts\|.1f\| of ", "471.0 of 500.0 of 0.0"),
        ("bundles[name=a].l1_nm|.2f|/", "0.31/−0.13"),
        ("bundles[1].l1_nm[0]|.1%", "62.8%"),
    ],
)
def test_a_number_is_read_from_its_results_file(results, source, shown):
    stale = f"It has 1,0.2/−3%<!-- r.json#{source} --> (<!-- r.json#steps -->) <!-- no source -->."
    new = f"It has {shown}<!-- r.json#{source} --> (186500<!-- r.json#steps -->) <!-- no source -->."
    assert fill.filled(stale, results) == new


@pytest.mark.parametrize(
    ("source", "problem"),
    [
        ("gone.json#steps", "gone.json cannot be read"),
        ("r.json#gone", "'gone' in 'gone' does not select one value"),
        ("r.json#bundles[name=c].l1_nm[0]", r"'\[name=c\]'"),
        ("r.json#bundles[2]", r"'\[2\]'"),
        ("r.json#bundles[0", r"cannot parse '\[0'"),
        ("r.json#bundles[0].name", "'a' is not a number"),
        ("r.json#bundles[1].l1_nm|.2f|/", "None is not a number"),
        ("r.json#bundles[0].l1_nm|.2f", r"is not a number"),
        ("r.json#steps|.2f|/", "is no list"),
        ("r.json#steps|x.y", "format 'x.y' does not fit"),
    ],
)
def test_a_number_without_its_source_is_refused(results, source, problem):
    with pytest.raises(fill.FillError, match=problem):
        fill.filled(f"1<!-- {source} -->", results)


def test_tables_and_code_below_their_comments_are_replaced():
    assert "| Old |" not in (page := fill.filled("<!-- table: delays -->\n| Old |\n| x |\n\nText | with a bar\n"))
    assert page.endswith("|\n\nText | with a bar\n") and page.count("\n| exact | 100 epochs | 0,\u00a0−5,\u00a03,") == 1
    comment = "<!-- code: examples/04_plugin/my_log.py | def open_log | def find_clipped -->\n"
    rest = "\n```text\nkept\n```\n"
    page = fill.filled(f"{comment}```python\nold\n```\n{rest}")
    assert page.startswith(f"{comment}```python\ndef open_log(") and "\ndef find_clipped" not in page
    assert page.endswith(f"\n```\n{rest}") and fill.filled(page) == page == fill.filled(comment) + rest
    for wrong in ("table: gone", "code: README.md | gone", "code: examples/04_plugin/my_log.py | def open_log | gone"):
        with pytest.raises(fill.FillError, match="gone"):
            fill.filled(f"<!-- {wrong} -->\n")


@pytest.mark.parametrize("page", fill.pages(), ids=lambda page: page.name)
def test_numbers_tables_and_code_of_a_page_are_those_of_their_sources(page):
    assert fill.filled(page.read_text()) == page.read_text(), "run make lint"


def test_table_1_has_the_mean_of_the_seeds_and_the_papers_errors():
    seeds = [{"case": "none", "l1": [k, 0.5], "l2": [1, 1], "mse": [2, 2]} for k in (0.25, 0.5, 0.75)]
    free = {"l1_nm": [0.125, 0.25], "l2_nm": [1, 1], "mse_nm2": [1, 1]}
    dense = {"bundles": [{"case": "none", "recipe": recipe, "free_motion": free} for recipe in ("dense", "prior")]}
    rows = paper_tables.table_1(seeds, seeds[:1], dense)[2:]
    assert [row.split(" | ")[1] for row in rows] == ["100 epochs, 3 seeds", "500 epochs, 1 seed", "`dense`"]
    assert "| 0.500/0.500 (0.250/0.500 to 0.750/0.500) | 0.409/0.259 | 1.000/1.000 | 0.683/0.376 |" in rows[0]
    assert "| 0.250/0.500 | 0.409/0.259 |" in rows[1] and "| 0.125/0.250 | 0.409/0.259 |" in rows[2]


def test_the_table_of_results_has_every_object_and_key_of_a_kept_file():
    rows = dict(re.findall(r"^\| (.*?)(?:: .*)? \| (.*) \|$", "\n".join(file_tables.results_keys()[2:]), re.MULTILINE))
    keys = {place: set(re.findall(r"`(\w+)`", text)) for named, text in rows.items() for place in named.split(", ")}

    seen = set()

    def check(content: object, place: str) -> None:
        if isinstance(content, list):
            for one in content[:3]:
                check(one, f"{place}[]")
        elif isinstance(content, dict):
            named = f"`{place}`" if place else "the file"
            if named in keys:
                seen.add(named)
                assert set(content) <= keys[named], place
            for key, inner in content.items():
                check(inner, f"{place}.{key}".lstrip(".") if named in keys else f"{place}{{}}")

    check(json.loads((DOCS / "results" / "full" / "results.json").read_text()), "")
    assert len(seen) > 15 and {"`bundles[].events.moving`", "`others[].events`"} <= set(keys)


def test_the_table_of_estimates_has_every_quantity_with_its_meaning():
    rows = dict(
        re.findall(r"^\| `(\w+?)(?:_<joint>)?` \| \w+ \| (.*) \|$", "\n".join(file_tables.estimates_columns()), re.M)
    )
    assert set(rows) == {one.name for one in fields(tauext.Estimates)} - {"joints", "t_ns"} and all(rows.values())
    assert "256 encoder still" in rows["causes"]


def test_delays_of_joint_one_leave_out_collisions_that_it_does_not_show():
    collisions = [
        {"id": str(k), "joint_delays_against_sensor_s": delays_s}
        for k, delays_s in enumerate([[0.010, 0.020], [-0.010, None], [None, -0.010]])
    ]
    bundle = {"case": "exact", "recipe": "paper", "collisions": collisions}
    results = {"bundles": [bundle], "ten_collisions": ["0", "2"]}
    (row,) = paper_tables.delays({"100 epochs": results})[2:]
    assert row == "| exact | 100 epochs | 10 | 10.0 | 2 of 3 | 0.0 | −9\u00a0to\u00a09 | 10 |"


@pytest.mark.parametrize("page", fill.pages(), ids=lambda page: page.name)
def test_a_page_has_nothing_that_only_sphinx_reads(page):
    assert re.findall(r"\{[\w:]+\}`.*|^(?:```|:::)\{.*|^\([\w-]+\)=$", page.read_text(), re.MULTILINE) == []


def test_terms_of_the_glossary_and_their_names_in_code_are_entries_of_the_search():
    page = (DOCS / "words.md").read_text()
    entry = r"\{index\}`!([^`]+)`"
    entries = set(re.findall(entry, conf.searchable(page)))
    rows = re.findall(r"^\| ([a-z][^|]*) \|", page, re.MULTILINE)
    assert {term for row in rows if row != "term" for term in row.split(", ")} <= entries
    assert {"limit", "suspect", "bundle", "flight", "source", "evidence class", "blind"} <= entries
    assert re.sub(entry, r"\1", conf.searchable(page)).split() == page.split()


def test_every_page_is_in_the_contents():
    entries = [
        (name, entry) for name, menu in conf.CONTENTS.items() for part in menu.values() for entry in part.split()
    ]
    listed = {found.resolve() for name, entry in entries for found in (DOCS / name).parent.glob(f"{entry}.md")}
    for page in DOCS.rglob("*.md"):
        name = page.relative_to(DOCS).with_suffix("").as_posix()
        if not name.startswith("reference/made/") and name != "index":
            assert page.resolve() in listed, name


PAGES = sorted(p.relative_to(DOCS).as_posix() for p in DOCS.rglob("*.md") if "made" not in p.parts)


@pytest.mark.parametrize("page", ["../README.md", *PAGES])
def test_every_command_on_a_page_is_one_that_the_command_line_accepts(page, monkeypatch, capsys):
    for command in Page(page).commands():
        if page.startswith("results/") and command[0] not in all_commands():
            continue  # an option of a benchmark, such as --only tauext paper
        assert command == ["--version"] or parses(command, monkeypatch), f"{command}: {capsys.readouterr().err}"


@pytest.mark.parametrize("page", ["../README.md", *PAGES])
def test_every_command_within_a_sentence_is_one_that_the_command_line_accepts(page):
    """It may leave out what it needs, and no more: no option that does not exist, no path without its option."""
    if page != "reference/cli.md":  # `tauext COMMAND --help`
        assert [found for command in Page(page).mentioned() if (found := complaint(command))] == []
