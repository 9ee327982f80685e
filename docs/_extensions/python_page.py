"""The Python API: a page for each group of `help(tauext)`, and an index of all names."""

from __future__ import annotations

import inspect
import re
from typing import Any

from made_pages import prose, write_page
from rst_text import without_others

import tauext


def groups() -> dict[str, list[str]]:
    """The names by the headings of the package's docstring."""
    found: dict[str, list[str]] = {}
    known = set(tauext.__all__)
    told: set[str] = set()
    for heading, text in re.findall(r"^\*\*(\w+)\*\* (.*?)(?=^\*\*|^\s*$)", tauext.__doc__ or "", re.M | re.S):
        names = dict.fromkeys(name for name in re.findall(r"\w+", text) if name in known)
        found[heading] = [name for name in names if name not in told]  # a sentence may name it once more
        told |= set(names)
    missing = known - {"__version__"} - told
    if missing:
        raise ValueError(f"help(tauext) names no {', '.join(sorted(missing))}")
    return found


def directive(name: str) -> str:
    value = getattr(tauext, name)
    if inspect.isclass(value):
        return "autoexception" if issubclass(value, BaseException) else "autoclass"
    return "autofunction"


def members(name: str) -> list[str]:
    """The options of a class; its static functions of the C++ module, which autodoc takes for data, by their text."""
    of_core = [
        (member, value.__doc__ or "")
        for member, value in vars(getattr(tauext, name)).items()
        if type(value).__name__ == "nb_func" and not member.startswith("_")
    ]
    lines = ["   :members:", "   :undoc-members:"]
    if of_core:
        lines.append(f"   :exclude-members: {', '.join(member for member, _ in of_core)}")
    for _, text in of_core:
        shown, _, told = text.partition("\n")
        lines += ["", f"   .. py:staticmethod:: {shown.replace('tauext._core.', 'tauext.')}", ""]
        lines += [f"      {line.strip()}" for line in "\n".join(without_others(told.splitlines())).strip().splitlines()]
    return lines


def page(heading: str, names: list[str]) -> list[str]:
    """The Markdown of one group."""
    lines = [f"# {heading}", "", "A part of the [Python API](../../api.md): each name is `tauext.NAME`.", ""]
    for name in names:
        kind = directive(name)
        lines += [f"## {name}", "", "```{eval-rst}", f".. {kind}:: tauext.{name}"]
        lines += members(name) if kind == "autoclass" else []
        lines += ["```", ""]
    return lines


def first_sentence(name: str) -> str:
    """The first sentence of a name's docstring, without its full stop."""
    paragraph = (inspect.getdoc(getattr(tauext, name)) or "").partition("\n\n")[0]
    paragraph = "\n".join(without_others(paragraph.splitlines()))
    return prose(re.split(r"\.(?:\s|$)", " ".join(paragraph.split()), maxsplit=1)[0])


def index(found: dict[str, list[str]]) -> list[str]:
    """A table of all names for each group, and the contents, which lead to the groups' pages."""
    lines: list[str] = []
    for heading, names in found.items():
        lines += [f"## [{heading}](made/python/{heading.lower()}.md)", "", "| name | description |", "|---|---|"]
        lines += [f"| {{py:obj}}`~tauext.{name}` | {first_sentence(name)} |" for name in names]
        lines.append("")
    return [*lines, "```{toctree}", ":hidden:", "", *(f"made/python/{heading.lower()}" for heading in found), "```"]


def write(app: Any) -> None:
    found = groups()
    for heading, names in found.items():
        write_page(f"python/{heading.lower()}.md", page(heading, names))
    write_page("python.inc", index(found))


def setup(app: Any) -> dict[str, bool]:
    app.connect("builder-inited", write)
    return {"parallel_read_safe": True}
