"""Commands and code blocks of a documentation page, as a reader copies them."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

from tauext.cli import command_of, main, overview, understood
from tauext.errors import ConfigError

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

    def mentioned(self, program: str = "tauext") -> list[list[str]]:
        """Words of each command within a sentence, `tauext train --like`, which may leave out what it needs."""
        found = re.findall(rf"(?<!`)`{re.escape(program)}\s+([^`]+)`", self.text)
        return [shlex.split(words.replace("...", "")) for words in found]

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


def complaint(command: list[str]) -> str:
    """What the command line's own parser finds wrong with a command that may lack arguments; empty: nothing."""
    if command == ["--version"] or overview(command):
        return ""
    try:
        prog, called = command_of(command)
        understood(called, prog, command[len(prog.split()) - 1 :])
    except ConfigError as error:
        found = str(error).rpartition("; see `")[0]
        return (
            ""
            if re.fullmatch(r"(missing: [^;]*|a command is missing: [^;]*|--\S+ needs a value)", found)
            else str(error)
        )
    return ""
