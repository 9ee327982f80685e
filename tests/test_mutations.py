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
from tauext.robot.read import load_tree

JOINTS = ("a", "b", "c")
FACTS = Facts({"dq": np.array([1.0, 2.0, 3.0]), "tau": np.array([10.0, 20.0, 30.0])}, np.array([10.0, 8.0, 5.0]))


def made(name="one", seed=0, seconds=6.0, rate_hz=200.0):
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    phase = np.random.default_rng(seed).uniform(0, 6, 3)
    q, dq = np.sin(t[:, None] + phase), np.cos(t[:, None] + phase)
    contact = ((t > 2) & (t < 2.5) | (t > 4) & (t < 4.2)).astype(np.int8)
    t_ns = np.round(t * 1e9).astype(np.int64)
    return Recording(name, JOINTS, t_ns, q, dq, 5 * q + 1, rate_hz, "instant", "made", "", contact=contact)


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


def spiked(one, new):
    rows = np.flatnonzero(new.tau[:, 2] != one.tau[:, 2])
    return len(rows) == 3 and np.ptp(rows) == 2 and (np.abs(new.tau[rows, 2]) == 20 * 30.0).all()


def stuck(one, new):
    """While its joint moves."""
    rows = np.flatnonzero(new.tau[:, 1] != one.tau[:, 1])
    return len(np.unique(new.tau[rows, 1])) == 1 and abs(len(rows) - 200) < 3 and np.ptp(one.q[rows, 1]) > 0.3


@pytest.mark.parametrize(
    ("change", "touched", "is_so"),
    [
        (Change("factor", ("q",), (1,), 180 / math.pi), {"q_b"},
         lambda a, b: np.allclose(np.radians(b.q[:, 1]), a.q[:, 1])),
        (Change("factor", ("q", "dq"), (), -1.0), {f"{s}_{j}" for s in ("q", "dq") for j in JOINTS}, differing),
        (Change("amperes", ("tau",), (0,)), {"tau_a"}, lambda a, b: np.allclose(10 * b.tau[:, 0], a.tau[:, 0])),
        (Change("exchange", ("dq", "tau"), (0, 2)), {"dq_a", "dq_c", "tau_a", "tau_c"},
         lambda a, b: (b.tau == a.tau[:, [2, 1, 0]]).all()),
        (Change("spike", ("tau",), (2,), 20.0, 3), {"tau_c"}, spiked),
        (Change("stuck", ("tau",), (1,), length=1.0), {"tau_b"}, stuck),
        (Change("delay", ("dq",), (), 0.02), {"dq_a", "dq_b", "dq_c"}, lambda a, b: np.allclose(b.dq[4:], a.dq[:-4])),
        (Change("zero", ("q",), (2,), 0.1), {"q_c"}, differing),
        (Change("time-unit", size=60.0), {"t_ns", "rate_hz"},
         lambda a, b: abs(b.duration_s / a.duration_s - 60) < 1e-6),
    ],
    ids=lambda value: value.what if isinstance(value, Change) else "",
)  # fmt: skip
def test_a_mutation_changes_what_it_names_by_its_size_and_nothing_else(change, touched, is_so):
    one = made()
    new = changed(one, change, FACTS, np.random.default_rng(1))
    assert differing(one, new) == touched and is_so(one, new)


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


def test_labels_of_a_recording_are_wrong_as_named():
    one, rng = made(), np.random.default_rng(0)
    other = replace(one, contact=one.contact[::-1])

    def of(what, size=0.0):
        return broken_flags(one, other, what, size, rng).contact

    assert not of("label-all-dropped").any() and (of("label-other-file") == one.contact[::-1]).all()
    assert (of("label-shifted", 0.5)[100:] == one.contact[:-100]).all()
    assert np.count_nonzero(np.diff(one.contact - of("label-dropped"))) == 2


def test_pushes_and_loads_are_torque_that_the_motor_gives_besides(tmp_path):
    """A tenth of 2 kg, at twice the centre of mass's 0.4 m: 0.2 kg at 0.8 m on a horizontal axis."""
    one = replace(made(seconds=20.0), contact=None)
    new = pushed(one, np.array([10.0, 10.0, 10.0]), [1])
    np.testing.assert_allclose(new.tau + new.tau_ext, one.tau, atol=1e-12)
    assert not new.tau_ext[new.contact == 0].any() and (np.diff(new.contact) == 1).sum() > 5
    path = tmp_path / "arm.urdf"
    path.write_text("""<robot name="r"><link name="base"/><joint name="j" type="revolute"><parent link="base"/>
    <child link="l"/><axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="100" velocity="3"/></joint>
    <link name="l"><inertial><origin xyz="0.4 0 0"/><mass value="2"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>""")
    q = np.full((1000, 1), 0.3)
    still = replace(one, joints=("j",), t_ns=one.t_ns[:1000], q=q, dq=0 * q, tau=0 * q + 1)
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


@pytest.mark.parametrize(("files", "broken"), [(("two",), {"two"}), ((), {"one", "two", "three"})])
def test_only_what_is_broken_is_another_file(good, tmp_path, files, broken):
    case = Case("x", "made", "signs", Change("factor", ("tau",), (1,), -1.0), files, 3)
    broken_dataset(case, good, tmp_path / "out")
    assert {p.stem for p in (tmp_path / "out").iterdir() if not p.samefile(good.folder / p.name)} == broken
    clean = load_recording(good.folder / "two.parquet")
    assert differing(clean, load_recording(tmp_path / "out" / "two.parquet")) == {"tau_b"}
    judged = load_recording(good.judged[0])
    assert differing(judged, judged_recording(case, good, good.judged[0])) == (set() if files else {"tau_b"})


def test_the_list_is_drawn_by_its_seed_and_every_case_can_be_named(good):
    cases = cases_of(good, 0)
    assert [case.id for case in cases] == [case.id for case in cases_of(good, 0)]
    assert len({case.id for case in cases}) == len(cases) > 200 and {case.kind for case in cases} == set(ALL_KINDS)
    assert not any(fits(case.change.what, case.change.signals, "resolution") for case in cases)
    assert {code for listed in FITTING.values() for code in listed} <= set(codes())


def test_a_finding_counts_that_the_clean_data_do_not_have_and_harm_is_a_twentieth():
    def verdict(code, joint="b", severity="fault", clean=()):
        return verdict_before("factor", ("tau",), [Seen(code, joint, severity, "")], list(clean))[0]

    known = Seen("effort-scale", "b", "fault", "")
    assert verdict("effort-scale") == verdict("effort-scale", "a", clean=[known]) == "refused"
    assert verdict("effort-scale", clean=[known]) is verdict("resolution", severity="warning") is None
    assert verdict("effort-scale", severity="warning") == verdict("odd-recording", severity="warning") == "named"
    clean = Worth([10.0, 20.0], 60, 100)
    assert verdict_after(Worth([10.4, 19.2], 62, 100), clean)[0] == "harmless"
    for limits, found in (([10.6, 20.0], 60), ([9.4, 20.0], 60), ([10.0, 20.0], 56), ([float("nan"), 20.0], 60)):
        assert verdict_after(Worth(limits, found, 100), clean)[0] == "missed"


def test_the_table_counts_every_case_once_and_lists_the_missed():
    row = {"dataset": "rig", "kind": "spikes", "fits": True, "limit_off": 2.0, "found": 3, "events": 100}
    row |= {"found_clean": 71, "findings": [], "error": None}
    rows = [row | {"id": str(k), "verdict": v} for k, v in enumerate(("refused", "named", "missed", "missed"))]
    text = markdown(rows, [{"name": "ur10", "faults": ["resolution"], "error": None}], "made")
    assert "| rig | spikes | 4 | 1 | 1 | 0 | 2 | 0 | 0 |" in text and "Missed: 2 of 4, 50.0%." in text
    assert "False refusals on good data: 1 of 1 datasets." in text
