"""When the place of a touch is told: by samples and not by chunks, again where the torque grows, and when it ends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_places import bundle as bundle

from tauext.monitor import place_facts, place_words
from tauext.monitor.places import PlaceFinder

SIGMA_NM, RATE_HZ, RISES, FALLS = 0.1, 1000, 200, 900
JOINTS = tuple(f"joint{k + 1}" for k in range(7))


def said_of(tau: np.ndarray, alarm: np.ndarray) -> dict[str, np.ndarray]:
    return {
        "alarm": alarm,
        "alarm_joint": np.where(alarm > 0, 4, -1),
        "tau_ext": tau,
        "sigma_nm": np.full_like(tau, SIGMA_NM),
        "near_stiction": np.zeros(tau.shape, dtype=bool),
    }


@pytest.fixture
def signals():
    """A touch on the fifth link whose torque steps up 0.4 s after the alarm and ends 0.7 s after it."""
    rows = 1200
    tau = np.random.default_rng(4).normal(size=(rows, 7)) * 0.01
    tau[RISES - 20 : FALLS, :5] += [1.0, -2.0, 0.5, 1.5, 0.8]
    tau[RISES + 400 : FALLS] *= 3
    alarm = np.zeros(rows, dtype=np.uint8)
    alarm[RISES:FALLS] = 2
    t_ns = np.arange(rows, dtype=np.int64) * 1_000_000
    return t_ns, np.full((rows, 7), 0.3), said_of(tau, alarm)


def found(bundle, signals, step: int) -> list:
    t_ns, q, said = signals
    finder, told = PlaceFinder(bundle), []
    for k in range(0, len(t_ns), step):
        rows = slice(k, k + step)
        told += finder.find(k, t_ns[rows], q[rows], {name: column[rows] for name, column in said.items()})
    return told


def test_told_after_a_tenth_of_a_second_and_again_when_it_grows(bundle, signals):
    first, again = found(bundle, signals, 1200)
    assert first.row == RISES + 100 and first.since_s == pytest.approx(0.1) and first.joint == 4
    assert again.row == RISES + 400
    # The sample is that at which the torque stood out most: three times as much, three times the force.
    sizes = [np.linalg.norm(one.places[0].force) for one in (first, again)]
    assert sizes[1] / sizes[0] == pytest.approx(3, rel=0.2)
    assert sum(share for _, share in first.links) == pytest.approx(1)
    assert {link for link, share in first.links if share > 0.05} <= {4, 5, 6}


@pytest.mark.parametrize("step", [1, 7, 250])
def test_chunks_do_not_change_what_is_told(bundle, signals, step):
    whole, parts = found(bundle, signals, 1200), found(bundle, signals, step)
    assert [(one.row, one.links, one.since_s) for one in whole] == [(one.row, one.links, one.since_s) for one in parts]


def test_a_short_touch_is_told_when_its_alarm_falls(bundle, signals):
    t_ns, q, said = signals
    said["alarm"][RISES + 30 :] = 0
    (only,) = PlaceFinder(bundle).find(0, t_ns, q, said)
    assert only.row == RISES + 30 and only.alarm == 2


def test_an_acknowledged_alarm_that_stands_again_is_another(bundle, signals):
    t_ns, q, said = signals
    finder, until = PlaceFinder(bundle), RISES + 300
    told = finder.find(0, t_ns[:until], q[:until], {name: column[:until] for name, column in said.items()})
    finder.acknowledged()
    rest = {name: column[until:] for name, column in said.items()}
    anew = finder.find(until, t_ns[until:], q[until:], rest)
    assert len(told) == 1 and anew[0].row == until + 100


def test_words_and_facts(bundle, signals):
    change = found(bundle, signals, 1200)[0]
    words = place_words(replace(change, consistent=0.5), JOINTS)
    assert "no single force" in place_words(replace(change, consistent=0.001), JOINTS)
    best = JOINTS[change.links[0][0]]
    assert words.startswith(f"the touch is on the link of {best} (") and " N within " in words
    facts = place_facts(change, JOINTS)
    assert facts["links"][0]["joint"] == best and len(facts["places"]) == len(change.places)
    assert len(facts["places"][0]["force_n"]) == 3


def test_nothing_is_told_without_an_alarm_or_a_model(bundle, signals):
    t_ns, q, said = signals
    quiet = said | {"alarm": np.zeros_like(said["alarm"])}
    assert PlaceFinder(bundle).find(0, t_ns, q, quiet) == []
    bare = type(bundle)()
    bare.links = bundle.links
    finder = PlaceFinder(bare)
    assert "error scale" in finder.refused and finder.find(0, t_ns, q, said) == []
