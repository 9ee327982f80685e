"""The examples, built and run as a user would: against an installed package, with a bundle and samples on disk."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_bundles import PUSHES, pushed, taking_amperes, watching_bundle
from made_cpp import ROOT, build, build_of_library, run

from tauext import _core
from tauext.data.recording_file import save_recording
from tauext.monitor.estimate import estimate_recording

COMPILERS_APART_NM = 1e-5
"""By how much the answers of two compilers may differ. Each chooses which products and sums it fuses, and the network's
sums in single precision round accordingly: without any fused operation these answers differ by 1.2e-7 Nm. A wrong
constant, unit or sample differs by more than 1e-3."""


@pytest.fixture(scope="module")
def package(tmp_path_factory) -> Path:
    return build_of_library(tmp_path_factory.mktemp("package"))


@pytest.fixture(scope="module")
def programs(tmp_path_factory, package) -> Path:
    """The folder of the C and C++ examples, built with find_package against an installed tauext."""
    folder = tmp_path_factory.mktemp("examples")
    code, _, err = run("cmake", "--install", package, "--prefix", folder / "installed")
    assert code == 0, err
    warnings = "-Wall -Wextra -Wpedantic -Wshadow -Werror"
    build(
        ROOT / "examples",
        folder / "built",
        f"-DCMAKE_PREFIX_PATH={folder / 'installed'}",
        f"-DCMAKE_CXX_FLAGS={warnings}",
        f"-DCMAKE_C_FLAGS={warnings}",
    )
    return folder / "built"


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A folder with a bundle and a recording of two pushes."""
    folder = tmp_path_factory.mktemp("place")
    watching_bundle().save(str(folder / "watching.tauext"))
    save_recording(pushed(), folder / "pushed.parquet")
    return folder


def same_compiler(package: Path) -> bool:
    """Whether the installed module was made by the compiler that the programs were made with: not so of a wheel."""
    cache = (package / "CMakeCache.txt").read_text()
    (compiler,) = re.findall(r"^CMAKE_CXX_COMPILER:\w+=(.*)$", cache, re.M)
    code, out, err = run(compiler, "-x", "c++", "-E", "-P", "-", text="__VERSION__")
    assert code == 0, err
    return _core.COMPILER.removeprefix("gcc ") == out[-1].strip('"')


def as_csv(made) -> str:
    """Samples as the C and C++ programs read them, every number in full."""
    columns = np.column_stack([made.q, made.dq, made.tau]).tolist()
    rows = [",".join(map(repr, [t_ns, *values])) for t_ns, values in zip(made.t_ns.tolist(), columns, strict=True)]
    return "\n".join(["t_ns,q_shoulder,q_elbow,dq_shoulder,dq_elbow,tau_shoulder,tau_elbow", *rows]) + "\n"


def changes_of_monitor() -> list[str]:
    """What a monitor says of the pushes, as the C program prints it: its own words for a health of two."""
    made = pushed()
    monitor = _core.Monitor(watching_bundle())
    lines, before = [], None
    for k, t_ns in enumerate(made.t_ns.tolist()):
        e = monitor.step(t_ns, made.q[k], made.dq[k], made.tau[k])
        if (e.health, e.alarm) != before:
            lines.append(f"{t_ns * 1e-9:.3f} s: health {e.health.name.replace('_', ' ')}, alarm {e.alarm.name}")
        before = e.health, e.alarm
    return lines


def test_the_control_loop_runs_and_says_how_long_an_estimate_takes(programs, place):
    code, out, err = run(programs / "01_control_loop", place / "watching.tauext", 1.5)
    assert code == 0, err
    shoulder, elbow, *rights, times, state = out
    assert (shoulder, elbow) == ("shoulder: tau in N m", "elbow: tau in N m")
    assert all(line.startswith(("no SCHED_FIFO: ", "no mlockall: ")) for line in rights)
    found = re.fullmatch(r"1500 cycles, (\d+) deadlines missed; estimate\(\): median (\S+) us, worst (\S+) us", times)
    assert found, times
    assert 0 < float(found[2]) <= float(found[3])
    assert int(found[1]) < 1500
    found = re.fullmatch(r"clear in (\d+) cycles, stop in (\d+); at the end health is (.+), alarm (\w+)", state)
    assert found, state
    # Half a second of warm-up is not clear; whether the made-up torques are a collision is the bundle's business.
    assert int(found[1]) + int(found[2]) <= 1000


def test_the_c_program_finds_in_a_csv_what_the_monitor_finds_in_python(programs, place):
    made = pushed()
    csv = as_csv(made)
    code, out, err = run(programs / "02_c_program", place / "watching.tauext", text=csv)
    assert code == 0, err
    expected = changes_of_monitor()
    assert len(expected) > 3
    assert out[0] == "tau in N m N m"
    assert [line.partition(" on ")[0] for line in out[1:-1]] == expected
    assert out[-1].startswith(f"{made.samples} samples; tau_ext ")
    code, own, err = run(programs / "02_c_program", place / "watching.tauext", 1)  # samples of its own
    assert code == 0, err
    assert own[1] == "0.000 s: health warming up, alarm none" and own[-1].startswith("1000 samples; ")
    few = [*csv.splitlines()[1:6], "7,1,2"]
    code, out, err = run(programs / "02_c_program", place / "watching.tauext", text="\n".join(few))
    assert (code, out[-1][:9]) == (2, "5 samples")
    assert err == "line after sample 5: t_ns and 6 values belong there\n"


def test_one_recording_in_amperes_gets_one_answer_to_the_last_bit_whoever_asks(programs, package, tmp_path):
    """evaluate, run, the Python monitor, the C API and C++, of a bundle whose constants are no powers of two.

    C and C++ to the last bit where one compiler made them and the module.
    """
    nm_per_ampere = np.array([7.3, -0.19])
    bundle = taking_amperes(watching_bundle(), nm_per_ampere)
    bundle.save(str(tmp_path / "amperes.tauext"))
    whole = pushed()
    made = replace(whole, tau=whole.tau / nm_per_ampere)
    save_recording(made, tmp_path / "pushed.parquet")
    assert bundle.torque_units == ["A", "A"] and bundle.estimate_units == ["N m", "N m"]

    said = _core.Monitor(bundle).run(made.t_ns, made.q, made.dq, made.tau)["tau_ext"]
    seen = np.abs(said[~np.isnan(said)])
    assert np.isfinite(said).all(axis=1).sum() > 5000 and seen.max() > 3  # Nm: the pushes

    evaluated = estimate_recording(bundle, made, 2).tau_ext
    np.testing.assert_array_equal(evaluated, said.astype(np.float32))  # what estimates are kept in

    tauext = (sys.executable, "-m", "tauext", "run", tmp_path / "amperes.tauext", tmp_path / "pushed.parquet")
    code, out, err = run(*tauext, "--json", "--status-hz", 1e9 / bundle.observer.sample_period_ns)
    assert code == 0, err
    told = {line["row"]: line["tau_ext_nm"] for line in map(json.loads, out) if line["event"] == "status"}
    assert len(told) > 5000
    for row, values in told.items():
        np.testing.assert_array_equal(np.array(values, dtype=float), said[row])  # None is NaN

    code, out, err = run(programs / "05_answers", tmp_path / "amperes.tauext", text=as_csv(made))
    assert code == 0 and err.splitlines()[0] == "shoulder takes tau in A, answers in N m"
    cpp = np.array([[float(cell) for cell in line.split(",")[3:]] for line in out])
    within = 0.0 if same_compiler(package) else COMPILERS_APART_NM
    np.testing.assert_allclose(cpp, said, rtol=0, atol=within)

    code, out, err = run(programs / "02_c_program", tmp_path / "amperes.tauext", text=as_csv(made))
    assert code == 0 and out[0] == "tau in A A"
    last = [float(word) for word in out[-1].split("tau_ext ")[1].split()]
    np.testing.assert_allclose(last, said[-1], rtol=0, atol=within)


def test_the_replay_prints_both_pushes(place):
    code, out, err = run(
        sys.executable, ROOT / "examples" / "03_replay.py", place / "watching.tauext", place / "pushed.parquet"
    )
    assert code == 0, err
    assert out[0] == "7.000 s: health warming_up, alarm none"
    collisions = [line for line in out if "alarm collision" in line]
    assert len(collisions) == len(PUSHES)
    for line, (start_s, joint, _), name in zip(collisions, PUSHES, ("shoulder", "elbow"), strict=True):
        assert f" on {name} " in line and joint == ("shoulder", "elbow").index(name)
        assert 0 <= float(line.split(" s:")[0]) - 7.0 - start_s < 0.1
    assert re.fullmatch(r"6000 samples, \d+ of them clear", out[-1])


@pytest.mark.parametrize("example", ["01_control_loop", "02_c_program", "03_replay.py", "05_answers"])
@pytest.mark.parametrize(
    ("damage", "says"), [("missing", "missing.tauext: "), ("cut", "cut.tauext: "), (None, "usage: ")]
)
def test_no_bundle_or_one_that_cannot_be_used_is_one_line(programs, place, tmp_path, example, damage, says):
    command = [sys.executable, ROOT / "examples" / example] if example.endswith(".py") else [programs / example]
    if damage:
        (tmp_path / "cut.tauext").write_bytes((place / "watching.tauext").read_bytes()[:-1])
        command.append(tmp_path / f"{damage}.tauext")
        command += [place / "pushed.parquet"] if example.endswith(".py") else []
    code, out, err = run(*command)
    assert (code, out, err.count("\n")) == (2, [], 1) and says in err
