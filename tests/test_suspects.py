"""Touches that nobody reported: found in motion with forces put into it by the Jacobian, and errors that are none."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import gammaincinv
from tauext_lab.sim.arms import rig_arm
from tauext_lab.sim.collect import simulate_recording
from tauext_lab.sim.config import RigConfig

from tauext import _core
from tauext.config import PAPER_CASES, AlarmConfig, PriorConfig, TrainConfig
from tauext.data.free_motion import cut, free_samples
from tauext.data.labels import Label
from tauext.fit.tail import promised_per_hour
from tauext.train.limits import LIMITS
from tauext.train.paper_limits import LimitMotion
from tauext.train.preparation import TrainingInput
from tauext.train.stage import accepted_settings, train_on_recordings
from tauext.train.suspects import are_same, search, suspect_level, suspect_sentences, without_suspects

RATE_HZ = 1000


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("tail", ["half a Gaussian", "exponential", "two kinds of motion"])
def test_touches_hardly_move_the_level_that_free_motion_hardly_exceeds(tail, seed):
    """An hour of peaks with 60 touches of any size; a push or a hold has several peaks."""
    rng = np.random.default_rng(seed)
    free = np.abs(rng.normal(size=3600)) if tail == "half a Gaussian" else rng.exponential(size=3600)
    if tail == "two kinds of motion":
        free *= np.where(rng.uniform(size=3600) < 0.05, 1.5, 1.0)
    touches = np.quantile(free, 0.75) * np.exp(rng.uniform(np.log(2), np.log(50), 120))
    clean, touched = (suspect_level(np.sort(values)[::-1]) for values in (free, np.append(free, touches)))
    assert (free > clean).sum() <= 2 and (free > touched).sum() <= 4
    assert 0.65 * clean < touched < 1.65 * clean < 4 * free.max()


def test_too_few_peaks_have_no_level():
    assert np.isinf(suspect_level(np.arange(20.0)[::-1])) and np.isinf(suspect_level(np.ones(500)))


@pytest.fixture(scope="module")
def motion():
    """Eighty seconds without labels, in which nothing touches the arm."""
    made = simulate_recording(RigConfig(), "free", 80.0, 3, 0)
    return replace(made, tau_ext=None, contact=None, contact_link=None, q_des=None, tau_ext_sensor=None)


def trained(recording, out):
    """The bundle of a training on this recording, and its suspects."""
    robot = out.with_suffix(".xml")
    robot.write_text(rig_arm().xml)
    settings = TrainConfig(recipe="prior", threads=1, prior=PriorConfig(most_ripples=0))
    given = TrainingInput(robot, PAPER_CASES["exact"], [recording])
    suspects = train_on_recordings(given, accepted_settings(settings, ()), out)
    return _core.Bundle.from_bytes(Path(out).read_bytes()), suspects


@pytest.fixture(scope="module")
def clean(motion, tmp_path_factory):
    """The bundle of the untouched motion."""
    bundle, suspects = trained(motion, tmp_path_factory.mktemp("clean") / "clean.tauext")
    assert len(suspects) <= 1  # the level is exceeded 0.1 times in each of four regions
    return bundle


def touched(motion, bundle, at_s=60.0, newtons=25.0, seconds=0.4):
    """The motion with a push on the last link: a half sine of force, by the Jacobian of its point."""
    model, rows = _core.WrenchModel(bundle), slice(round(at_s * RATE_HZ), round((at_s + seconds) * RATE_HZ))
    frame, push = bundle.links[-1].joint_name, newtons * np.sin(np.linspace(0, np.pi, rows.stop - rows.start))
    tau = motion.tau.copy()
    for row, force_n in zip(range(rows.start, rows.stop), push, strict=True):
        columns = model.columns(frame, motion.q[row].tolist(), [0.2, 0.0, 0.0])  # torques of unit forces
        across = int(np.argmax(np.abs(columns[:3]).min(axis=1)))  # the way that turns both joints most
        tau[row] -= force_n * columns[across]
    return replace(motion, tau=tau)


def after_reversals(motion, joint, torque_nm=4.0, seconds=0.15):
    """The motion with an error of one joint's friction after its reversals, against its new way."""
    tau, dq = motion.tau.copy(), motion.dq[:, joint]
    later = np.sign(np.where(np.abs(dq) > 0.03, dq, 0.0))
    moving = np.flatnonzero(later)
    turns = moving[1:][later[moving[1:]] != later[moving[:-1]]]  # the first sample of the new way
    turns = turns[np.diff(turns, prepend=-RATE_HZ) > RATE_HZ]
    for row in turns.tolist():
        tau[row : row + round(seconds * RATE_HZ), joint] += torque_nm * later[row]
    assert 4 <= len(turns) <= 40
    return replace(motion, tau=tau)


@pytest.mark.slow
def test_a_force_on_a_link_is_a_suspect_with_its_joints_and_its_link(motion, clean):
    (one,) = search(clean, [touched(motion, clean)])
    assert one.span[0] - motion.t_ns[0] < 60.15e9 and one.span[1] - motion.t_ns[0] > 60.3e9
    assert 0.1 < 1e-9 * (one.span[1] - one.span[0]) < 4.0  # stuck joints keep some of it
    assert one.joints == motion.joints and one.link in motion.joints and one.times > 2
    assert one.is_evident and not replace(one, joints=one.joints[:1], times=1.3).is_evident
    first, second = suspect_sentences([one])
    assert first.startswith("1 unlabelled contact, ") and first.endswith("set `contact` to 0 there")
    assert f"fits a force on the link of {one.link}" in second and repr(motion.name) in second


@pytest.mark.slow
@pytest.mark.parametrize("joint", [0, 1])
def test_friction_of_one_joint_after_reversals_is_none(motion, clean, joint):
    assert len(search(clean, [after_reversals(motion, joint)])) <= len(search(clean, [motion]))


def test_an_error_that_the_motion_repeats_is_none(motion, clean):
    program = [replace(motion, name=f"turn-{k}") for k in range(3)]
    once = [touched(program[0], clean), *program[1:]]
    assert [one.recording for one in search(clean, once)] == ["turn-0"]
    assert not search(clean, [touched(one, clean) for one in program])


def test_motion_that_a_person_called_free_is_never_suspected(motion, clean):
    pushed = touched(motion, clean)
    assert not search(clean, [replace(pushed, contact=np.zeros(motion.samples, dtype=np.int8))])  # as messages advise
    kept = replace(pushed, provenance=motion.provenance | {"epoch": 4})
    begin = int(motion.t_ns[0])
    label = Label(-2, 4, begin + 60_100_000_000, begin + 60_200_000_000, "nothing", "page", "")
    assert len(search(clean, [kept])) == len(search(clean, [kept], [replace(label, epoch=5)])) == 1
    assert not search(clean, [kept], [label])


@pytest.mark.slow
def test_training_leaves_the_touch_out_and_counts_it_in_the_promise(motion, clean, tmp_path):
    pushed = touched(motion, clean, newtons=60.0)
    bundle, suspects = trained(pushed, tmp_path / "touched.tauext")
    assert are_same(suspects[:1], search(clean, [pushed])[:1])
    assert np.max(np.array(bundle.sliding_limit_nm) / clean.sliding_limit_nm) < 1.3
    labelled = without_suspects([pushed], suspects)[0]
    assert not free_samples(labelled)[60_100:60_300].any() and free_samples(labelled).mean() > 0.97
    assert '"suspects"' in bundle.provenance and "if it was none" in bundle.provenance


def test_calibration_gives_the_promise_with_and_without_suspects(motion, clean):
    bundle = _core.Bundle.from_bytes(clean.to_bytes())
    heard = []
    parts = [cut(motion, slice(0, 40_000)), cut(motion, slice(40_000, 80_000))]
    loaders = [lambda: parts[0], lambda: parts[1]]
    limits = LimitMotion("x", AlarmConfig(), 1, note=heard.append, calibration=loaders)
    LIMITS["promised"](bundle, limits)
    free = bundle.sliding_limit_nm
    parts[1] = touched(parts[1], clean, at_s=20.0, newtons=60.0)
    facts = LIMITS["promised"](bundle, limits)
    assert facts["suspects"] == facts["suspected"]["count"] == 1
    hours = facts["promise"]["calibration_hours"]  # of a single touch or none, at 95 % [Garwood1936]
    assert promised_per_hour(facts) == pytest.approx(gammaincinv(1, 0.95) / hours)
    assert facts["bound_per_hour"] == pytest.approx(gammaincinv(2, 0.95) / hours)
    assert "1 unlabelled contact is left out: at most 1 in" in facts["sentence"]
    assert "if it was none, 1 in" in facts["sentence"]
    np.testing.assert_allclose(bundle.sliding_limit_nm, free, rtol=0.15)
    assert any(one.startswith("1 unlabelled contact") for one in heard)
