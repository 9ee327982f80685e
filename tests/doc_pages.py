"""Commands and code blocks of a documentation page, as a reader copies them."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

from tauext.cli import main, understood

DOCS = Path(__file__).parent.parent / "docs"


class Page:
    """A page, or one section of it."""

    def __init__(self, name: str, section: str = ""):
        """section: title of a section of the second level; empty: the whole page."""
        text = (DOCS / name).read_text()
        if section:
            text = text.split(f"\n## {section}\n")[1].split("\n## ")[0]
        self.text = text

    def commands(self, program: str = "tauext") -> list[list[str]]:
        """Words of each printed command of a program, the program's name left out."""
        joined = re.sub(r"\\\n\s*", "", self.text)
        lines = re.findall(rf"^    (?:[^# \n][^#\n]* )?{re.escape(program)} (.*)$", joined, flags=re.MULTILINE)
        return [shlex.split(line, comments=True) for line in lines]

    def blocks(self, language: str) -> list[str]:
        """Contents of the fenced blocks of a language."""
        return re.findall(rf"^```{language}\n(.*?)^```$", self.text, flags=re.DOTALL | re.MULTILINE)


def parses(command: list[str], monkeypatch) -> bool:
    """Whether the command line's own parser accepts a command; the command does not run."""
    parsed = []

    def parse(*arguments):
        parsed.append(understood(*arguments))
        return lambda: 0

    with monkeypatch.context() as patch:
        patch.setattr("tauext.cli.understood", parse)
        return main(command) == 0 and len(parsed) == 1
