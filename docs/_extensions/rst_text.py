"""Docstrings for autodoc: `code` in backticks, sections Args and Raises, signatures of the C++ module."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

FIELD = re.compile(r"^    (\*{0,2}\w+):\s+(.*)$")
SECTIONS = {"Args:": "param", "Raises:": "raises"}
OF_AN_ARRAY = re.compile(r"(numpy\.ndarray)\[dtype=[^]]*\]")
"""The C++ module names layout and device of every array that it takes."""
OF_A_PROPERTY = re.compile(r"^\((?:self|arg)[^)]*\) -> (.+)$")


def escaped(line: str) -> str:
    """What means something to reStructuredText and nothing in plain text, escaped outside of code."""
    pieces = line.split("`")
    if len(pieces) % 2 == 0 or "``" in line:
        return line
    outside = [re.sub(r"([|*])|(?<=\w)(_)(?=\W|$)", r"\\\1\2", piece) for piece in pieces[::2]]
    inside = [f"``{piece}``" for piece in pieces[1::2]]
    pieces[::2], pieces[1::2] = outside, inside
    return "".join(pieces)


def with_fields(lines: list[str]) -> list[str]:
    """Args and Raises as fields; a line that is indented further goes on with the one before."""
    told: list[str] = []
    kind = ""
    for line in lines:
        if line in SECTIONS:
            kind = SECTIONS[line]
            told.append("")
        elif kind and (field := FIELD.match(line)):
            told.append(f":{kind} {field[1]}: {field[2]}")
        elif kind and line.startswith("    "):
            told.append(f"    {line.strip()}")
        else:
            kind = kind if not line.strip() else ""
            told.append(line)
    return told


OTHERS = re.compile(r"\w+\(\.\.\.\) raises CoreError for all other arguments")
"""Line that the C++ module adds to the signatures of its functions: it holds for all of them."""


def without_others(lines: list[str]) -> list[str]:
    return [line for line in lines if not OTHERS.fullmatch(line.strip())]


def type_of(obj: object) -> str:
    """Of a property of the C++ module, which has it before its docstring; empty of anything else."""
    shown = (getattr(obj.fget, "__doc__", None) or "").partition("\n")[0] if isinstance(obj, property) else ""
    typed = OF_A_PROPERTY.match(shown)
    return typed[1].replace("tauext._core.", "") if typed else ""


def plain(app: Any, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """The docstring as reStructuredText, in place."""
    kind = type_of(obj)
    lines[:] = without_others(lines)
    if kind and lines and not OF_A_PROPERTY.match(lines[0]):
        lines[0] = f"`{kind}`. {lines[0]}"
    elif kind:  # all that it says
        lines[:] = [f"`{kind}`"]
    lines[:] = with_fields([line if line.lstrip().startswith(".. ") else escaped(line) for line in lines])


def signature(
    app: Any, what: str, name: str, obj: object, options: object, shown: str | None, returned: str | None
) -> tuple[str | None, str | None] | None:
    """None for a dataclass, whose fields stand below with their defaults; core types by the names they have here."""
    if what == "class" and dataclasses.is_dataclass(obj):
        return "", None
    if not shown:
        return None
    named = [OF_AN_ARRAY.sub(r"\1", text or "").replace("tauext._core.", "tauext.") for text in (shown, returned)]
    return named[0], named[1] or None


def setup(app: Any) -> dict[str, bool]:
    app.connect("autodoc-process-docstring", plain)
    app.connect("autodoc-process-signature", signature)
    return {"parallel_read_safe": True}
