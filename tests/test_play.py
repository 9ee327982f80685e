"""Play between gear and load: found at the joint that has it, at its width, and only in servos' recordings."""

from dataclasses import replace

import numpy as np
import pytest
from made_arms import planar_arm
from test_prior import CORRECTED, RATE_HZ, WIDTHS, Kind, loaded, motion, record, setup_of, twin_presliding, where

from tauext.fit.prior import fit_prior, told

SERVO = {"servo": {"torque_from": "duty", "velocity_steps": 20}}
STEADY = replace(CORRECTED, correct_model=False)


def with_play(q, dq, beta):
    """The shoulder carries none of its weight in the middle of 0.04 rad, the elbow always does."""
    v = loaded(q, dq, beta)
    v[:, 0] += beta[:, 0] * (1 - np.abs(twin_presliding(q, WIDTHS[1])[:, 0]))
    return v


def turning(seed):
    """A joint that turns back often: sines, and steps of a tenth of a radian."""
    q, _ = motion(seed, 30.0)
    steps = 0.05 * np.sin(2 * np.pi * np.linspace(0, 30, len(q)) * (0.7 + 0.1 * seed))[:, None]
    q = 0.3 * q + steps
    return q, np.gradient(q, 1 / RATE_HZ, axis=0)


@pytest.fixture(scope="module")
def recordings():
    made = [record(planar_arm(), turning(seed), with_play, 0.2, seed) for seed in range(6)]
    return [replace(one, provenance=SERVO) for one in made]


def test_play_is_found_at_its_joint_and_width(recordings):
    said = []
    fit = fit_prior(setup_of(planar_arm()), recordings, STEADY, said.append)
    assert [(t.a, t.b) for t in fit.settings.terms if t.kind == Kind.backlash] == [(0, 1)]
    # r holds beta (1 - |z|) whole: a weight of 1.
    assert fit.weights[0, where(fit, 0, "backlash", 1)] == pytest.approx(1.0, abs=0.05)
    assert said[-1] == "play that carries no weight: shoulder 40 mrad"


def test_other_arms_and_arms_without_play_have_none(recordings):
    plain = [replace(one, provenance={}) for one in recordings]
    fit = fit_prior(setup_of(planar_arm()), plain, STEADY)
    assert not [t for t in fit.settings.terms if t.kind == Kind.backlash]
    made = [record(planar_arm(), turning(seed), loaded, 0.2, seed) for seed in range(6)]
    tight = [replace(one, provenance=SERVO) for one in made]
    fit = fit_prior(setup_of(planar_arm()), tight, STEADY)
    assert not [t for t in fit.settings.terms if t.kind == Kind.backlash]
    assert told((None, None), WIDTHS, ("shoulder", "elbow")) == ""
