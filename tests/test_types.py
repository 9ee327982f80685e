"""The stub of the C++ module names all of it, is installed, and lets a type checker tell right programs from wrong."""

import ast
import inspect
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

import tauext
from tauext import _core

SOURCES = Path(tauext.__file__).parent
WEAK = {"dict", "tuple", "list", "object", "Any", "NDArray", "typing.Any"}

RIGHT = """\
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tauext import Alarm, Bundle, Estimate, FlightRecorder, Health, Monitor, Recording, estimate_recording
from tauext import load_bundle, load_recording


def watch(folder: Path) -> list[Estimate]:
    bundle, recording = load_bundle(folder / "arm.tauext"), load_recording(folder / "motion.parquet")
    monitor = Monitor(bundle, own_rate=True)
    said: list[Estimate] = []
    for k in range(recording.samples):
        answer = monitor.step(int(recording.t_ns[k]), recording.q[k], recording.dq[k], recording.tau[k])
        if answer.health == Health.ok and answer.alarm is Alarm.collision:
            monitor.acknowledge()
        said.append(answer)
    return said


def all_at_once(bundle: Bundle, recording: Recording) -> NDArray[np.float64]:
    estimates = estimate_recording(bundle, recording)
    recorder = FlightRecorder(bundle.joints, bundle.observer.sample_period_ns)
    columns = Monitor(bundle).run(recording.t_ns, recording.q, recording.dq, recording.tau, recorder)
    flight = recorder.take()
    known = columns["tau_ext"] if flight is None else np.asarray(flight["tau_ext"])
    return np.asarray(known[estimates.healthy], dtype=np.float64)


def limits(bundle: Bundle) -> list[float]:
    bundle.sliding_limit_nm = [2.0 * limit for limit in bundle.sliding_limit_nm]
    return bundle.sliding_limit_nm + [bundle.hold_s]
"""
WRONG = """\
from tauext import Bundle, Estimate, Monitor, Recording, estimate_recording
from tauext import lod_bundle  # wrong


def watch(bundle: Bundle, recording: Recording) -> Estimate:
    name: int = bundle.name  # wrong
    bundle.joints = 7  # wrong
    bundle.sliding_limit_nm = 3.0  # wrong
    monitor = Monitor("arm.tauext")  # wrong
    monitor.step(0, recording.q[0], recording.dq[0])  # wrong
    estimate_recording(recording, bundle)  # wrong
    recording.quality  # wrong
    return monitor.run(recording.t_ns, recording.q, recording.dq, recording.tau)  # wrong
"""


def installed_stub() -> str:
    path = next(path for path in metadata.files("tauext") or () if str(path) == "tauext/_core.pyi")
    return Path(str(path.locate())).read_text()


def stub() -> ast.Module:
    return ast.parse(installed_stub())


def names_in(body: list[ast.stmt]) -> dict[str, ast.stmt]:
    found: dict[str, ast.stmt] = {}
    for node in body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            found[node.name] = node
        elif isinstance(node, ast.AnnAssign | ast.Assign):
            target = node.target if isinstance(node, ast.AnnAssign) else node.targets[0]
            assert isinstance(target, ast.Name)
            found[target.id] = node
    return found


def public(content: object) -> set[str]:
    return {name for name in vars(content) if not name.startswith("_")}


def test_the_stub_names_everything_that_is_public() -> None:
    named = names_in(stub().body)
    assert set(named) == public(_core) | {"__version__"}
    classes = {name: held for name, held in vars(_core).items() if inspect.isclass(held)}
    assert {"Bundle", "Monitor", "Estimate", "Tree", "Link", "FlightRecorder"} <= set(classes)
    for name, held in classes.items():
        node = named[name]
        assert isinstance(node, ast.ClassDef)
        assert {member for member in names_in(node.body) if not member.startswith("_")} == public(held), name


def test_what_is_returned_has_a_type_that_says_something() -> None:
    functions = [node for node in ast.walk(stub()) if isinstance(node, ast.FunctionDef)]
    assert len(functions) > 100
    for node in functions:
        assert node.returns is not None, node.name
        assert WEAK.isdisjoint(part.strip() for part in ast.unparse(node.returns).split("|")), node.name


def test_stub_and_marker_are_installed() -> None:
    installed = {str(path) for path in metadata.files("tauext") or ()}
    assert "tauext/_core.pyi" in installed
    assert "tauext/py.typed" in installed or (SOURCES / "py.typed").is_file()  # editable: it stays with the sources


needs_stub_beside_sources = pytest.mark.skipif(
    not (SOURCES / "_core.pyi").is_file(), reason="the sources are read-only, so set-up put no stub beside them"
)


@needs_stub_beside_sources
def test_the_stub_beside_the_sources_is_the_installed_one() -> None:
    assert installed_stub() == (SOURCES / "_core.pyi").read_text()


def test_pairs_are_tuples_as_the_stub_states() -> None:
    assert type(_core.lstm_activations(np.zeros(2, np.float32))) is tuple
    link = _core.Link()
    link.parent, link.mass, link.rotation = -1, 1.0, np.eye(3).ravel().tolist()
    momentum = _core.Tree([link], [0.0, 0.0, -9.81]).momentum(np.zeros((3, 1)), np.ones((3, 1)))
    assert type(momentum) is tuple and [values.shape for values in momentum] == [(3, 1), (3, 1)]


@needs_stub_beside_sources
@pytest.mark.slow
def test_right_programs_pass_a_strict_check_and_wrong_ones_do_not(tmp_path: Path) -> None:
    pytest.importorskip("mypy")
    (tmp_path / "right.py").write_text(RIGHT)
    (tmp_path / "wrong.py").write_text(WRONG)
    (tmp_path / "mypy.ini").write_text(
        f"[mypy]\nstrict = true\nfollow_imports = silent\ncache_dir = {tmp_path / 'cache'}\n"
        + ("" if SOURCES.parent.name == "site-packages" else f"mypy_path = {SOURCES.parent}\n")
    )
    told = subprocess.run(
        [sys.executable, "-m", "mypy", "--no-error-summary", "--config-file", "mypy.ini", "right.py", "wrong.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    lines = [line.split(": ")[0] for line in told.stdout.splitlines() if ": error: " in line]
    wrong = [f"wrong.py:{k}" for k, line in enumerate(WRONG.splitlines(), 1) if line.endswith("# wrong")]
    assert sorted(set(lines)) == sorted(wrong), told.stdout + told.stderr
