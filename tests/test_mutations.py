"""Mutations of good data: each changes what it names alone, and every case fits a code of the check."""

import json
import math
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
sys.path.insert(0, str(Path(__file__).parents[1] / "packages/lab/benchmarks"))

from mutations.cases import cases_of
from mutations.changes import Change, Facts, changed
from mutations.good import ALL_KINDS, GoodSet
from mutations.judging import FITTING, fits

from tauext.check.finding import codes
from tauext.data.recording import Recording
from tauext.data.recording_file import save_recording

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


@pytest.mark.parametrize(
    ("change", "touched"),
    [
        (Change("factor", ("q",), (1,), 180 / math.pi), {"q_b"}),
        (Change("factor", ("q", "dq"), (), -1.0), {f"{s}_{j}" for s in ("q", "dq") for j in JOINTS}),
        (Change("amperes", ("tau",), (0,)), {"tau_a"}),
        (Change("exchange", ("dq", "tau"), (0, 2)), {"dq_a", "dq_c", "tau_a", "tau_c"}),
        (Change("spike", ("tau",), (2,), 20.0, 3), {"tau_c"}),
        (Change("stuck", ("tau",), (1,), length=1.0), {"tau_b"}),
        (Change("delay", ("dq",), (), 0.02), {"dq_a", "dq_b", "dq_c"}),
        (Change("zero", ("q",), (2,), 0.1), {"q_c"}),
        (Change("time-unit", size=60.0), {"t_ns", "rate_hz"}),
    ],
    ids=lambda value: value.what if isinstance(value, Change) else "",
)
def test_a_mutation_changes_what_it_names_and_nothing_else(change, touched):
    one = made()
    assert differing(one, changed(one, change, FACTS, np.random.default_rng(1))) == touched


@pytest.fixture
def good(tmp_path):
    folder = tmp_path / "made" / "data"
    folder.mkdir(parents=True)
    for k, name in enumerate(("one", "two", "three", "judged")):
        save_recording(made(name, k), folder / f"{name}.parquet")
    split = {"format": 1, "train": ["one.parquet", "two.parquet"], "validation": ["three.parquet"], "test": []}
    (folder / "split.json").write_text(json.dumps(split))
    return GoodSet("made", folder, (folder / "judged.parquet",), (10.0, 8.0, 5.0), ALL_KINDS, None, ("arm",))


def test_the_list_is_drawn_by_its_seed_and_every_case_can_be_named(good):
    cases = cases_of(good, 0)
    assert [case.id for case in cases] == [case.id for case in cases_of(good, 0)]
    assert len({case.id for case in cases}) == len(cases) > 200 and {case.kind for case in cases} == set(ALL_KINDS)
    assert not any(fits(case.change.what, case.change.signals, "resolution") for case in cases)
    assert {code for listed in FITTING.values() for code in listed} <= set(codes())
