"""Training on what people have: one recording, contacts in it, currents, an arm that stands still."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_arms import no_model, planar_arm, planar_torque

from tauext import _core
from tauext.cli import main
from tauext.config import PAPER_CASES, AlarmConfig, ObserverConfig, PriorConfig, TrainConfig
from tauext.data.recording import Recording
from tauext.errors import BundleError, ConfigError, TrainingError
from tauext.fit.bundle_writing import build_setup
from tauext.fit.regression import NormalEquations, Regression, coupled
from tauext.fit.torque_constants import TorqueConstants, fit_torque_constants, with_constants
from tauext.monitor.estimate import estimate_recording
from tauext.train.limits import LIMITS, limit_findings, put_limits
from tauext.train.paper_limits import LimitMotion
from tauext.train.preparation import TrainingInput, training_motion, wants_constants
from tauext.train.stage import train_on_recordings
from tauext.train.supported_limits import NOT_MEASURED, factor_after

RATE_HZ = 125.0
EXACT = PAPER_CASES["exact"]
AMPERES = {"torque": "amperes: the torque constant is unknown"}


def motion(seconds: float = 40.0, seed: int = 0, name: str = "made", still: bool = False, **changes) -> Recording:
    """Two joints on a smooth way of many sines, friction and noise of the torque."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    speeds, phases = rng.uniform(0.3, 2.5, (2, 5)), rng.uniform(0, 6, (2, 5))
    angle = t[:, None, None] * speeds + phases
    q, dq = np.sin(angle).sum(axis=2) * 0.5, (speeds * np.cos(angle)).sum(axis=2) * 0.5
    if still:
        q, dq = np.zeros_like(q) + [0.3, 0.4], np.zeros_like(dq)
    torque = planar_torque(q, dq) + 3 * np.tanh(dq / 0.03) + 2 * dq + rng.normal(0, 0.1, q.shape)
    named = {"name": name, "joints": ("shoulder", "elbow"), "t_ns": np.arange(len(t), dtype=np.int64) * 8_000_000}
    meta = {"rate_hz": RATE_HZ, "torque_timing": "averaged", "source": "test", "robot_sha256": ""}
    return Recording(**(named | {"q": q, "dq": dq, "tau": torque} | meta | changes))


def trained(tmp_path: Path, monkeypatch, training, validation=(), **settings):
    """The bundle and its facts, with limits of torque left unknown; no motion made here has ripple to look for."""
    settings = {"prior": PriorConfig(most_ripples=0)} | settings
    monkeypatch.setattr("tauext.train.preparation.torque_limits", lambda robot, joints: np.full(len(joints), np.inf))
    out = tmp_path / "made.tauext"
    train_on_recordings(
        TrainingInput(Path(), EXACT, list(training), list(validation), model=planar_arm()), TrainConfig(**settings), out
    )
    bundle = _core.Bundle.load(str(out))
    return bundle, json.loads(bundle.provenance)


def test_limits_from_seconds_prove_nothing_and_are_shown_so(tmp_path, monkeypatch, capsys):
    trained(tmp_path, monkeypatch, [motion(seconds=6.0)], recipe="prior")
    assert main(["show", str(tmp_path / "made.tauext")]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "Thresholds are set for 1 in 8 h, extrapolated from" in told and "So short a time proves nothing" in told


def test_gate_and_limits_are_judged_by_the_signal_ranges_that_ship(tmp_path, monkeypatch):
    """Those of all training recordings, and not of the one whose window the bundle keeps."""
    still, moving = motion(seconds=10.0, still=True, name="still"), motion()
    seen = []

    def watched(run, bundle, setup, fit):
        seen.append(bundle.largest_torque_nm)
        put_limits(run, bundle, setup, fit)

    monkeypatch.setattr("tauext.train.stage.put_limits", watched)
    bundle, _ = trained(tmp_path, monkeypatch, [still, moving], recipe="prior")
    assert seen == [bundle.largest_torque_nm] == [np.abs(np.vstack([still.tau, moving.tau])).max(axis=0).tolist()]


def test_one_recording_is_enough_and_the_run_file_says_how_it_was_used(tmp_path, monkeypatch):
    bundle, facts = trained(tmp_path, monkeypatch, [motion()], recipe="prior")
    assert any("each fifth of the motion" in note for note in facts["notes"])
    assert facts["limits"]["minutes_factor"] > 1 and facts["error_scale"]["hours"] > 0
    assert facts["limits"]["other_motion"] == NOT_MEASURED and NOT_MEASURED["sentence"] in facts["notes"]
    assert facts["standing"]["sentence"] in facts["notes"] and len(facts["standing"]["places"]) == 2
    other = motion(seed=7)
    said = _core.estimate(bundle, *other.signals, 1)
    healthy = said["health"] == 1
    assert healthy.sum() > 4000 and not said["detection"][healthy].any()
    # What is left of friction and model on another motion is the torque's noise behind the observer, and little more.
    assert (np.sqrt((said["tau_ext"][healthy] ** 2).mean(axis=0)) < 0.3).all()


@pytest.mark.slow
def test_the_run_file_and_show_report_how_limits_hold_from_one_recording_to_the_next(tmp_path, monkeypatch, capsys):
    _, facts = trained(
        tmp_path, monkeypatch, [motion(seed=k, name=f"made-{k}") for k in range(4)], recipe="prior", limits="supported"
    )
    other = facts["limits"]["other_motion"]
    assert set(other["false"]) == {f"made-{k}" for k in range(4)} and other["promised"] == pytest.approx(3, rel=0.1)
    assert other["factor"] == sum(other["false"].values()) / other["promised"] and other["sentence"] in facts["notes"]
    assert main(["show", str(tmp_path / "made.tauext")]) == 0
    assert "Each recording was evaluated with thresholds from the others" in " ".join(capsys.readouterr().out.split())


def test_the_factor_of_minutes_grows_as_the_reserve_of_friction_fades():
    """1 at no time at all, within 2 % of its most after a quarter of an hour; both sum up to a whole at any time."""
    assert factor_after(0.0, 1.4) == 1.0 and factor_after(900.0, 1.4) == pytest.approx(1.4, rel=0.02)
    for minutes in (1.0, 4.0, 10.0):
        assert (factor_after(60 * minutes, 1.4) - 1) / 0.4 + np.exp(-minutes / 4) == pytest.approx(1.0)
    assert factor_after(600.0, 1.0) == 1.0


def test_validation_is_cut_off_by_time_with_a_gap_of_a_window_and_the_warm_up():
    made = motion()
    parts = training_motion([made], [], TrainConfig(recipe="dense"))
    assert [len(some) for some in (parts.training, parts.validation, parts.for_limits, parts.uncut)] == [1, 1, 1, 1]
    gap_s = (parts.validation[0].t_ns[0] - parts.training[0].t_ns[-1]) * 1e-9
    assert gap_s >= 1.5 and parts.validation[0].duration_s == pytest.approx(0.2 * made.duration_s, abs=0.01)
    assert parts.uncut[0] is made and any("last 20%" in note for note in parts.notes)
    with pytest.raises(TrainingError, match="5.0 s, is too short to cut some off: 12.5 s are needed"):
        training_motion([motion(seconds=5.0)], [], TrainConfig(recipe="dense"))


def test_minutes_without_validation_recordings_get_no_network_and_all_of_them_are_fitted():
    made = motion()
    config = TrainConfig(recipe="tauext")
    parts = training_motion([made], [], config)
    assert not parts.network and parts.uncut[0] is made and any("no network" in note for note in parts.notes)
    assert training_motion([made], [motion(seed=1, name="other")], config).network


def test_a_contact_in_training_changes_nothing_of_what_is_learned_beside_it(tmp_path, monkeypatch):
    plain = motion()
    contact = np.zeros(plain.samples, dtype=np.int8)
    contact[2000:2200] = 1
    hit = replace(plain, tau=plain.tau - 40.0 * contact[:, None], contact=contact)
    parts = training_motion([hit], [], TrainConfig(recipe="prior"))
    assert len(parts.training) == 2 and all((piece.contact == 0).all() for piece in parts.training)
    bundle, facts = trained(tmp_path, monkeypatch, [hit], recipe="prior")
    assert max(bundle.sliding_limit_nm) < 5.0
    assert any("are left out: in contact" in note for note in facts["notes"])


def test_a_recording_whose_contact_is_unknown_throughout_is_not_trained_on():
    unknown = motion(contact=np.full(round(40.0 * RATE_HZ), -1, dtype=np.int8))
    with pytest.raises(TrainingError, match=r"contact = -1, unknown, in all samples of 1 training recordings"):
        training_motion([unknown], [], TrainConfig(recipe="prior"))
    assert training_motion([unknown, motion(seed=1)], [], TrainConfig(recipe="prior")).training[0].contact is None


def test_a_standing_arm_has_limits_at_rest_and_nothing_to_learn(tmp_path, monkeypatch):
    still = motion(seconds=10.0, still=True)
    with pytest.raises(TrainingError, match="no joint moves in any of 1 training recordings.*--recipe observer"):
        training_motion([still], [], TrainConfig())
    bundle, facts = trained(tmp_path, monkeypatch, [still], recipe="observer", limits="paper")
    assert any(note.startswith("thresholds at rest only: no joint moves") for note in facts["notes"])
    assert bundle.sliding_limit_nm == bundle.near_stiction_limit_nm and min(bundle.sliding_limit_nm) > 0


def test_a_joint_that_never_moves_beside_others_is_not_monitored(tmp_path, monkeypatch, capsys):
    """Locked: its torque says nothing. Its limits, which were those of rounding, stay infinite whatever sets limits."""
    made = [motion(seed=seed, name=f"made-{seed}") for seed in range(4)]
    locked = [replace(one, **{k: getattr(one, k) * [1.0, 0.0] for k in ("q", "dq", "tau")}) for one in made]
    bundle, facts = trained(tmp_path, monkeypatch, locked[:3], recipe="prior")
    assert bundle.monitored == [True, False] and np.isfinite(bundle.sliding_limit_nm[0])
    assert "elbow never moves in the recordings: not monitored" in " ".join(facts["notes"])
    assert not any("elbow" in name for name in facts["limits"]["tails"])
    moved = replace(made[3], tau=made[3].tau + [0.0, 30.0])
    estimates = estimate_recording(bundle, moved)
    assert np.isinf(estimates.limit_nm[200:, 1]).all() and np.isfinite(estimates.limit_nm[200:, 0]).all()
    assert (np.abs(estimates.tau_ext[200:, 1]) > 20).any() and not estimates.held_alarm.any()
    LIMITS["promised"](bundle, LimitMotion("made", AlarmConfig(), 1, calibration=[lambda: locked[3]]))
    assert bundle.monitored == [True, False] and np.isfinite(bundle.contact_sliding_limit_nm[0])
    assert main(["show", str(tmp_path / "made.tauext")]) == 0
    assert re.search(r"^not monitored +elbow$", capsys.readouterr().out, re.MULTILINE)
    assert main(["show", str(tmp_path / "made.tauext"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["limits_sliding_nm"]["elbow"] is None


def test_limits_of_little_use_are_found():
    bundle = _core.Bundle()
    bundle.links = planar_arm().links
    bundle.largest_torque_nm = [10.0, 10.0]
    for name in ("sliding", "contact_sliding"):
        setattr(bundle, f"{name}_limit_nm", [3.2, 0.2])
    for name in ("near_stiction", "contact_near_stiction"):
        setattr(bundle, f"{name}_limit_nm", [3.3, 0.3])

    def found(step_nm=0.0):
        return [
            (one.code, one.severity, one.joint)
            for one in limit_findings(bundle, {"torque_step_nm": {"elbow": step_nm}})
        ]

    assert found() == [] and found(0.19) == []
    assert found(0.21) == [("limit-fine", "fault", "elbow")]
    bundle.near_stiction_limit_nm = [3.3, 0.1]  # the lower one counts
    assert found(0.11) == [("limit-fine", "fault", "elbow")]
    bundle.near_stiction_limit_nm = [3.3, 0.3]
    bundle.largest_torque_nm = [9.8, 10.0]
    assert found() == [("limit-wide", "warning", "shoulder")]
    bundle.largest_torque_nm = [6.5, 10.0]
    assert found() == [("limit-wide", "fault", "shoulder")]  # half of the joints


def in_amperes(constants: np.ndarray) -> tuple[Recording, Recording]:
    """A minute of motion, and the same with the drives' currents, of an unknown torque constant."""
    torque = motion(seconds=60.0)
    return torque, replace(torque, tau=torque.tau / constants, provenance=AMPERES)


def test_currents_get_their_constants_back_and_the_core_applies_them():
    constants, links = np.array([9.0, -0.7]), planar_arm().links
    torque, current = in_amperes(constants)
    found = fit_torque_constants(planar_arm(), [current], ObserverConfig())
    for link in links:
        link.rotor_inertia = 0.0
    without_rotors = fit_torque_constants(_core.Tree(links, planar_arm().gravity), [current], ObserverConfig())
    assert found.determined.all()
    # Noise of 0.1 Nm on torques of tens of Nm; friction is fitted beside them.
    for one in (found, without_rotors):
        np.testing.assert_allclose(one.nm_per_unit, constants, rtol=0.01)
    setup = build_setup(planar_arm(), torque, ObserverConfig())
    arrays = (current.t_ns, current.q, current.dq)
    r = _core.observe(planar_arm(), with_constants(setup.observer, found), *arrays, current.tau).residual
    of_torque = _core.observe(planar_arm(), setup.observer, *arrays, current.tau * found.used).residual
    np.testing.assert_array_equal(r, of_torque)


def test_a_bundle_trained_on_currents_takes_them_and_answers_in_newton_metres(tmp_path, monkeypatch):
    constants, settings = np.array([9.0, -0.7]), {"recipe": "friction", "limits": "paper"}
    torque, current = in_amperes(constants)
    plain, _ = trained(tmp_path, monkeypatch, [torque], **settings)
    bundle, facts = trained(tmp_path, monkeypatch, [current], **settings)
    assert (plain.torque_units, bundle.torque_units) == (["N m", "N m"], ["A", "A"])
    assert bundle.estimate_units == ["N m", "N m"] and facts["torque_constants"]["used"] == bundle.observer.nm_per_unit
    np.testing.assert_allclose(bundle.largest_torque_nm, plain.largest_torque_nm, rtol=0.01)
    np.testing.assert_allclose(bundle.sliding_limit_nm, plain.sliding_limit_nm, rtol=0.1)
    with pytest.raises(BundleError, match="takes motor currents in amperes; recording made is in N m"):
        estimate_recording(bundle, replace(torque, provenance={"torque": "N m"}))
    # A push of 20 Nm on the elbow, in the drive's amperes.
    other = motion(seconds=20.0, seed=5)
    push = np.zeros_like(other.tau)
    push[1500:2000, 1] = -20.0
    arrays = (other.t_ns, other.q, other.dq)
    said = _core.Monitor(bundle).run(*arrays, (other.tau + push) / constants)["tau_ext"]
    np.testing.assert_allclose(said[1900, 1], 20.0, atol=2.0)


def test_a_constant_known_to_a_third_serves_and_is_called_a_guess():
    values = np.array([9.0, 4.0, 4.0]), np.array([0.1, 1.3, 3.0])
    found = TorqueConstants(*values, np.array([True, False, False]))
    assert found.used == [9.0, 4.0, 1.0]
    said = found.sentences(("a", "b", "c"))
    assert "Nm a unit of tau: a 9 ± 0.1" in said[0] and "b 4 ± 1 are guesses" in said[1] and "of c are" in said[2]


def test_a_constant_that_friction_drowns_is_reported_as_undetermined():
    made = motion(seconds=20.0)
    rng = np.random.default_rng(1)
    drowned = replace(made, tau=np.column_stack([made.tau[:, 0], rng.normal(0, 50, made.samples)]))
    found = fit_torque_constants(planar_arm(), [drowned], ObserverConfig())
    assert found.determined.tolist() == [True, False] and found.used[1] == 1.0
    assert "elbow are undetermined" in found.sentences(made.joints)[-1]


def test_without_a_model_the_ratios_of_the_constants_are_found():
    constants = np.array([9.0, 4.0])
    _, current = in_amperes(constants)
    found = fit_torque_constants(no_model(planar_arm()), [current], ObserverConfig())
    reference = found.relative_to
    assert found.determined.all() and found.used[reference] == 1
    np.testing.assert_allclose(found.nm_per_unit, constants / constants[reference], rtol=0.1)
    said = " ".join(found.sentences(current.joints))
    assert f"thresholds are in units of {current.joints[reference]}" in said and "Nm a unit" not in said
    assert found.facts(current.joints)["relative_to"] == current.joints[reference]


def test_without_a_model_and_without_motion_there_are_no_constants():
    with pytest.raises(ConfigError, match="there is none .* takes turning joints, gravity and 10 s"):
        fit_torque_constants(no_model(planar_arm()), [motion(seconds=5.0)], ObserverConfig())


def test_joints_that_share_no_column_are_solved_apart_with_the_result_of_one_dense_system():
    rng = np.random.default_rng(3)
    columns = (np.array([0, 1, 4]), np.array([2, 3]), np.array([4, 5]))
    assert coupled(columns) == [[1], [0, 2]] or coupled(columns) == [[0, 2], [1]]
    parts = []
    for _ in range(5):
        X, y = [rng.normal(size=(40, len(at))) for at in columns], rng.normal(size=(40, 3))
        gram, moment = [x.T @ x for x in X], [x.T @ y[:, i] for i, x in enumerate(X)]
        parts.append(NormalEquations(columns, gram, moment, (y**2).sum(axis=0), 40))
    regression = Regression(parts)
    regression.fix(3, 0.5)
    ridge = 0.1
    dense, right = np.zeros((6, 6)), np.zeros(6)
    weight = 1 / (regression.whole.energy / 200)
    for i, at in enumerate(columns):
        dense[np.ix_(at, at)] += weight[i] * regression.whole.gram[i]
        right[at] += weight[i] * regression.whole.moment[i]
    scale = np.sqrt(np.diag(dense) / 200)
    free = np.array([0, 1, 2, 4, 5])
    left = dense[np.ix_(free, free)] / np.outer(scale[free], scale[free]) + ridge * 200 * np.eye(5)
    slow = np.linalg.solve(left, (right - 0.5 * dense[:, 3])[free] / scale[free]) / scale[free]
    found = regression.solve(regression.whole, ridge)
    np.testing.assert_allclose(found[free], slow, rtol=1e-10)
    assert found[3] == 0.5


def test_currents_of_unknown_constants_are_found_by_their_recordings():
    made = motion(seconds=40.0)
    amperes = replace(made, provenance=AMPERES)
    none, auto = PAPER_CASES["none"], TrainConfig()
    assert wants_constants(auto, [amperes], EXACT) and wants_constants(auto, [amperes], none)
    assert not wants_constants(auto, [made], EXACT)
    given = replace(made, provenance={"torque": "N m: amperes times given torque constants"})
    assert wants_constants(auto, [given], EXACT) and wants_constants(auto, [given], none)
    scaled = {"torque_constants": [2.0, 3.0]}  # as flights of older versions say
    assert not wants_constants(auto, [replace(given, provenance=given.provenance | scaled)], EXACT)
    assert not wants_constants(auto, [replace(amperes, provenance=amperes.provenance | scaled)], EXACT)
    assert not wants_constants(auto, [replace(motion(seconds=20.0), provenance=amperes.provenance)], none)
    assert not wants_constants(replace(auto, fit_torque_constants=False), [amperes], EXACT)
    assert wants_constants(replace(auto, fit_torque_constants=True), [made], EXACT)
