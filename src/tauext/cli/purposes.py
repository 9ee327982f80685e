"""Help of a command with many options by what they are for: the common ones first, the others when asked for."""

from __future__ import annotations

import os
import re
import shutil
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass
from io import BytesIO, TextIOWrapper

from tyro.extras import SubcommandApp

from tauext.cli.parsing import HELP_INDENT

HELP, HELP_ALL = ("-h", "--help"), "--help-all"
NO_DEFAULT = re.compile(r" \(default: (None)?\)")
"""The words before it say what holds where an option is left out."""
COLUMNS = "100"
"""For the parser, which puts its boxes side by side on a wider terminal, and not one under the other."""
MOST_COLUMNS = 100
INDENT = 6
FRAME = "│"


@dataclass(frozen=True)
class Purpose:
    """A heading and the options under it; one that ends in a dot stands for a group of options."""

    title: str
    options: tuple[str, ...]
    rare: bool = False
    """Shown by --help-all alone."""


TRAIN = (
    Purpose("What it needs", ("--data", "--out")),
    Purpose(
        "What is trained",
        ("--case", "--robot", "--like", "--recipe", "--minutes", "--fit-torque-constants", "--torque-constants"),
    ),
    Purpose(
        "How many false alarms, and so how low the limits", ("--alarm.false-alarms", "--alarm.in-hours", "--limits")
    ),
    Purpose("When the look at the data refuses", ("--accept",)),
    Purpose("Time and machine", ("--max-steps", "--threads", "--backend", "--seed")),
    Purpose(
        "The network",
        ("--hidden", "--epochs", "--batch", "--learning-rate", "--targets", "--gate-margin"),
        rare=True,
    ),
    Purpose("The momentum observer and the rates of the chain", ("--observer.",), rare=True),
    Purpose("How an alarm follows from a joint over its limit", ("--error-scale", "--alarm."), rare=True),
    Purpose("What is left out around labelled contacts", ("--margins.",), rare=True),
    Purpose("What physics explains first (recipes tauext and prior)", ("--prior.",), rare=True),
    Purpose("How slow changes are followed (recipes tauext and prior)", ("--drift.",), rare=True),
    Purpose("What the monitor can be told that the arm carries", ("--load-frame",), rare=True),
    Purpose("What forces are worth", ("--torque-share",), rare=True),
    Purpose("Filters of the observer (recipes highpass and bandpass)", ("--filters.",), rare=True),
)
BY_PURPOSE: Mapping[str, Sequence[Purpose]] = {"train": TRAIN}
"""Commands whose help is arranged here; the others have few options."""


def arranged_help(app: SubcommandApp, prog: str, arguments: Sequence[str]) -> str | None:
    """The help that these words ask for, where it is one of those arranged here; else None."""
    verb = arguments[0] if arguments else ""
    asked = {*HELP, HELP_ALL} & set(arguments[1:])
    if verb not in BY_PURPOSE or not asked:
        return None
    said = TextIOWrapper(BytesIO(), encoding="utf-8")  # the parser frames its boxes for UTF-8 alone
    with columns_of_the_parser(), redirect_stdout(said), suppress(SystemExit):
        app.cli(prog=prog, args=[verb, "--help"])
    columns = min(shutil.get_terminal_size().columns, MOST_COLUMNS)
    said.seek(0)
    return arranged(said.read(), f"{prog} {verb}", BY_PURPOSE[verb], HELP_ALL in asked, columns)


@contextmanager
def columns_of_the_parser() -> Iterator[None]:
    """Help as on a terminal of COLUMNS."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = COLUMNS
    try:
        yield
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before


def arranged(text: str, command: str, purposes: Sequence[Purpose], everything: bool, columns: int) -> str:
    """The parser's help of one command by purpose.

    Args:
        text: what the parser printed.
        everything: the rare options are shown, too.
    """
    options = options_in(text)
    about = re.split(r"^╭", text.partition("\n\n")[2], maxsplit=1, flags=re.MULTILINE)[0].strip()
    lines = [f"usage: {command} --data DATA --out NAME.tauext [options]", ""]
    lines += [*wrapped(about, columns, ""), ""]
    left = {name: option for name, option in options.items() if name not in HELP}
    rare = 0
    for purpose in purposes:
        of_it = [name for name in left if any(belongs(name, option) for option in purpose.options)]
        chosen = {name: left.pop(name) for name in sorted(of_it, key=lambda name: rank(name, purpose))}
        if purpose.rare and not everything:
            rare += len(chosen)
            continue
        lines.append(f"{purpose.title}:")
        for head, words in chosen.values():
            lines += [*wrapped(head, columns, "  "), *wrapped(words, columns, " " * INDENT)]
        lines.append("")
    lines.append("Every option is shown." if everything else f"{rare} more that few ever change: {command} {HELP_ALL}")
    return "\n".join(lines)


def belongs(name: str, option: str) -> bool:
    return name.startswith(option) if option.endswith(".") else name == option


def rank(name: str, purpose: Purpose) -> int:
    """Place of an option under its heading."""
    return next(k for k, option in enumerate(purpose.options) if belongs(name, option))


def options_in(text: str) -> dict[str, tuple[str, str]]:
    """Options of the parser's help in its order, by their long names: the lines with their values, and their words."""
    found: list[list[str]] = []
    in_group = False
    for line in text.splitlines():
        inside = line.strip(FRAME).rstrip()
        if not line.startswith(FRAME):
            in_group = False
        elif inside.startswith(" -") and inside.strip(" -"):
            found.append([inside.strip(), ""])
            in_group = True
        elif in_group and inside.startswith(" " * (HELP_INDENT - 1)):
            found[-1][1] += f" {inside.strip()}"
        elif in_group and inside.strip(" ─-"):
            found[-1][0] += inside.strip()
    heads = [head.replace("{None}|", "").replace("{None,", "{") for head, _ in found]
    names = [next(word for word in head.replace(",", " ").split() if word.startswith("--")) for head in heads]
    return {
        name: (head, NO_DEFAULT.sub("", words).strip())
        for name, head, (_, words) in zip(names, heads, found, strict=True)
    }


def wrapped(text: str, columns: int, indent: str) -> list[str]:
    """Paragraphs of a text in lines of so many columns."""
    lines: list[str] = []
    for paragraph in re.split(r"\n\s*\n", text):
        lines += [""] if lines else []
        lines += textwrap.wrap(
            " ".join(paragraph.split()),
            columns,
            initial_indent=indent,
            subsequent_indent=indent,
            break_on_hyphens=False,
            break_long_words=False,
        )
    return lines
