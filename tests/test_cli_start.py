"""What the command line loads before it answers: help and `show` shall not wait for what they do not use."""

import contextlib
import os
import re
import subprocess
import sys

import pytest
from made_bundles import watching_bundle, with_error_scale

from tauext.cli import given_once, main, options_with_lists, progress
from tauext.cli.commands import all_commands
from tauext.errors import ConfigError

LOADED = (
    "import atexit, sys; atexit.register(lambda: print(*sys.modules, file=sys.stderr)); from tauext.cli import main; "
)


def modules_after(*arguments):
    """Names of all that was loaded when the command ended."""
    code = f"{LOADED}sys.argv = ['tauext', *{list(arguments)!r}]; main()"
    settings = {name: value for name, value in os.environ.items() if name != "TAUEXT_SIMD"}  # it asks for the core
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=settings)
    return set(ended.stderr.split())


def test_help_of_all_commands_loads_none_of_them_and_no_parser():
    loaded = modules_after("--help")
    assert "tauext.cli" in loaded
    assert not loaded & {"tyro", "tauext.cli.show", "numpy", "pyarrow", "asyncio", "tauext._core"}


def test_help_of_one_command_loads_no_other_and_no_numpy():
    loaded = modules_after("show", "--help")
    assert {"tyro", "tauext.cli.show"} <= loaded
    assert not loaded & {"tauext.cli.train", "numpy", "pyarrow", "tauext._core"}


def test_show_describes_a_bundle_without_numpy_and_the_library_of_recordings(tmp_path):
    bundle = with_error_scale(watching_bundle())
    bundle.after_contact_factor = 2.0
    bundle.save(str(tmp_path / "arm.tauext"))
    loaded = modules_after("show", str(tmp_path / "arm.tauext"))
    assert "tauext.bundle.units" in loaded
    assert not loaded & {"numpy", "tauext.data.recording", "pyarrow"}


LISTS = {"accept", "torque-constants"}


@pytest.mark.parametrize(
    ("given", "read"),
    [
        ("b --accept A --out o --accept B C --json", "b --out o --accept A B C --json"),
        ("--accept=A --accept=B --json", "--accept A B --json"),
        ("--torque-constants 1 -2 --torque_constants 3", "--torque-constants 1 -2 3"),
        ("--from -3 --to 4", "--from -3 --to 4"),
    ],
)
def test_values_of_a_repeated_option_add_up(given, read):
    assert given_once(given.split(), LISTS) == read.split()


@pytest.mark.parametrize("given", ["--out a --out b", "--out a --out=a", "--json --json", "--in-hours 8 --in_hours 9"])
def test_an_option_with_one_value_is_refused_if_given_twice(given):
    with pytest.raises(ConfigError, match="is given twice"):
        given_once(given.split(), LISTS)


def commands(within, prefix=""):
    for name, one in within.items():
        yield from commands(one.commands, f"{prefix}{name} ") if one.commands else [(f"{prefix}{name}", one)]


@pytest.mark.parametrize("name", dict(commands(all_commands())))
def test_options_with_lists_are_those_that_the_help_shows_with_dots(name, capsys):
    lists = options_with_lists(dict(commands(all_commands()))[name].load())
    with pytest.raises(SystemExit):
        main([*name.split(), "--help"])
    shown = re.findall(r"--([a-z][\w.-]*) [^a-z\n]*\.\.\.", capsys.readouterr().out)
    assert {one.rpartition(".")[2] for one in shown} <= lists


OLD_WORDS = re.compile(
    r"(?<![-\w`.\[])(limits?|budgets?|promises?|suspect\w*|flights?|weigh(?:s|ed|ing)?|notic(?:e|es|ed)|unfamiliar|blind"
    r"|declared?|drift)(?![-\w`\]]| =)",
    re.IGNORECASE,
)
"""Words of the code that have a term of the field in docs/words.md; not options, keys, and names in backticks."""


def test_the_help_has_the_terms_of_the_glossary(capsys):
    assert [
        one.group() for one in OLD_WORDS.finditer("--limits [drift] `flight` # limits = 1: a budget, the drift")
    ] == [
        "budget",
        "drift",
    ]
    for name in ("", "train --help-config", *dict(commands(all_commands()))):
        with contextlib.suppress(SystemExit):
            main([*name.split(), *["--help"] * ("--help-config" not in name)])
        assert not OLD_WORDS.findall(capsys.readouterr().out), name


def test_a_resumed_bar_estimates_from_the_steps_of_this_run(monkeypatch, capsys):
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    bar = progress.ProgressBar("train")
    for done in (60_000, 61_000):  # a checkpoint's steps, then a thousand in 20 s
        bar.update(done, 100_000)
        now[0] += 20.0
    bar.update(62_000, 100_000)
    assert capsys.readouterr().err.splitlines()[-1].endswith("40 s, 760 s left")
