"""Motion that training never saw is told, the like of training is not; cpp/tests/coverage_test.cpp tests the law."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from made_arms import planar_arm, prismatic_mass
from test_few_data import motion as smooth_motion
from test_few_data import trained

from tauext import _core
from tauext.cli import main
from tauext.data.recording import Recording
from tauext.data.recording_file import save_recording
from tauext.fit.coverage import Motion, coverage_facts, fit_coverage
from tauext.fit.training_set import Setup
from tauext.monitor.explanation import unfamiliar

RATE_HZ = 50.0
SEVEN, RANGE_RAD = 7, 2.4
MONITOR = {"speed": 1, "position": 2, "positions": 3}


def setup_of(tree: _core.Tree, joints: int) -> Setup:
    """Of an arm with so many joints like the tree's first one: kinds of joints are all that counts here."""
    period_ns = round(1e9 / RATE_HZ)
    settings = _core.ObserverSettings(
        gain_per_s=20.0, timing=_core.TorqueTiming.averaged, sample_period_ns=period_ns, network_stride=1
    )
    links = [tree.links[0] for _ in range(joints)]
    for k, link in enumerate(links):
        link.joint_name, link.parent = f"joint{k + 1}", k - 1
    return Setup(_core.Tree(links, tree.gravity), settings, 1)


def moves(seed: int, minutes: float, joints: int = SEVEN, share: float = 1.0, targets=None) -> Recording:
    """Quintic moves of all joints together between poses drawn at random, 0.3 to 1.2 rad/s times `share` at the most,
    with pauses.

    Args:
        targets: draws a pose from a random generator; None: every joint within RANGE_RAD.
    """
    rng = np.random.default_rng(seed)
    draw = targets or (lambda rng: rng.uniform(-RANGE_RAD, RANGE_RAD, joints))
    here, q, dq, wanted = draw(rng), [], [], round(60 * minutes * RATE_HZ)
    while sum(map(len, q)) < wanted:
        there = draw(rng)
        seconds = max(0.3, np.abs(there - here).max() * 15 / 8 / (share * rng.uniform(0.3, 1.2)))
        x = np.minimum(np.arange(round((seconds + rng.uniform(0, 1)) * RATE_HZ)) / (seconds * RATE_HZ), 1)[:, None]
        q.append(here + (10 * x**3 - 15 * x**4 + 6 * x**5) * (there - here))
        dq.append(30 * (x * (1 - x)) ** 2 * (there - here) / seconds)
        here = there
    q, dq = np.concatenate(q)[:wanted], np.concatenate(dq)[:wanted]
    t_ns = np.arange(wanted, dtype=np.int64) * round(1e9 / RATE_HZ)
    names = tuple(f"joint{k + 1}" for k in range(joints))
    return Recording(f"moves-{seed}", names, t_ns, q, dq, 0 * q, RATE_HZ, "averaged", "test", "")


def told(settings: _core.CoverageSettings, recording: Recording, samples=slice(None)) -> np.ndarray:
    """Which samples are called unfamiliar by themselves."""
    said = settings.look(np.ascontiguousarray(recording.q[samples]), np.ascontiguousarray(recording.dq[samples]))
    return said["share"] >= settings.WORTH_TELLING


@pytest.fixture(scope="module")
def seven():
    """Twelve minutes of a seven-axis arm in four recordings, and what they show."""
    recordings = [moves(seed, 3.0) for seed in range(4)]
    return recordings, fit_coverage(setup_of(planar_arm(), SEVEN), recordings)


def test_twelve_minutes_make_other_motion_of_the_kind_familiar(seven):
    _, fit = seven
    assert fit.left_out_share < 0.02 and min(fit.settings.reach) > 0
    # At most 1 % of eight other recordings of the same motion.
    assert np.mean([told(fit.settings, moves(seed, 3.0)).mean() for seed in range(10, 18)]) < 0.01


def test_speeds_beyond_training_are_reported_and_named(seven):
    recordings, _ = seven
    slow = fit_coverage(setup_of(planar_arm(), SEVEN), [moves(seed, 3.0, share=0.6) for seed in range(4)]).settings
    fast = recordings[0]
    beyond = (np.abs(fast.dq) > 1.15 * np.array(slow.fastest_rad_s)).any(axis=1)
    assert beyond.sum() > 100 and told(slow, fast, beyond).mean() > 0.95
    at = int(np.flatnonzero(beyond)[0])
    said = slow.look(fast.q[at : at + 1], fast.dq[at : at + 1])
    assert said["what"][0] == MONITOR["speed"] and said["other"][0] == -1
    assert abs(fast.dq[at, said["joint"][0]]) > 1.15 * slow.fastest_rad_s[said["joint"][0]]


def test_an_unseen_half_of_a_joint_s_range_is_reported_and_named():
    def half(rng):
        pose = rng.uniform(-RANGE_RAD, RANGE_RAD, SEVEN)
        pose[1] = -abs(pose[1])
        return pose

    settings = fit_coverage(
        setup_of(planar_arm(), SEVEN), [moves(seed, 3.0, targets=half) for seed in range(4)]
    ).settings
    whole = moves(9, 6.0)
    there = whole.q[:, 1] > 0
    assert told(settings, whole, there).mean() > 0.5 and told(settings, whole, ~there).mean() < 0.02
    far = np.flatnonzero(whole.q[:, 1] > 1.2)
    said = settings.look(np.ascontiguousarray(whole.q[far]), np.ascontiguousarray(0 * whole.dq[far]))
    named = (said["what"] == MONITOR["position"]) & (said["joint"] == 1)
    assert (named | (said["what"] == MONITOR["positions"])).all() and named.mean() > 0.9


def test_positions_that_were_never_together_are_reported_though_each_was_seen():
    def beside(rng):
        return np.full(2, rng.uniform(-RANGE_RAD, RANGE_RAD)) + rng.uniform(-0.3, 0.3, 2)

    settings = fit_coverage(setup_of(planar_arm(), 2), [moves(k, 3.0, 2, targets=beside) for k in range(4)]).settings
    across = moves(9, 3.0, 2, targets=lambda rng: np.array([1, -1]) * rng.uniform(-RANGE_RAD, RANGE_RAD))
    apart = np.abs(across.q[:, 0] - across.q[:, 1]) > 1.5
    said = settings.look(np.ascontiguousarray(across.q[apart]), np.ascontiguousarray(0 * across.q[apart]))
    assert (said["share"] == 1).mean() > 0.9
    assert set(said["what"].tolist()) <= {0, MONITOR["positions"]} and said["other"].max() == 1
    assert not told(settings, moves(10, 1.0, 2, targets=beside)).any()


def test_a_sliding_joint_has_its_cells_along_twice_its_way():
    recordings = [moves(k, 3.0, 1, targets=lambda rng: rng.uniform(0.2, 0.6, 1)) for k in range(4)]
    fit = fit_coverage(setup_of(prismatic_mass(1.0), 1), recordings)
    assert fit.settings.turns == [0] and fit.settings.reach_together == 0
    np.testing.assert_allclose(fit.settings.centre_rad, 0.4, atol=0.02)
    np.testing.assert_allclose(fit.settings.span_rad, 0.8, atol=0.04)
    q = np.array([[-9.0], [0.0], [0.19], [0.4], [0.61], [0.8], [9.0]])
    assert fit.settings.look(q, 0 * q)["share"].tolist() == [1, 1, 0, 0, 0, 1, 1]
    facts = coverage_facts(fit, ("slide",))
    assert facts["reach_rad"]["slide"] == pytest.approx(fit.settings.reach[0] * fit.settings.span_rad[0] / 64)


def test_a_lone_wrong_speed_in_training_does_not_hide_fast_motion():
    made = moves(0, 1.0)
    dq = made.dq.copy()
    dq[500] = 50.0
    assert Motion.of([replace(made, dq=dq)], 1).lasting.max() < 2


def test_a_sample_is_enough_to_say_nothing():
    made = moves(0, 1 / 60 / RATE_HZ)
    fit = fit_coverage(setup_of(planar_arm(), SEVEN), [made])
    assert fit.settings.reach == [0] * SEVEN and fit.settings.reach_together == 0 and fit.left_out_share == 0


@pytest.fixture(scope="module")
def watching(tmp_path_factory):
    """A bundle of recipe prior, and a motion that is twice as fast in its second half."""
    folder = tmp_path_factory.mktemp("coverage")
    with pytest.MonkeyPatch.context() as patch:
        bundle, facts = trained(folder, patch, [smooth_motion(seconds=45.0, seed=k) for k in range(3)], recipe="prior")
    made = smooth_motion(seconds=20.0, seed=1)
    fast = np.arange(made.samples)[:, None] >= made.samples // 2
    made = replace(made, name="fast", dq=np.where(fast, 3 * made.dq, made.dq))
    save_recording(made, folder / "fast.parquet")
    return folder, bundle, facts, made


def test_the_monitor_tells_it_and_widens_its_limits_by_a_capped_share(watching):
    _, bundle, facts, made = watching
    assert facts["coverage"]["fastest_rad_s"]["elbow"] == bundle.coverage.fastest_rad_s[1]
    signals = made.signals
    said, look = _core.Monitor(bundle).run(*signals), bundle.coverage.look(made.q, made.dq)
    assert (said["unfamiliar"] >= look["share"] - 1e-12).all()
    half = made.samples // 2
    assert (said["unfamiliar"][:half] < 0.5).mean() > 0.99 and (said["unfamiliar"][half:] == 1).mean() > 0.2
    # What one of the two detects or learns of friction changes its limits afterwards.
    bundle.after_contact_factor, bundle.drift.friction_share = 1.0, 0.0
    said = _core.Monitor(bundle).run(*signals)
    plain = _core.Bundle.from_bytes(bundle.to_bytes())
    plain.coverage = _core.CoverageSettings()
    without = _core.Monitor(plain).run(*signals)
    assert not without["unfamiliar"].any() and not without["unseen"].any()
    factor = 1 + 0.5 * said["unfamiliar"][:, None]
    np.testing.assert_allclose(said["limit_scale"], without["limit_scale"] * factor, rtol=1e-12)
    warm = said["health"] == 1
    raised = (said["limit_nm"] - said["doubt"]) / (without["limit_nm"] - without["doubt"])
    np.testing.assert_allclose(raised[warm], np.broadcast_to(factor, raised.shape)[warm], rtol=1e-9)


def test_run_and_show_say_what_was_unfamiliar(watching, capsys):
    folder, bundle, _, made = watching
    files = (str(folder / "made.tauext"), str(folder / "fast.parquet"))
    main(["run", *files])
    text = " ".join(capsys.readouterr().out.split())
    assert "of the motion was out-of-distribution: speed of" in text and "WARNING" in text
    main(["run", *files, "--json", "--status-hz", "10"])
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    said = _core.Monitor(bundle).run(*made.signals)
    told = said["unfamiliar"] >= 0.5
    summary = events[-1]
    assert summary["unfamiliar_share"] == pytest.approx(told.mean())
    assert sum(part["share"] for part in summary["unfamiliar"]) == pytest.approx(told.mean())
    first = summary["unfamiliar"][0]
    assert first["what"] == "speed" and first["joint"] in made.joints and first["other"] is None
    status = [event["unfamiliar"] for event in events if event["event"] == "status"]
    assert max(status) == 1 and min(status) == 0
    main(["show", files[0]])
    shown = " ".join(capsys.readouterr().out.split())
    assert "fastest in training [rad/s]" in shown and "familiar within" in shown


@pytest.mark.parametrize(
    ("share", "unseen", "other", "words"),
    [
        (0.4, _core.Unseen.speed, -1, ""),
        (0.5, _core.Unseen.speed, -1, "(speed of elbow)"),
        (1.0, _core.Unseen.position, -1, "(position of elbow)"),
        (1.0, _core.Unseen.positions, 0, "(elbow and shoulder together)"),
    ],
)
def test_the_explanation_of_an_alarm_says_what_training_never_saw(share, unseen, other, words):
    event = SimpleNamespace(unfamiliar=share, unseen=unseen, unseen_joint=1, unseen_other=other)
    told = unfamiliar({"event": event}, SimpleNamespace(joints=("shoulder", "elbow")))
    assert told == (
        f"The training data do not contain such motion {words}: the estimate may be wrong." if words else ""
    )


def test_other_recipes_know_nothing_of_it(tmp_path, monkeypatch):
    bundle, facts = trained(tmp_path, monkeypatch, [smooth_motion(seconds=20.0)], recipe="friction")
    assert bundle.coverage.empty and "coverage" not in facts


def test_settings_that_do_not_fit_are_refused(watching):
    _, bundle, *_ = watching
    with pytest.raises(Exception, match="dq must have the shape"):
        bundle.coverage.look(np.zeros((3, 2)), np.zeros((2, 2)))
    with pytest.raises(Exception, match="set speeds and cells"):
        _core.CoverageSettings().see(np.zeros((3, 2)))
