"""Messages of the parser of options, in one line and without the names of its types."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

INDENT = 8
"""The parser's box indents the help of an option by so many blanks, and the option by fewer."""
LEFT_OUT = ("Argument helptext", "For full helptext", "Got errors", "Invalid choice")
"""Beginnings of the box's sections that the line leaves out."""
NO_TYPE = r"Error parsing (\S+): no type matching"


def choices(text: str) -> str:
    """The words of a tuple, without None, which no user types."""
    return ", ".join(word for word in re.findall(r"'([^']*)'", text) if word != "None")


def values(text: str) -> str:
    return text.replace(",", "")


PLAIN: Sequence[tuple[str, Callable[[re.Match[str]], str]]] = (
    (NO_TYPE + r" FLOAT could .* from \[(.*)\]\.?", lambda m: f"{m[1]} takes a number, not {m[2]}"),
    (NO_TYPE + r" INT could .* from \[(.*)\]\.?", lambda m: f"{m[1]} takes a whole number, not {m[2]}"),
    (
        NO_TYPE + r" \{?([A-Z][A-Z ]*)\}? could .* from \[(.*)\]\.?",
        lambda m: f"{m[1]} takes {len(m[2].split())} numbers, not {values(m[3])}",
    ),
    (
        r"Error parsing (\S+): could not convert string to float: (.*)",
        lambda m: f"{m[1]} takes a number, not {m[2]}",
    ),
    (r"Error parsing (\S+): invalid literal for int.*: (.*)", lambda m: f"{m[1]} takes a whole number, not {m[2]}"),
    (r"Error parsing (\S+): Could not find valid parse .*\[(.*)\]", lambda m: f"{m[1]} cannot take {values(m[2])}"),
    (r"Error parsing (\S+): (.*)", lambda m: f"{m[1]}: {m[2]}"),
    (r"Missing value for argument '(\S+)'.*", lambda m: f"{m[1]} needs a value"),
    (
        r"invalid choice (.*) for argument '(\S+)'\. Expected one of \((.*)\)\.",
        lambda m: f"{m[2]} takes one of {choices(m[3])}; not {m[1]}",
    ),
    (r"Missing from tauext[\w ]*: (.*)", lambda m: f"missing: {m[1]}"),
)
"""The parser's messages, and the same in plain words; the first that matches."""


def in_one_line(box: str) -> str:
    """The content of a box of the parser, without its frame, help texts and advice."""
    sections: list[list[str]] = [[]]
    for line in box.splitlines():
        inside = line.strip("│|")
        if not inside.strip(" ─-") or line.startswith(("╭", "╰", "+")):
            sections.append([])
        elif len(inside) - len(inside.lstrip()) < INDENT:
            sections[-1].append(inside.strip())
    messages = [" ".join(section) for section in sections if section and not section[0].startswith(LEFT_OUT)]
    return "; ".join(map(in_plain_words, messages)) or "the options are invalid"


def in_plain_words(message: str) -> str:
    """The message in plain words; as it is where none of PLAIN matches."""
    for pattern, words in PLAIN:
        if found := re.fullmatch(pattern, message):
            return words(found)
    return message
