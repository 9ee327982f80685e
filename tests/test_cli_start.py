"""What the command line loads before it answers: help and `show` shall not wait for what they do not use."""

import os
import subprocess
import sys

from made_bundles import watching_bundle, with_error_scale

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
