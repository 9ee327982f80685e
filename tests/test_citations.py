"""Every work that a comment cites is in docs/references.md, and every work in there is cited."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
KEY = re.compile(r"\[([A-Z][A-Za-z]+[12]\d{3}[a-z]?)\]")


def test_every_cited_work_is_listed_and_every_listed_work_is_cited():
    text = "".join(page.read_text() for page in sorted((ROOT / "docs" / "method").glob("*.md")))
    references = (ROOT / "docs" / "references.md").read_text()
    listed = re.findall(r"^- \*\*\[(\w+)\]\*\*", references, re.MULTILINE)
    files = [f for folder in ("src", "cpp") for f in (ROOT / folder).rglob("*") if f.suffix in (".py", ".hpp", ".cpp")]
    cited = set(KEY.findall(text)).union(*(KEY.findall(file.read_text()) for file in files))
    assert listed == sorted(set(listed)) and len(files) > 200
    assert cited == set(listed)
