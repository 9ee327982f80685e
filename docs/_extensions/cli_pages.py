"""A page for every verb of the command line, made from what `tauext VERB --help` prints."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from typing import Any

from made_pages import prose, write_page

from tauext.cli.commands import all_commands

BORDER = "─━-"
HELP_INDENT = 6
"""Help of an option is indented by at least so much, the option itself by one."""


def help_text(*verb: str, option: str = "--help") -> str:
    """What the verb's help prints, in one column, without colours."""
    environment = os.environ | {"COLUMNS": "82", "NO_COLOR": "1", "PYTHONIOENCODING": "utf-8"}
    command = [sys.executable, "-m", "tauext", *verb, option]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, encoding="utf-8")
    return done.stdout


def verbs() -> list[str]:
    """The commands in the order in which the help names them; those of a group with its name before them."""
    return [
        f"{name} {one}".strip()
        for name, command in all_commands().items()
        for one in (command.commands or {"": command})
    ]


def boxes(text: str) -> tuple[str, list[tuple[str, list[str]]]]:
    """The text before the options, and each group's title and lines: a box without its frame."""
    head: list[str] = []
    found: list[tuple[str, list[str]]] = []
    inside = False
    for line in text.splitlines():
        if line.startswith("╭"):
            found.append((line.strip("╭╮─ "), []))
            inside = True
        elif line.startswith("╰"):
            inside = False
        elif inside:
            found[-1][1].append(line.strip().strip("│").rstrip())
        elif not found:
            head.append(line)
    return "\n".join(head), found


def entries(lines: list[str]) -> tuple[str, list[tuple[str, str]]]:
    """The introduction of a box, and its options with their help."""
    introduction: list[str] = []
    options: list[tuple[str, list[str]]] = []
    for line in lines:
        words, indent = line.strip(), len(line) - len(line.lstrip())
        if not words.strip(BORDER):
            continue
        if indent >= HELP_INDENT and options:
            options[-1][1].append(words)
        elif words.startswith("-") or (not introduction and re.match(r"[\[{A-Z]", words) and "  " in words):
            option, _, told = words.partition("  ")  # the two stand side by side where there is room
            options.append((option, [told.strip()] if told.strip() else []))
        elif options and not options[-1][1]:
            option = options[-1][0]
            options[-1] = (option + ("" if option.endswith((",", "{", "|")) else " ") + words, [])
        else:
            introduction.append(words)
    return " ".join(introduction), [(option, " ".join(told)) for option, told in options]


def page(verb: str) -> list[str]:
    """The Markdown of one verb."""
    head, found = boxes(help_text(*verb.split()))
    usage, _, about = head.partition("\n\n")
    lines = [f"# tauext {verb}", "", "```text", usage.removeprefix("usage: ").strip(), "```", ""]
    lines += [prose(" ".join(part.split())) + "\n" for part in about.strip().split("\n\n") if part.strip()]
    lines += ["```{program} tauext " + verb, "```", ""]
    for title, box in found:
        introduction, options = entries(box)
        lines += [f"## {title[:1].upper()}{title[1:]}", "", prose(introduction), ""]
        for option, told in options:
            lines += [f"````{{option}} {option}", prose(told), "````", ""]
    if verb == "train":
        lines += ["## Keys of --config", "", "```toml", help_text(verb, option="--help-config").rstrip(), "```", ""]
    return lines


def first_sentence(lines: list[str]) -> str:
    """What a verb's page says first, below its usage."""
    told = lines[lines.index("```", 3) + 2]
    return told.strip().replace("|", "\\|")


def write_pages(app: Any) -> None:
    """All of them, and their index."""
    index = ["| verb | what it does |", "|---|---|"]
    for verb in verbs():
        lines = page(verb)
        name = verb.replace(" ", "-")
        write_page(f"cli/{name}.md", lines)
        index.append(f"| [{verb}](made/cli/{name}.md) | {first_sentence(lines)} |")
    write_page("cli.inc", index)


def setup(app: Any) -> dict[str, bool]:
    app.connect("builder-inited", write_pages)
    return {"parallel_read_safe": True}
