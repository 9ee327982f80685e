"""The standard error of a pressed joint at rest, against a joint whose true friction is simulated."""

import math
from dataclasses import replace

import numpy as np
import pytest
from made_arms import no_model, prismatic_mass
from made_bundles import constant_error_scale
from sliding_mass import observer_bundle, recording

from tauext import _core

FRICTION_N, DRIVE_N_M, COUNT_M = 5.0, 4000.0, 5e-5
WIDTHS_M = np.array([1e-4, 3e-4, 1e-3])
SIGMA_N, SAMPLES, SETTLED = 0.3, 12_000, 3000


def pressed_joint(builds_up_m: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position of a slide whose drive is a spring to 0, its friction, and the random slow push that it gives way to.

    The friction is Dahl's, dF/dx = (1 - s F/F_max) F_max/x_0 in the direction s; inertia is 0. In each substep the
    slide moves to where push, spring and friction balance, to first order.
    """
    knots = np.r_[0, 0, np.random.default_rng(seed).uniform(-3, 3, 10) * FRICTION_N, 0, 0]
    push = np.interp(np.linspace(0, len(knots) - 1, SAMPLES), np.arange(len(knots)), knots)
    q, friction, out = 0.0, 0.0, np.zeros((SAMPLES, 2))
    for k, pushed in enumerate(push.tolist()):
        for _ in range(20):
            rest = pushed - DRIVE_N_M * q - friction
            end = math.copysign(FRICTION_N, rest)
            step = abs(rest) / (DRIVE_N_M + abs(end - friction) / builds_up_m)
            friction = end - (end - friction) * math.exp(-step / builds_up_m)
            q += math.copysign(step, rest)
        out[k] = q, friction
    return out[:, 0], out[:, 1], push


def fitted_weights(builds_up_m: float) -> np.ndarray:
    """Presliding weights that describe Dahl's friction after a reversal best, 1 - 2 exp(-x/x_0) over the travel x."""
    travel = np.linspace(0, 3 * WIDTHS_M[-1], 600)
    states = np.clip(travel[:, None] / WIDTHS_M - 1, -1, 1)
    found = np.linalg.lstsq(states, 1 - 2 * np.exp(-travel / builds_up_m), rcond=None)[0]
    return FRICTION_N * found / found.sum()


def bundle_of(builds_up_m: float) -> _core.Bundle:
    """A slide without a model, with this friction."""
    bundle, prior = observer_bundle(limit_nm=1.0), _core.PriorSettings()
    prior.widths_rad = WIDTHS_M.tolist()
    prior.terms = [_core.Term(_core.TermKind.presliding, 0, width) for width in range(len(WIDTHS_M))]
    prior.weights = (-fitted_weights(builds_up_m)).tolist()
    bundle.links = no_model(prismatic_mass(0.0)).links
    bundle.prior, bundle.error_scale = prior, constant_error_scale([SIGMA_N])
    return bundle


@pytest.mark.parametrize(("builds_up_m", "shows"), [(1.5e-5, False), (6e-4, True)])
def test_the_truth_lies_within_two_standard_errors_of_a_pressed_joint(builds_up_m, shows):
    """Friction that builds up within a count of the encoder is hidden; positions show friction that takes a dozen."""
    bundle = bundle_of(builds_up_m)
    q, friction, push = pressed_joint(builds_up_m, seed=1)
    counted = np.round(q / COUNT_M)[:, None] * COUNT_M
    dq, tau = np.gradient(q, 1e-3)[:, None], (friction - push)[:, None]
    said = _core.estimate(bundle, *replace(recording(samples=SAMPLES), q=counted, dq=dq, tau=tau).signals, 1)
    rests = (np.arange(SAMPLES) > SETTLED) & (said["near_stiction"][:, 0] == 1)
    error, found = np.abs(said["tau_ext"][rests, 0] - push[rests]), said["contact_sigma_nm"][rests, 0]
    assert rests.sum() > 0.7 * SAMPLES
    assert np.mean(error <= 2 * found) > 0.95 and np.mean(error <= 2 * SIGMA_N) < 0.7
    assert (np.median(found) < 0.3 * FRICTION_N) == shows and np.median(found) < 1.3 * FRICTION_N
