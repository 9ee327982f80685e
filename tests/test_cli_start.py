"""What the command line loads before it answers: help and `show` shall not wait for what they do not use."""

import os
import subprocess
import sys

import tyro
from made_bundles import watching_bundle, with_error_scale

from tauext.cli.parsing import quicken, without_own_source, without_typeguard

LOADED = (
    "import atexit, sys; atexit.register(lambda: print(*sys.modules, file=sys.stderr)); from tauext.cli import main; "
)


def modules_after(*arguments):
    """Names of all that was loaded when the command ended."""
    code = f"{LOADED}sys.argv = ['tauext', *{list(arguments)!r}]; main()"
    settings = {name: value for name, value in os.environ.items() if name != "TAUEXT_SIMD"}  # it asks for the core
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=settings)
    return set(ended.stderr.split())


def test_help_loads_the_parser_and_little_else():
    loaded = modules_after("--help")
    assert {"tyro", "tauext.cli.show"} <= loaded
    assert not loaded & {"numpy", "pyarrow", "typeguard", "asyncio", "importlib.metadata", "tauext._core"}


def test_show_describes_a_bundle_without_numpy_and_the_library_of_recordings(tmp_path):
    bundle = with_error_scale(watching_bundle())
    bundle.after_contact_factor = 2.0
    bundle.save(str(tmp_path / "arm.tauext"))
    loaded = modules_after("show", str(tmp_path / "arm.tauext"))
    assert "tauext.bundle.units" in loaded
    assert not loaded & {"numpy", "tauext.data", "pyarrow", "typeguard"}


def test_the_shorter_ways_answer_as_the_long_ones():
    def no_typeguard(kind, value):
        raise AssertionError("the long way")

    short = without_typeguard(no_typeguard)
    assert short(list[int], tyro.MISSING) and short(str | None, None) and short(tuple[int, ...], ())
    for kind, value in ((int, "word"), (int, ()), (tuple[int, str], ()), (int, None)):
        assert without_typeguard(lambda kind, value: False)(kind, value) is False
    docstring = without_own_source(lambda owner, *about: f"{owner.__name__} {about}")
    assert docstring(dict, "key", ()) == "dict ('key', ())"
    assert docstring(type(tyro.MISSING), "key", ()) is None


def test_they_are_put_in_place_once():
    quicken()
    from tyro import _docstrings, _resolver

    before = _resolver.is_instance, _docstrings.get_field_docstring
    quicken()
    assert before == (_resolver.is_instance, _docstrings.get_field_docstring)
    assert _resolver.is_instance.__wrapped__ is not None
