"""Leader feedback: nothing in the dead band, no jumps, and never more energy than the tank and the gears' friction."""

from __future__ import annotations

import numpy as np
import pytest
from tauext_lerobot.leader_feedback import FeedbackSettings, LeaderFeedback, free_motion_sigmas

from tauext.errors import ConfigError

DT = 0.02
BIG = 1e6  # settings that are out of the way
OPEN = dict(cap_nm=BIG, slew_nm_s=BIG, tank_j=BIG, dead_band_sigmas=0.0)


def steady(feedback: LeaderFeedback, tau_ext, sigma, ticks: int = 1) -> np.ndarray:
    """The torque after so many ticks with the leader at rest."""
    for _ in range(ticks):
        torque = feedback.step(tau_ext, sigma, np.zeros(len(tau_ext)), DT)
    return torque


def test_the_dead_band_is_continuous_and_shifts_what_is_beyond_it():
    settings = FeedbackSettings(**OPEN | dict(dead_band_sigmas=4.0, least_dead_band=0.1))
    for tau, sigma, felt in [(0.39, 0.1, 0), (-0.39, 0.1, 0), (0.5, 0.1, 0.1), (-0.5, 0.1, -0.1), (0.3, 0.0, 0.2)]:
        assert steady(LeaderFeedback(1, settings), [tau], [sigma]) == pytest.approx(felt, abs=1e-12)
    fine, feedback = np.linspace(-1, 1, 1001), LeaderFeedback(1, settings)
    felt = np.array([steady(feedback, [t], [0.05])[0] for t in fine])
    assert np.abs(np.diff(felt)).max() <= np.diff(fine).max() * (1 + 1e-9)


def test_the_dead_band_widens_at_once_and_narrows_as_the_observer_forgets():
    settings = FeedbackSettings(**OPEN | dict(dead_band_sigmas=4.0, least_dead_band=0.1, dead_band_fade_s=0.1))
    feedback = LeaderFeedback(1, settings)
    assert steady(feedback, [2.0], [0.25]) == pytest.approx(1.0)
    for k in range(1, 20):
        assert steady(feedback, [2.0], [0.0]) == pytest.approx(2 - max(np.exp(-k * DT / 0.1), 0.1))
    assert steady(feedback, [2.0], [0.25]) == pytest.approx(1.0)


def test_gain_cap_and_sign_of_each_joint():
    settings = FeedbackSettings(**OPEN | dict(gain=(0.5, -2.0, 1.0), cap_nm=(1.0, 1.0, 0.3)))
    assert steady(LeaderFeedback(3, settings), [0.4, 0.25, 5.0], [0, 0, 0]) == pytest.approx([0.2, -0.5, 0.3])


def test_a_step_is_a_ramp_and_a_fault_ramps_back():
    feedback = LeaderFeedback(2, FeedbackSettings(**OPEN | dict(slew_nm_s=5.0)))
    ramp = [steady(feedback, [1.0, -1.0], [0, 0]) for _ in range(12)]
    assert np.array(ramp)[:, 0] == pytest.approx(np.minimum(0.1 * np.arange(1, 13), 1.0))
    assert np.array(ramp)[:, 1] == pytest.approx(-np.array(ramp)[:, 0])
    down = [feedback.step([1.0, -1.0], [0, 0], [0, 0], DT, healthy=False) for _ in range(11)]
    assert np.array(down)[:, 0] == pytest.approx(np.maximum(1 - 0.1 * np.arange(1, 12), 0), abs=1e-12)


@pytest.mark.parametrize("tau, sigma", [((np.nan, 1.0), (0.0, 0.0)), ((1.0, 1.0), (np.nan, 0.0))])
def test_a_joint_that_is_not_known_fades_and_the_others_stay(tau, sigma):
    feedback = LeaderFeedback(2, FeedbackSettings(**OPEN | dict(slew_nm_s=5.0)))
    steady(feedback, [1.0, 1.0], [0, 0], 10)
    assert steady(feedback, tau, sigma) == pytest.approx([0.9, 1.0])
    assert steady(feedback, tau, sigma, 9) == pytest.approx([0.0, 1.0], abs=1e-12)


def test_a_leader_that_is_not_seen_gets_nothing_at_once_and_its_energy_is_charged():
    feedback = LeaderFeedback(1, FeedbackSettings(cap_nm=0.5, dead_band_sigmas=0.0, slew_nm_s=BIG))
    before = steady(feedback, [0.3], [0.0], 3)
    full = feedback.tank.energy_j
    assert before == pytest.approx([0.3])
    assert feedback.step([0.3], [0.0], [np.nan], DT) == [0.0]
    assert feedback.tank.energy_j == pytest.approx(full - 0.3 * 20.0 * DT**2)
    assert feedback.step([0.3], [0.0], [5.0], DT) != 0.0  # back, and the jump of 5 rad is nobody's motion


def random_course(rng: np.random.Generator, ticks: int, most_rad_s2: float) -> np.ndarray:
    """Positions of three joints whose motion from tick to tick changes by no more than an acceleration."""
    moved, q = np.zeros(3), np.zeros((ticks, 3))
    for k in range(1, ticks):
        moved = np.clip(moved + rng.uniform(-1, 1, 3) * most_rad_s2 * DT**2, -8 * DT, 8 * DT)
        q[k] = q[k - 1] + moved
    return q


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 6))])
@pytest.mark.parametrize("along", [False, True])
def test_never_gives_more_than_tank_and_friction_hold(seed, along):
    """By work added up here, for torques at random and for those that always push along the motion."""
    rng = np.random.default_rng(seed)
    friction = np.array([0.0, 0.02, 0.05])
    settings = FeedbackSettings(
        cap_nm=2.0, dead_band_sigmas=0.0, slew_nm_s=100.0, tank_j=0.01, rest_w=0.0, friction_nm=tuple(friction)
    )
    feedback = LeaderFeedback(3, settings)
    q = random_course(rng, 3000, settings.acceleration_rad_s2)
    torque, given, taken, most = np.zeros(3), 0.0, 0.0, -np.inf
    for k in range(len(q)):
        moved = q[k] - q[k - 1] if k else np.zeros(3)
        given, taken = given + torque @ moved, taken + friction @ np.abs(moved)
        most = max(most, given - taken)
        wish = 3 * np.sign(moved) if along else rng.normal(0, 1.5, 3)
        torque = feedback.step(wish, np.zeros(3), q[k], DT)
    assert most <= 0.01 + 1e-9 and feedback.tank.energy_j >= -1e-9
    assert feedback.tank.given_j == pytest.approx(given)


def test_what_is_rougher_than_was_declared_overdraws_the_tank_by_no_more_and_shuts_it():
    feedback = LeaderFeedback(
        1, FeedbackSettings(cap_nm=0.5, dead_band_sigmas=0, slew_nm_s=BIG, tank_j=0.001, rest_w=0.0)
    )
    held = feedback.step([0.5], [0], [0.0], DT)[0]
    feedback.step([0.5], [0], [0.5], DT)  # 1250 rad/s^2
    assert feedback.tank.energy_j == pytest.approx(0.001 - held * 0.5)
    assert feedback.step([0.5], [0], [0.6], DT) == 0.0


def test_who_presses_against_a_torque_always_feels_it():
    """An empty tank takes nothing from a hand that moves against the torque."""
    feedback = LeaderFeedback(
        1, FeedbackSettings(cap_nm=0.5, dead_band_sigmas=0, slew_nm_s=BIG, tank_j=1e-12, rest_w=0.0)
    )
    feedback.step([0.0], [0], [0.0], DT)
    for k in range(1, 4):
        assert feedback.step([-0.4], [0], [0.02 * k], DT) == pytest.approx(-0.4)  # 1 rad/s


def test_the_trickle_comes_at_rest_alone():
    settings = dict(dead_band_sigmas=0.0, slew_nm_s=BIG, tank_j=0.02, rest_w=0.01, rest_s=0.2, rest_rad=0.005)
    feedback = LeaderFeedback(1, FeedbackSettings(**settings))
    feedback.tank.energy_j = 0.0
    for k in range(101):  # moves once in ten ticks, in half of what makes a rest
        feedback.step([0.0], [0.0], [0.02 if k % 10 == 0 else 0.004], DT)
    assert feedback.tank.energy_j == 0.0
    for _ in range(40):
        feedback.step([0.0], [0.0], [0.018], DT)  # three steps of an encoder beside the last one: no motion
    assert feedback.tank.energy_j == pytest.approx((40 * DT - 0.2) * 0.01, abs=2 * DT * 0.01)


def wall_behind_a_delay(feedback: LeaderFeedback, delay_ticks: int) -> np.ndarray:
    """A light leader that a loose hand draws 0.1 rad into a wall of 8 N m/rad, seen late: positions, 10 s."""
    inertia, hand, damping, step_s = 0.03, 2.0, 0.02, 1e-3
    q = dq = 0.0
    seen = [0.0] * (2 * delay_ticks + 1)
    course = []
    for tick in range(500):
        seen = [*seen[1:], -8.0 * max(q - 0.05, 0.0)]
        torque = feedback.step([seen[0]], [0.0], [q], DT)[0]
        wanted = 0.15 * min(tick * DT, 1.0)
        for _ in range(round(DT / step_s)):
            dq += step_s * (hand * (wanted - q) - damping * dq + torque) / inertia
            q += step_s * dq
        course.append(q)
    return np.array(course)


@pytest.mark.parametrize("delay_ticks", [1, 2, 3])
def test_no_delay_makes_a_stiff_wall_swing_up(delay_ticks):
    settings = dict(cap_nm=1.0, dead_band_sigmas=0.0)
    free = wall_behind_a_delay(LeaderFeedback(1, FeedbackSettings(**settings, tank_j=BIG)), delay_ticks)
    kept = wall_behind_a_delay(LeaderFeedback(1, FeedbackSettings(**settings)), delay_ticks)
    assert np.ptp(free[-100:]) > 1.5  # without a tank it swings up to the cap
    assert np.ptp(kept[-100:]) < 0.3 * np.ptp(kept[50:150]) + 0.01


def test_free_motion_within_its_dead_band_is_not_felt_at_all():
    rng = np.random.default_rng(3)
    sigma = 0.01 + 0.02 * rng.random((2000, 2))
    tau = sigma * rng.standard_t(4, (2000, 2))
    sigmas = free_motion_sigmas(np.vstack([tau, [[np.nan, 1.0]]]), np.vstack([sigma, [[0.1, np.nan]]]))
    assert sigmas == pytest.approx(1.5 * (np.abs(tau) / sigma).max(axis=0))
    feedback = LeaderFeedback(2, FeedbackSettings(dead_band_sigmas=sigmas))
    assert not any(feedback.step(t, s, rng.normal(size=2), DT).any() for t, s in zip(tau, sigma, strict=True))


@pytest.mark.parametrize(
    "wrong, said",
    [
        (dict(cap_nm=0.0), "cap_nm = 0.0 must be > 0 and finite"),
        (dict(gain=(1.0, 0.0)), r"gain = \(1.0, 0.0\) must be finite and not 0"),
        (dict(tank_j=np.nan), "tank_j = nan must be > 0"),
        (dict(dead_band_sigmas=-1.0), "dead_band_sigmas = -1.0 must be >= 0"),
        (dict(friction_nm=()), r"friction_nm = \(\) must be >= 0"),
        (dict(gain=(1.0, 1.0, 1.0)), "gain has 3 values and the arm 2 joints"),
    ],
)
def test_settings_that_cannot_be_are_refused(wrong, said):
    with pytest.raises(ConfigError, match=said):
        LeaderFeedback(2, FeedbackSettings(**wrong))


def test_a_tick_that_cannot_be_is_refused():
    feedback = LeaderFeedback(2)
    with pytest.raises(ConfigError, match=r"sigma has shape \(1,\) and must have \(2,\)"):
        feedback.step([0, 0], [0], [0, 0], DT)
    for dt in (0.0, -0.1, np.nan, np.inf):
        with pytest.raises(ConfigError, match="dt_s"):
            feedback.step([0, 0], [0, 0], [0, 0], dt)
    with pytest.raises(ConfigError, match="there are none"):
        free_motion_sigmas(np.full((3, 1), np.nan), np.ones((3, 1)))
