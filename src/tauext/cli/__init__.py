"""The command line: one verb a stage. The module of a command is imported when the command is called."""

from __future__ import annotations

import _thread
import difflib
import functools
import os
import re
import sys
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import redirect_stderr, suppress
from io import StringIO, TextIOWrapper
from typing import Any

# The fits solve many small systems: more threads of the linear algebra only wait for each other. NumPy reads it once.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# MuJoCo draws nothing here. Its import would search for a window system in a subprocess, and lose a Ctrl-C.
os.environ.setdefault("MUJOCO_GL", "disable")

from tauext import plugins
from tauext.cli.commands import Command, all_commands, command_named, groups
from tauext.errors import ConfigError, FaultyDataError, TauextError

SUMMARY = "External joint torque and collision detection for robot arms, from encoders and motor torque alone."
NOTES = """\
Order of work: import (or simulate), check, train, then run or monitor; evaluate and report show how good a bundle is.
Existing output: bundles, results and reports are replaced, and named on stderr first; datasets and descriptions are
refused; event logs and recordings get another name.
After an interruption, run the same command again: at most 30 s of simulating, training a network, calibrating or
evaluating are lost. Files are always whole."""
HELP_CONFIG = """\
# Settings for `tauext train --config FILE.toml`: help, default and type of every key. A key without a default follows
# from the recipe or the recordings. `tauext calibrate --config` takes the table [alarm].
"""

READING = ("import", "check", "run", "show")
"""Commands that read files of others: they end before the system has no memory left."""
LONGEST_ERROR = 1500
"""Letters of an error: what a hostile file holds is quoted no further."""


def version_text() -> str:
    """Versions of the package, of its core and of the compiler that made it, its kernels; which bundles both read and
    write."""
    from importlib.metadata import version

    from tauext import _core
    from tauext.files.provenance import VERSION

    compiler = _core.COMPILER.partition(" (")[0]  # clang adds where its sources came from
    built = f"core {VERSION} by {compiler} with {_core.simd_in_use()}"
    return f"tauext {version('tauext')}, {built}, bundle format {_core.BUNDLE_FORMAT}"


def command_of(argv: Sequence[str]) -> tuple[str, Callable[..., Any]]:
    """The command that the arguments name, as it is typed, and its function, whose module is imported now.

    Raises:
        ConfigError: there is no such command, or a plug-in that adds it cannot be loaded.
    """
    prog = "tauext"
    within: Mapping[str, Command] | None = None
    for word in argv:
        found = command_named(word) if within is None else within.get(word)
        if found is None:
            added = plugins.how_to_add(word) if within is None else None
            raise ConfigError(added or unknown(word, all_commands() if within is None else within, prog))
        prog, within = f"{prog} {word}", found.commands
        if not within:
            return prog, found.load()
    raise ConfigError(f"a command is missing: {', '.join(within or all_commands())}; see `{prog} --help`")


def unknown(word: str, commands: Collection[str], prog: str) -> str:
    """The message about a word that is no command."""
    near = difflib.get_close_matches(word, commands, 1)
    meant = f"; did you mean '{near[0]}'?" if near else ""
    return f"there is no command '{word}'{meant}; see `{prog} --help`"


def overview(argv: Sequence[str]) -> str | None:
    """Help of all commands, of a group of commands or of --config; None: the arguments request none of these."""
    help_options = ("-h", "--help")
    if argv[:1] and argv[0] in help_options:
        lists = "\n\n".join(f"{title}:\n{listed(commands)}" for title, commands in groups().items())
        return (
            "usage: tauext COMMAND [OPTIONS]\n       tauext COMMAND --help\n       tauext --version\n\n"
            f"{SUMMARY}\n\n{lists}\n\n{NOTES}"
        )
    if argv[1:2] and argv[1] in help_options and (group := command_named(argv[0])) and group.commands:
        name, summary = argv[0], f"{group.help[:1].upper()}{group.help[1:]}."
        return f"usage: tauext {name} COMMAND [OPTIONS]\n\n{summary}\n\n{listed(group.commands)}"
    if argv[:1] == ["train"] and "--help-config" in argv:
        from tauext.config import TrainConfig
        from tauext.files.typed_table import settings_text

        return f"{HELP_CONFIG}\n{settings_text(TrainConfig)}"
    return None


def listed(commands: Mapping[str, Command]) -> str:
    return "\n".join(f"  {name:<11}{command.help}" for name, command in commands.items())


def understood(command: Callable[..., Any], prog: str, arguments: Sequence[str]) -> Callable[[], Any]:
    """The call that the arguments describe; `--help` prints and exits here.

    Raises:
        ConfigError: they are invalid.
    """
    import tyro

    from tauext.cli.arguments import TYPES

    arguments = given_once(arguments, options_with_lists(command))
    markers = (tyro.conf.DisallowNone, tyro.conf.FlagCreatePairsOff)  # no {None} and no --no-json in the help

    @functools.wraps(command)
    def later(*values: Any, **named: Any) -> Callable[[], Any]:
        return functools.partial(command, *values, **named)

    printed = StringIO()
    try:
        with redirect_stderr(printed):
            call: Callable[[], Any] = tyro.cli(later, prog=prog, args=list(arguments), config=markers, registry=TYPES)
    except SystemExit as stop:
        if not stop.code:
            raise
        names = (re.split("[:.=]", word.removeprefix("--"))[0] for word in arguments)
        missing = (plugins.how_to_add(name.replace("_", "-")) for name in names)  # its options are missing, too
        added = next(filter(None, missing), None)
        raise ConfigError(added or f"{in_one_line(printed.getvalue())}; see `{prog} --help`") from None
    sys.stderr.write(printed.getvalue())
    return call


def given_once(arguments: Sequence[str], lists: Collection[str]) -> list[str]:
    """The arguments with the values of a repeated option behind its first; the parser would use the last alone.

    Args:
        lists: names of the options that take any number of values.

    Raises:
        ConfigError: another option is given twice.
    """
    groups, names = [[]], [""]  # type: tuple[list[list[str]], list[str]]
    for word in arguments:
        name, equals, value = word.partition("=")
        if re.match(r"--?[A-Za-z]", name):
            name = name.lower().replace("_", "-")
            if name not in names:
                groups.append([word])
                names.append(name)
                continue
            if name.lstrip("-").rpartition(".")[2] not in lists:
                raise ConfigError(f"{name} is given twice; give it once")
            at = names.index(name)
            first, assigned, before = groups[at][0].partition("=")
            if assigned:
                groups[at][:1] = [first, before]
            groups.append(groups.pop(at))
            names.append(names.pop(at))
            groups[-1] += [value] if equals else []
        else:
            groups[-1].append(word)
    return [word for group in groups for word in group]


def options_with_lists(command: object) -> set[str]:
    """Names of the options that take any number of values, in a command or in a class of its options."""
    import typing

    names: set[str] = set()
    for name, hint in typing.get_type_hints(command).items() if command is not None else ():
        for kind in (hint, *typing.get_args(hint)):
            if typing.get_origin(kind) in (tuple, list) and (kind.__args__[-1] is ... or kind.__origin__ is list):
                names.add(name.replace("_", "-"))
            elif isinstance(kind, type) and getattr(kind, "__annotations__", None) and name != "return":
                names |= options_with_lists(kind)
    return names


def main(argv: list[str] | None = None) -> int:
    """Run one command and return its exit status.

    0 done, 1 a fault or failure in the data, 2 bad input (one line on stderr), 130 interrupted, 141 no reader.
    """
    argv = sys.argv[1:] if argv is None else argv
    # Range checks report an overflow; the interpreter's own warnings add nothing.
    warnings.filterwarnings("ignore", category=RuntimeWarning)
    sys.unraisablehook = not_swallowed
    try:
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, TextIOWrapper):
                stream.reconfigure(errors="backslashreplace")  # names of files may be any bytes
        if os.environ.get("TAUEXT_SIMD"):  # refused before hours of work; unset, the core need not be loaded
            from tauext import _core

            _core.simd_in_use()
        if argv == ["--version"]:
            print(version_text())
            return 0
        if (text := overview(argv)) is not None:
            print(text)
            flush()
            return 0
        prog, command = command_of(argv)
        call = understood(command, prog, argv[len(prog.split()) - 1 :])
        if argv[0] in READING:
            from tauext.files.preflight import within_memory

            with within_memory():
                status = call()
        else:
            status = call()
        flush()
    except FaultyDataError as error:
        print_error(f"tauext: error: {error}")  # several lines: findings in the data, and how to correct them
        return 2
    except TauextError as error:
        return refused(with_option(str(error), argv))
    except KeyboardInterrupt as stop:
        kept = str(stop) or "finished work is kept; the same command continues from there"
        print_error(f"tauext: interrupted; {kept}")
        return 130
    except BrokenPipeError:  # `tauext run --json | head`: the reader is gone
        forget(sys.stdout)
        return 141
    except OSError as error:
        forget(sys.stdout)
        return refused(f"{error.filename or 'output'}: cannot be read or written ({error.strerror or error})")
    except UnicodeError as error:
        return refused(f"a name or text is no UTF-8: {error}")
    except MemoryError as error:
        return refused(f"this needs more memory than there is; request less at a time ({str(error) or 'none is left'})")
    return status if isinstance(status, int) else 0


def with_option(message: str, argv: Sequence[str]) -> str:
    """`disk_gb = 0 must be ...` as `--disk-gb = 0 must be ...`, if this option was given."""
    name, equals, rest = message.partition(" = ")
    option = f"--{name.replace('_', '-')}"
    given = {word.partition("=")[0].replace("_", "-") for word in argv}
    return f"{option}{equals}{rest}" if equals and option in given else message


def not_swallowed(lost: sys.UnraisableHookArgs) -> None:
    """A Ctrl-C that came within a destructor, where Python would print it and go on, comes again."""
    if issubclass(lost.exc_type, KeyboardInterrupt):
        _thread.interrupt_main()
    else:
        sys.__unraisablehook__(lost)


def refused(why: str) -> int:
    """Print the reason of a failure in one line, and return the exit status."""
    from tauext.progress import in_plain_letters

    line = in_plain_letters(" ".join(why.split()))
    print_error(f"tauext: error: {line if len(line) <= LONGEST_ERROR else f'{line[:LONGEST_ERROR]} ...'}")
    return 2


def print_error(line: str) -> None:
    """Print a line on stderr, which may be full or closed."""
    try:
        print(line, file=sys.stderr, flush=True)
    except OSError:
        forget(sys.stderr)


def flush() -> None:
    """Raise OSError here if stdout cannot be written, rather than at the interpreter's exit."""
    if sys.stdout is not None:
        sys.stdout.flush()


def forget(stream: Any) -> None:
    """Discard the stream's buffer, so that the interpreter does not try to write it again at exit."""
    with suppress(OSError, AttributeError, ValueError):  # none, closed or a test's own
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


# --- Messages of the parser of options, in one line and without the names of its types.

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
        elif len(inside) - len(inside.lstrip()) < 8:  # the box indents options by fewer blanks than their help
            sections[-1].append(inside.strip())
    messages = [" ".join(section) for section in sections if section and not section[0].startswith(LEFT_OUT)]
    return "; ".join(map(in_plain_words, messages)) or "the options are invalid"


def in_plain_words(message: str) -> str:
    """The message in plain words; as it is where none of PLAIN matches."""
    for pattern, words in PLAIN:
        if found := re.fullmatch(pattern, message):
            return words(found)
    return message
