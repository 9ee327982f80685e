"""Friction that follows the joints' temperatures: found where the motion shows it, and the same in every path."""

from dataclasses import replace

import numpy as np
import pytest
from made_arms import planar_arm
from made_live import replay
from test_drift import with_dynamics
from test_train import recording

from tauext import _core
from tauext.config import ObserverConfig, PriorConfig
from tauext.data.recording import Recording
from tauext.fit.bundle_writing import build_setup, make_bundle
from tauext.fit.prior import fit_prior
from tauext.fit.training_set import with_presliding
from tauext.monitor.estimate import estimate_recording

SETTINGS = PriorConfig((), coulomb_speeds_rad_s=(0.05,), most_ripples=0, correct_model=False)
COULOMB, VISCOUS = -0.1, -0.3
"""Shares of the friction for 10 K, of the true arm."""


def warmed(seed: int, celsius: float, rise_k: float = 0.0, seconds: float = 10.0) -> Recording:
    """Of friction that was 5 tanh(dq / 0.05) + 2 dq at 30 degC, while both joints warm up."""
    made = recording(seed, seconds=seconds)
    temperature = celsius + rise_k * np.linspace(0, 1, made.samples)[:, None] * np.ones(2)
    tens = (temperature - 30) / 10
    friction = (1 + COULOMB * tens) * 5 * np.tanh(made.dq / 0.05) + (1 + VISCOUS * tens) * 2 * made.dq
    return replace(with_dynamics(replace(made, tau=friction)), temperature=temperature)


def fitted(made: list[Recording], config: PriorConfig = SETTINGS):
    setup = with_presliding(build_setup(planar_arm(), made[0], ObserverConfig()), ())
    return setup, fit_prior(setup, made, config)


@pytest.fixture(scope="module")
def warm_up():
    made = [warmed(k % 3, 22 + 2 * k, 2) for k in range(9)]  # the same motion again and again
    return made, *fitted(made)


def test_the_shares_of_the_true_friction_are_found(warm_up):
    made, _, fit = warm_up
    found = fit.settings.temperature
    mean = np.mean([one.temperature.mean(axis=0) for one in made], axis=0)
    np.testing.assert_allclose(found.reference_c, mean, atol=0.2)
    tens = (np.array(found.reference_c) - 30) / 10  # shares of the friction at the reference, not at 30 degC
    np.testing.assert_allclose(found.coulomb_per_10k, COULOMB / (1 + COULOMB * tens), rtol=0.1)
    np.testing.assert_allclose(found.viscous_per_10k, VISCOUS / (1 + VISCOUS * tens), rtol=0.1)
    furthest = np.max([np.abs(one.temperature - found.reference_c).max(axis=0) for one in made], axis=0)
    np.testing.assert_allclose(found.reach_k, furthest + 5, atol=0.2)  # the warm-up is not looked at
    assert [one.settings.temperature.reach_k for one in fit.left_out] == [found.reach_k] * len(fit.left_out)


def test_cold_and_warm_motion_is_foreseen_by_estimates_and_by_a_replay(warm_up):
    _, setup, fit = warm_up
    _, blind = fitted([replace(one, temperature=None) for one in warm_up[0]])
    assert not blind.settings.temperature.reference_c
    for celsius in (20.0, 42.0):
        made = warmed(20, celsius)
        left = []
        for one in (blind, fit):
            bundle = make_bundle("warm", replace(setup, prior=one.settings), 0.02, made)
            said = estimate_recording(bundle, made, 1)
            left.append(np.sqrt(np.nanmean(said.tau_ext**2, axis=0)))
        assert (left[1] < 0.2 * left[0]).all()
        chunks = [chunk.estimates["tau_ext"] for chunk in replay(_core.Monitor(bundle), made)]
        np.testing.assert_array_equal(np.concatenate(chunks).astype(np.float32), said.tau_ext)


def test_a_temperature_that_tells_nothing_leaves_the_friction_alone():
    rng = np.random.default_rng(0)
    # It rises and falls, and friction stays.
    made = [with_dynamics(recording(k, seconds=10.0)) for k in range(6)]
    made = [replace(one, temperature=30 + 10 * rng.uniform(-1, 1) + np.zeros_like(one.q)) for one in made]
    noisy = [replace(one, tau=one.tau + 0.3 * rng.standard_normal(one.tau.shape)) for one in made]
    assert not fitted(noisy)[1].settings.temperature.reference_c
    # It stays, as the recordings of one minute do.
    assert not fitted([warmed(k, 30.0) for k in range(4)])[1].settings.temperature.reference_c


def test_it_can_be_switched_off_and_recordings_without_it_are_left_out(warm_up):
    off = fitted(warm_up[0][:2], replace(SETTINGS, follow_temperature=False))[1]
    assert not off.settings.temperature.reference_c
    some = [replace(one, temperature=None) if k % 3 == 2 else one for k, one in enumerate(warm_up[0])]
    found = fitted(some)[1].settings.temperature
    np.testing.assert_allclose(found.viscous_per_10k, warm_up[2].settings.temperature.viscous_per_10k, rtol=0.3)
