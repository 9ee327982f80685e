"""Updates numbers, tables and code of the pages from their sources: `make lint` runs it, and a test compares.

    python docs/fill.py

A comment names the source of the number before it, or of the table or code block below it:

    It detects 460<!-- results/comparison/results-exact.json#bundles[name=prior].latched.latched --> of 500.

    <!-- table: delays -->
    <!-- code: examples/04_plugin/my_arm.py | class MyArm | def open_arm -->

- A number is FILE#PATH, FILE#PATH|FORMAT or, of a list, FILE#PATH|FORMAT|SEPARATOR. FILE is a JSON file in docs/. PATH
  is keys separated by dots; in a list, [0] selects by index and [key=value] the one element whose key has this value.
  FORMAT is Python's: .2f, .0%, ,d. In a table write \\| for |.
- A table is one of `paper_tables.tables()` or `file_tables.tables()`.
- Code is from the first line that begins with one text to before the next that begins with another, or to the end.
"""

from __future__ import annotations

import json
import re
from functools import cache
from pathlib import Path
from typing import Any

import file_tables
import paper_tables

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
STEP = re.compile(r"\.?(?P<key>[^.\[\]]+)|\[(?P<index>\d+)\]|\[(?P<field>[^=\]]+)=(?P<wanted>[^\]]+)\]")
NUMBER = re.compile(r"(?:−?\d[\d.,/%−]*)?(<!-- ([^\s#>]+\.json#[^>]+?) -->)")
TABLE = re.compile(r"(<!-- table: (\S+) -->\n)(?:\|.*\n)*")
CODE = re.compile(r"(<!-- code: (\S+) \| (.+?)(?: \| (.+?))? -->\n)(?:```.*?^```\n)?", re.MULTILINE | re.DOTALL)
LANGUAGES = {".py": "python", ".toml": "toml"}


class FillError(ValueError):
    """A comment whose source does not exist, and why."""


def select(value: Any, path: str) -> Any:
    """The value at this path.

    Raises:
        FillError: the path is malformed, or selects nothing.
    """
    at = 0
    while at < len(path):
        step = STEP.match(path, at)
        if step is None:
            raise FillError(f"cannot parse '{path[at:]}' in '{path}'")
        try:
            if step["key"] is not None:
                value = value[step["key"]]
            elif step["index"] is not None:
                value = value[int(step["index"])]
            else:
                (value,) = (item for item in value if str(item[step["field"]]) == step["wanted"])
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise FillError(f"'{step[0]}' in '{path}' does not select one value") from error
        at = step.end()
    return value


def shown(value: Any, form: str) -> str:
    """A number in a format, with a minus sign in place of a hyphen."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise FillError(f"{value!r} is not a number")
    try:
        return format(value, form).replace("-", "−")
    except ValueError as error:
        raise FillError(f"format '{form}' does not fit {value!r}") from error


@cache
def load_json(path: Path) -> Any:
    """Raises FillError if there is no such file."""
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise FillError(f"{path} cannot be read ({error})") from error


def number(source: str, folder: Path = DOCS) -> str:
    """The number or numbers of a source.

    Raises:
        FillError: the source selects no number.
    """
    source, *options = source.replace(r"\|", "|").split("|", 2)
    name, _, path = source.partition("#")
    value, form = select(load_json(folder / name), path), options[0] if options else ""
    if len(options) < 2:
        return shown(value, form)
    if not isinstance(value, list):
        raise FillError(f"'{path}' is no list and takes no separator")
    return options[1].join(shown(item, form) for item in value)


def code(name: str, start: str, end: str | None) -> str:
    """A fenced block with the lines of a file of the repository from one that begins with `start` to before `end`."""
    lines = (ROOT / name).read_text().splitlines()
    first = next((k for k, line in enumerate(lines) if line.startswith(start)), None)
    if first is None:
        raise FillError(f"{name} has no line that begins with '{start}'")
    last = next((k for k in range(first + 1, len(lines)) if end and lines[k].startswith(end)), len(lines))
    if end and last == len(lines):
        raise FillError(f"{name} has no line after '{start}' that begins with '{end}'")
    return "\n".join([f"```{LANGUAGES[Path(name).suffix]}", "\n".join(lines[first:last]).strip(), "```", ""])


def table(name: str) -> str:
    """The lines of one of the made tables."""
    found = paper_tables.tables() | file_tables.tables()
    if name not in found:
        raise FillError(f"no table '{name}': {', '.join(found)}")
    return "".join(f"{line}\n" for line in found[name])


def filled(text: str, folder: Path = DOCS) -> str:
    """A page's text with the current numbers, tables and code that its comments name.

    Raises:
        FillError: a source does not exist.
    """
    text = NUMBER.sub(lambda found: number(found[2], folder) + found[1], text)
    text = TABLE.sub(lambda found: found[1] + table(found[2]), text)
    return CODE.sub(lambda found: found[1] + code(found[2], found[3], found[4]), text)


def pages() -> list[Path]:
    """All pages that are written by hand."""
    return [ROOT / "README.md", *(page for page in sorted(DOCS.rglob("*.md")) if "made" not in page.parts)]


def main() -> None:
    for page in pages():
        text = page.read_text()
        try:
            new = filled(text)
        except FillError as error:
            raise SystemExit(f"{page.relative_to(ROOT)}: {error}") from error
        if new != text:
            page.write_text(new)
            print(f"{page.relative_to(ROOT)}: updated")


if __name__ == "__main__":
    main()
