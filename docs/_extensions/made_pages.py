"""Pages that are made from the code while the site is built; they stand in docs/reference/made, which git ignores."""

from __future__ import annotations

import re
from pathlib import Path

MADE = Path(__file__).parent.parent / "reference" / "made"
SPECIAL = re.compile(r"([\\*_\[\]<>|#$~])")


def write_page(name: str, lines: list[str]) -> None:
    """Write one page, NAME.md, or a part of one that another page includes, NAME.inc.

    What does not differ from what is there is left as it is, so that it is not built again.
    """
    text = "\n".join(lines) + "\n"
    path = MADE / name
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_text() != text:
        path.write_text(text)


def prose(text: str) -> str:
    """Plain text as Markdown: what has a meaning there is escaped, but for `code`."""
    pieces = text.split("`")
    if len(pieces) % 2 == 0:  # a backtick on its own
        return SPECIAL.sub(r"\\\1", text).replace("`", "\\`")
    return "`".join(piece if k % 2 else SPECIAL.sub(r"\\\1", piece) for k, piece in enumerate(pieces))
