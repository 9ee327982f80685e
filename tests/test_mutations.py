"""Mutations of good data: each changes exactly what it names, and verdicts are what they say."""

import json
import math
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
sys.path.insert(0, str(Path(__file__).parents[1] / "packages/lab/benchmarks"))

from mutations.cases import Case, broken_dataset, cases_of, judged_recording
from mutations.changes import Change, Facts, broken_flags, broken_intervals, changed, pushed, with_load
from mutations.good import ALL_KINDS, GoodSet
from mutations.judging import FITTING, Seen, Worth, fits, verdict_after, verdict_before
from mutations.tables import markdown

from tauext.check.finding import codes
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording, save_recording
from tauext.errors import RecordingError
from tauext.robot.read import load_tree

JOINTS = ("a", "b", "c")
FACTS = Facts({"dq": np.array([1.0, 2.0, 3.0]), "tau": np.array([10.0, 20.0, 30.0])}, np.array([10.0, 8.0, 5.0]))


def made(name="one", seed=0, seconds=6.0, rate_hz=200.0):
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    phase = np.random.default_rng(seed).uniform(0, 6, 3)
    q = np.sin(t[:, None] + phase)
    contact = ((t > 2) & (t < 2.5) | (t > 4) & (t < 4.2)).astype(np.int8)
    return Recording(
        name=name, joints=JOINTS, t_ns=np.round(t * 1e9).astype(np.int64), q=q, dq=np.cos(t[:, None] + phase),
        tau=5 * q + 1, rate_hz=rate_hz, torque_timing="instant", source="made", robot_sha256="", contact=contact,
    )  # fmt: skip


def differing(one, other):
    """Names of the fields that differ, of signals with their joints."""
    names = set()
    for field in fields(Recording):
        old, new = getattr(one, field.name), getattr(other, field.name)
        if not isinstance(old, np.ndarray) or not isinstance(new, np.ndarray):
            names |= {field.name} if type(old) is not type(new) or old != new else set()
        elif old.ndim == 1:
            names |= {field.name} if not np.array_equal(old, new) else set()
        else:
            names |= {f"{field.name}_{JOINTS[j]}" for j in range(3) if not np.array_equal(old[:, j], new[:, j])}
    return names


@pytest.mark.parametrize(
    ("change", "touched"),
    [
        (Change("factor", ("q",), (1,), 180 / math.pi), {"q_b"}),
        (Change("factor", ("q", "dq"), (), -1.0), {f"{s}_{j}" for s in ("q", "dq") for j in JOINTS}),
        (Change("amperes", ("tau",), (0,)), {"tau_a"}),
        (Change("exchange", ("dq", "tau"), (0, 2)), {"dq_a", "dq_c", "tau_a", "tau_c"}),
        (Change("spike", ("tau",), (2,), 20.0, 3), {"tau_c"}),
        (Change("stuck", ("q",), (0,), length=0.5), {"q_a"}),
        (Change("delay", ("dq",), (), 0.02), {"dq_a", "dq_b", "dq_c"}),
        (Change("zero", ("q",), (2,), 0.1), {"q_c"}),
        (Change("time-unit", size=1e-3), {"t_ns", "rate_hz"}),
    ],
    ids=lambda value: value.what if isinstance(value, Change) else "",
)
def test_a_mutation_changes_what_it_names_and_nothing_else(change, touched):
    assert differing(made(), changed(made(), change, FACTS, np.random.default_rng(1))) == touched


def test_mutations_have_the_size_they_say():
    one = made()

    def new(*arguments, length=0.0):
        return changed(one, Change(*arguments, length=length), FACTS, np.random.default_rng(1))

    np.testing.assert_allclose(np.radians(new("factor", ("q",), (1,), 180 / math.pi).q[:, 1]), one.q[:, 1])
    np.testing.assert_allclose(new("amperes", ("tau",)).tau * [10.0, 8.0, 5.0], one.tau)
    swapped = new("exchange", ("tau",), (0, 2)).tau
    np.testing.assert_array_equal(swapped, one.tau[:, [2, 1, 0]])
    late = new("delay", ("tau",), (), 0.02)  # four samples
    np.testing.assert_allclose(late.tau[4:], one.tau[:-4], atol=1e-12)
    slow = new("time-unit", ("q",), (), 60.0)
    assert slow.duration_s == pytest.approx(60 * one.duration_s)
    assert slow.rate_hz == pytest.approx(one.rate_hz / 60)
    assert new("thinned", ("q",), (), 2.0).samples == one.samples // 2


def test_a_spike_is_so_many_samples_of_its_size():
    one = made()
    for signal, size, expected in (("tau", 20.0, 20 * 30.0), ("dq", 2.0, 2 * 3.0)):
        new = getattr(changed(one, Change("spike", (signal,), (2,), size, 3), FACTS, np.random.default_rng(1)), signal)
        rows = np.flatnonzero(new[:, 2] != getattr(one, signal)[:, 2])
        assert len(rows) == 3 and np.ptp(rows) == 2
        np.testing.assert_array_equal(np.abs(new[rows, 2]), expected)
    q = changed(one, Change("spike", ("q",), (0,), 0.05, 1), FACTS, np.random.default_rng(1)).q
    assert np.sort(np.abs(q - one.q)[:, 0])[-2:] == pytest.approx([0.0, 0.05])


def test_a_stuck_signal_stands_for_its_time_while_its_joint_moves():
    one = made()
    new = changed(one, Change("stuck", ("tau",), (1,), length=1.0), FACTS, np.random.default_rng(1))
    rows = np.flatnonzero(new.tau[:, 1] != one.tau[:, 1])
    assert len(np.unique(new.tau[rows, 1])) == 1 and len(rows) == pytest.approx(200, abs=2)
    assert np.ptp(one.q[rows, 1]) > 0.3
    whole = changed(one, Change("stuck", ("tau",), (1,), length=math.inf), FACTS, np.random.default_rng(1))
    assert (whole.tau[:, 1] == one.tau[0, 1]).all()


SPANS = {"a-1.csv": [[1.0, 2.0], [3.0, 4.0]], "b.csv": [[5.0, 6.0]]}


@pytest.mark.parametrize(
    ("what", "expected"),
    [
        ("label-all-dropped", {"b.csv": SPANS["b.csv"]}),
        ("label-shifted", {"a-1.csv": [[1.5, 2.5], [3.5, 4.5]], "b.csv": SPANS["b.csv"]}),
        ("label-other-file", {"a-1.csv": SPANS["b.csv"], "b.csv": SPANS["b.csv"]}),
        ("label-beyond", {"a-1.csv": [[1001.0, 1002.0], [1003.0, 1004.0]], "b.csv": SPANS["b.csv"]}),
        ("label-milliseconds", {"a-1.csv": [[1000.0, 2000.0], [3000.0, 4000.0]], "b.csv": SPANS["b.csv"]}),
        ("label-misspelt", {"a_1.csv": SPANS["a-1.csv"], "b.csv": SPANS["b.csv"]}),
    ],
)
def test_labels_of_an_import_are_wrong_as_named(what, expected):
    assert broken_intervals(SPANS, "a-1.csv", what, 0.5, np.random.default_rng(0)) == expected
    assert SPANS["a-1.csv"] == [[1.0, 2.0], [3.0, 4.0]]


def test_labels_of_a_recording_are_wrong_as_named():
    one, rng = made(), np.random.default_rng(0)
    other = replace(one, contact=one.contact[::-1])

    def of(what, size=0.0):
        new = broken_flags(one, other, what, size, rng)
        assert differing(one, new) <= {"contact"}
        return new.contact

    assert not of("label-all-dropped").any()
    assert (of("label-other-file") == one.contact[::-1]).all()
    assert (of("label-shifted", 0.5)[100:] == one.contact[:-100]).all()
    assert (of("label-shifted", -0.5)[:-100] == one.contact[100:]).all()
    dropped = one.contact - of("label-dropped")
    assert dropped.min() == 0 and np.count_nonzero(np.diff(dropped)) == 2


def test_pushes_are_what_motor_and_arm_no_longer_balance():
    one = replace(made(seconds=20.0), contact=None)
    new = pushed(one, np.array([10.0, 10.0, 10.0]), [1])
    np.testing.assert_allclose(new.tau + new.tau_ext, one.tau, atol=1e-12)
    assert differing(one, new) == {"tau_a", "tau_b", "tau_c", "tau_ext", "contact"}
    assert not new.tau_ext[new.contact == 0].any() and (np.diff(new.contact) == 1).sum() > 5


def test_a_load_weighs_what_it_says(tmp_path):
    """A tenth of 2 kg, at twice the centre of mass's 0.4 m: 0.2 kg at 0.8 m on a horizontal axis."""
    path = tmp_path / "arm.urdf"
    path.write_text("""<robot name="r"><link name="base"/><joint name="j" type="revolute"><parent link="base"/>
    <child link="l"/><axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="100" velocity="3"/></joint>
    <link name="l"><inertial><origin xyz="0.4 0 0"/><mass value="2"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>""")
    t = np.arange(1000) / 200
    still = Recording(
        name="still", joints=("j",), t_ns=np.round(t * 1e9).astype(np.int64), q=np.full((1000, 1), 0.3),
        dq=np.zeros((1000, 1)), tau=np.ones((1000, 1)), rate_hz=200.0, torque_timing="instant", source="",
        robot_sha256="",
    )  # fmt: skip
    extra = with_load(still, load_tree(path), 0.1).tau - still.tau
    np.testing.assert_allclose(np.abs(extra), 0.2 * 9.81 * 0.8 * np.cos(0.3), rtol=1e-6)


@pytest.fixture
def good(tmp_path):
    folder = tmp_path / "made" / "data"
    folder.mkdir(parents=True)
    for k, name in enumerate(("one", "two", "three", "judged")):
        save_recording(made(name, k), folder / f"{name}.parquet")
    split = {"format": 1, "train": ["one.parquet", "two.parquet"], "validation": ["three.parquet"], "test": []}
    (folder / "split.json").write_text(json.dumps(split))
    return GoodSet("made", folder, (folder / "judged.parquet",), (10.0, 8.0, 5.0), ALL_KINDS, None, ("arm",))


def test_only_what_is_broken_is_another_file(good, tmp_path):
    change = Change("factor", ("tau",), (1,), -1.0)
    before = {path.name: path.read_bytes() for path in good.folder.iterdir()}
    one, every = tmp_path / "one", tmp_path / "every"
    broken_dataset(Case("x", "made", "signs", change, ("two",), 3), good, one)
    assert {path.name: path.read_bytes() for path in good.folder.iterdir()} == before
    changed_files = {path.name for path in one.iterdir() if not path.samefile(good.folder / path.name)}
    assert changed_files == {"two.parquet"}
    clean = load_recording(good.folder / "two.parquet")
    assert differing(clean, load_recording(one / "two.parquet")) == {"tau_b"}
    case = Case("x", "made", "signs", change, (), 3)
    broken_dataset(case, good, every)
    changed_files = {path.name for path in every.iterdir() if not path.samefile(good.folder / path.name)}
    assert changed_files == {"one.parquet", "two.parquet", "three.parquet"}
    judged = load_recording(good.judged[0])
    assert differing(judged, judged_recording(case, good, good.judged[0])) == {"tau_b"}


def test_stamps_that_no_recording_can_have_are_refused(good, tmp_path):
    case = Case("x", "made", "time unit", Change("time-unit", size=1e-9), (), 0)
    with pytest.raises(RecordingError, match="strictly increase"):
        broken_dataset(case, good, tmp_path / "out")


def test_the_list_is_drawn_by_its_seed_and_every_case_can_be_named(good):
    cases = cases_of(good, 0)
    assert [case.id for case in cases] == [case.id for case in cases_of(good, 0)]
    assert {case.id for case in cases} != {case.id for case in cases_of(good, 1)}
    assert len({case.id for case in cases}) == len(cases) > 200
    assert {case.kind for case in cases} == set(ALL_KINDS)
    assert all(set(case.files) <= {"one", "two"} for case in cases)
    for case in cases:
        assert not fits(case.change.what, case.change.signals, "resolution")
    assert {code for listed in FITTING.values() for code in listed} <= set(codes())


def seen(code, joint="b", severity="fault"):
    return Seen(code, joint, severity, "")


def test_a_finding_counts_that_the_clean_data_do_not_have():
    def verdict(*found, what="factor", signals=("tau",), clean=()):
        return verdict_before(what, signals, list(found), list(clean))[0]

    assert verdict(seen("effort-scale")) == "refused"
    assert verdict(seen("effort-scale"), clean=[seen("effort-scale")]) is None
    assert verdict(seen("effort-scale"), clean=[seen("effort-scale", "a")]) == "refused"
    assert verdict(seen("effort-scale", severity="warning")) == "named"
    assert verdict(seen("resolution", severity="warning")) is None
    assert verdict(seen("odd-recording", severity="warning")) == "named"


def test_harm_is_a_change_of_more_than_a_twentieth_either_way():
    clean = Worth([10.0, 20.0], 60, 100)
    assert verdict_after(Worth([10.4, 19.2], 62, 100), clean)[0] == "harmless"
    assert verdict_after(Worth([10.6, 20.0], 60, 100), clean)[0] == "missed"
    assert verdict_after(Worth([9.4, 20.0], 60, 100), clean)[0] == "missed"
    assert verdict_after(Worth([10.0, 20.0], 56, 100), clean)[0] == "missed"
    assert verdict_after(Worth([float("nan"), 20.0], 60, 100), clean)[0] == "missed"


def test_the_table_counts_every_case_once_and_lists_the_missed():
    row = {"dataset": "rig", "kind": "spikes", "fits": True, "limit_off": 2.0, "found": 3, "events": 100}
    row |= {"found_clean": 71, "findings": [], "error": None}
    rows = [row | {"id": str(k), "verdict": v} for k, v in enumerate(("refused", "named", "missed", "missed"))]
    text = markdown(rows, [{"name": "ur10", "faults": ["resolution"], "error": None}], "made")
    assert "| rig | spikes | 4 | 1 | 1 | 0 | 2 | 0 | 0 |" in text
    assert "Missed: 2 of 4, 50.0%." in text and text.count("| 200% | 3 of 100 (clean 71) |") == 2
    assert "False refusals on good data: 1 of 1 datasets." in text
