"""A refit finds friction that is known in closed form, learns no push, and leaves alone what the day does not tell."""

import json
from dataclasses import replace

import numpy as np
import pytest
from made_arms import planar_arm
from test_prior import motion, record

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.cli import main
from tauext.config import ObserverConfig, PriorConfig
from tauext.data.recording import Recording
from tauext.data.recording_file import save_recording
from tauext.errors import BundleError, ConfigError, TrainingError
from tauext.fit.bundle_writing import build_setup, make_bundle
from tauext.fit.prior import fit_prior
from tauext.fit.prior_terms import PriorFit
from tauext.fit.training_set import with_presliding
from tauext.train.error_scale import unit_scale
from tauext.train.refit import (
    STANDS,
    Refitted,
    Span,
    refit_bundle,
    refit_motion,
    refit_recordings,
    sentence,
    standing,
)

NOISE_NM = 0.2
RATE_HZ = 250.0
COULOMB_NM, VISCOUS = np.array([5.0, 3.0]), np.array([2.0, 1.0])
SETTINGS = PriorConfig((1e-3, 1e-2), coulomb_speeds_rad_s=(0.03, 0.1), most_ripples=0, drop_widths=False)
Kind = _core.TermKind
FRICTION_KINDS = (Kind.coulomb, Kind.presliding, Kind.viscous, Kind.load, Kind.load_presliding)


def friction(coulomb=1.0, viscous=1.0, constant_nm=0.0):
    """As it stands in r, with these factors of today's."""
    return lambda q, dq, beta: -(coulomb * COULOMB_NM * np.tanh(dq / 0.03) + viscous * VISCOUS * dq + constant_nm)


def day(seed: int = 50, seconds: float = 60.0, noise_nm: float = NOISE_NM, **changed) -> Recording:
    """Of the arm whose friction has changed so."""
    moved = motion(seed, seconds, RATE_HZ)
    return record(planar_arm(), moved, friction(**changed), noise_nm, seed, RATE_HZ)


@pytest.fixture(scope="module")
def fitted() -> tuple[_core.Bundle, PriorFit]:
    """An arm of known friction, whose model is corrected too; sigma and limits are those of its noise."""
    made = [day(seed, 20.0) for seed in range(5)]
    setup = build_setup(planar_arm(), made[0], ObserverConfig())
    fit = fit_prior(with_presliding(setup, SETTINGS.widths_rad), made, SETTINGS)
    bundle = make_bundle("yesterday", replace(setup, prior=fit.settings), 0.02, made[0])
    left = np.concatenate([np.abs(tau_ext(bundle, one)) for one in made])
    scale = unit_scale(2)
    sigma = np.quantile(left, 0.6827, axis=0)
    weights = np.zeros((2, len(scale.features)))
    weights[:, 0] = sigma
    scale.sigma_weights = scale.sigma_near_weights = weights.ravel().tolist()
    scale.largest_sigma = sigma.tolist()
    bundle.error_scale = scale
    bundle.sliding_limit_nm = bundle.near_stiction_limit_nm = (8 * sigma).tolist()
    bundle.contact_sliding_limit_nm = bundle.contact_near_stiction_limit_nm = (6 * sigma).tolist()
    return bundle, fit


def tau_ext(bundle: _core.Bundle, made: Recording) -> np.ndarray:
    said = _core.estimate(bundle, *made.signals, 1)
    return said["tau_ext"][said["health"] == 1]


def refitted(bundle: _core.Bundle, *days: Recording) -> Refitted:
    return refit_recordings(bundle, days, threads=1)


def pushed(made: Recording, begin_s: float, end_s: float, nm: float) -> Recording:
    """A drive that holds its motion against a push on the first joint gives that much less."""
    tau = made.tau.copy()
    tau[(made.time_s >= begin_s) & (made.time_s < end_s), 0] -= nm
    return replace(made, tau=tau)


@pytest.mark.parametrize("coulomb, viscous", [(0.7, 0.7), (1.4, 1.4), (1.3, 1.0), (1.0, 0.8)])
def test_factors_of_friction_that_is_known_are_found_within_their_errors(fitted, coulomb, viscous):
    found = refitted(fitted[0], day(coulomb=coulomb, viscous=viscous, constant_nm=0.3))
    for joint in found.joints:
        for told, true in ((joint.coulomb, coulomb), (joint.viscous, viscous)):
            value, error = told
            assert abs(value - true) < 0.02 and 0 < error < 0.02
            assert abs(value - true) < 4 * error
        assert abs(joint.constant[0] + 0.3) < 4 * joint.constant[1] < 0.2  # r shows minus the friction
    left = np.sqrt(
        (tau_ext(found.bundle, day(51, coulomb=coulomb, viscous=viscous, constant_nm=0.3)) ** 2).mean(axis=0)
    )
    as_trained = np.sqrt((tau_ext(fitted[0], day(51)) ** 2).mean(axis=0))
    assert (left < 1.3 * as_trained).all()


def test_half_a_minute_does_and_says_that_it_knows_less(fitted):
    whole, half = (refitted(fitted[0], day(seconds=s, coulomb=1.3)) for s in (60.0, 30.0))
    assert abs(half.joints[0].coulomb[0] - 1.3) < 0.02
    assert half.joints[0].coulomb[1] > whole.joints[0].coulomb[1]


def test_an_unchanged_arm_stays_as_it_is_within_its_errors(fitted):
    found = refitted(fitted[0], day())
    for joint in found.joints:
        assert abs(joint.coulomb[0] - 1) < 4 * joint.coulomb[1] < 0.05
        assert joint.limit_factor < 1.2


def test_a_push_of_a_second_is_reported_and_not_learned(fitted):
    bundle, usual = fitted[0], day(coulomb=1.2)
    without, found = refitted(bundle, usual), refitted(bundle, pushed(usual, 20.0, 21.0, 15.0))
    assert not without.touches
    (touch,) = [touch for touch in found.touches if touch.joint == "shoulder"]
    assert touch.from_s == pytest.approx(20.0, abs=0.1) and touch.to_s == pytest.approx(21.1, abs=0.3)
    assert not touch.counted and "no friction explains" in touch.sentence()
    for a, b in zip(without.joints, found.joints, strict=True):
        assert abs(a.coulomb[0] - b.coulomb[0]) < a.coulomb[1] and abs(a.constant[0] - b.constant[0]) < a.constant[1]
        assert b.limit_factor == pytest.approx(a.limit_factor, rel=0.05)
    # Least squares without robust weights would have put this much into the constant.
    assert 15.0 / 60 > 4 * found.joints[0].constant[1]


def test_what_comes_too_often_for_a_touch_raises_the_limits(fitted):
    bundle, made = fitted[0], day()
    for k in range(6):
        made = pushed(made, 5.0 + 8 * k, 5.3 + 8 * k, 4.0)
    found = refitted(bundle, made)
    assert len([touch for touch in found.touches if touch.counted]) >= 4
    assert found.joints[0].limit_factor > 1.3 and found.joints[1].limit_factor < 1.3


def test_a_labelled_contact_is_left_out(fitted):
    made = pushed(day(coulomb=1.2), 20.0, 21.0, 15.0)
    contact = ((made.time_s >= 20.0) & (made.time_s < 21.0)).astype(np.int8)
    found = refitted(fitted[0], replace(made, contact=contact))
    assert not found.touches and found.used_s < 59.0
    assert abs(found.joints[0].coulomb[0] - 1.2) < 0.02


def test_model_and_what_was_corrected_of_it_stay(fitted):
    bundle = fitted[0]
    found = refitted(bundle, day(coulomb=1.4, viscous=0.7)).bundle
    for name in ("links", "gravity"):
        assert repr(getattr(found, name)) == repr(getattr(bundle, name)) or name == "links"
    pairs = [(bundle.links, found.links), (bundle.prior.corrected_links, found.prior.corrected_links)]
    for old, new in pairs:
        assert len(old) == 2
        for a, b in zip(old, new, strict=True):
            assert (a.mass, a.com, a.inertia, a.rotor_inertia) == (b.mass, b.com, b.inertia, b.rotor_inertia)


def test_limits_and_sigma_grow_with_the_error_that_is_left_and_never_shrink(fitted):
    bundle = fitted[0]
    loud, quiet = refitted(bundle, day(noise_nm=2 * NOISE_NM)), refitted(bundle, day(noise_nm=NOISE_NM / 4))
    for joint in loud.joints:
        assert joint.error_ratio == pytest.approx(2.0, rel=0.2)
        assert joint.limit_factor >= joint.error_ratio_upper > joint.error_ratio
    for j, joint in enumerate(loud.joints):
        assert loud.bundle.sliding_limit_nm[j] == pytest.approx(joint.limit_factor * bundle.sliding_limit_nm[j])
        assert loud.bundle.contact_near_stiction_limit_nm[j] > bundle.contact_near_stiction_limit_nm[j]
    assert loud.bundle.error_scale.largest_sigma[0] > 1.5 * bundle.error_scale.largest_sigma[0]
    assert quiet.bundle.sliding_limit_nm >= bundle.sliding_limit_nm
    assert quiet.bundle.error_scale.sigma_weights == bundle.error_scale.sigma_weights


def test_signals_that_are_not_of_this_arm_are_refused(fitted):
    bundle, made = fitted[0], day()
    with pytest.raises(TrainingError, match="friction does not explain is .* another payload or tool"):
        refitted(bundle, replace(made, tau=10 * made.tau))
    with pytest.raises(TrainingError, match="its friction would be .* times the old one.*in its unit"):
        refitted(bundle, day(coulomb=0.05, viscous=0.05))
    with pytest.raises(TrainingError, match="10 s of motion"):
        refitted(bundle, day(seconds=8.0))


def test_a_promise_stands_unless_a_minute_speaks_against_it(fitted):
    bundle = fitted[0]
    tail = {"threshold_nm": 0.7 * bundle.sliding_limit_nm[0], "rate_per_hour": 8.0}
    limits = {
        "tails": {
            f"{joint} {region}": tail for joint in ("shoulder", "elbow") for region in ("sliding", "near_stiction")
        },
        "promise": {"asked": {"alarms": 1, "hours": 8.0}, "confidence": 0.95},
        "set_for": "1 in 8 h",
    }
    source = [(*r.signals, None) for r in [day(coulomb=1.2)]]
    found = _core.refit(bundle, source)
    assert standing(found, bundle, limits, 0) == STANDS
    said = sentence(limits, found.used_s, [])
    assert "holds" in said and "24 h of calibration" in said
    low = limits | {"tails": {name: tail | {"threshold_nm": 0.3 * tail["threshold_nm"]} for name in limits["tails"]}}
    assert standing(found, bundle, low, 0).startswith("open: ")
    assert "open at shoulder" in sentence(low, found.used_s, ["shoulder"])
    assert standing(found, bundle, {"sentence": "the largest errors seen"}, 0) == "none was made"
    assert "have no target false alarm rate" in sentence({}, found.used_s, [])


def test_a_monitor_keeps_the_morning_for_the_same_refit(fitted):
    bundle, made = fitted[0], day(coulomb=1.3)
    signals = made.signals
    monitor = _core.Monitor(bundle)
    with pytest.raises(_core.CoreError, match="reserve_refit"):
        monitor.start_refit()
    monitor.reserve_refit(30.0)
    monitor.start_refit()
    wide = monitor.run(*signals)
    assert monitor.refit_full
    motion_kept = monitor.finish_refit()
    assert not monitor.refit_full and len(motion_kept["t_ns"]) == 30 * RATE_HZ
    np.testing.assert_array_equal(motion_kept["tau"], made.tau[: len(motion_kept["t_ns"])])
    usual = _core.Monitor(bundle).run(*signals)
    friction_nm = COULOMB_NM + VISCOUS * np.abs(made.dq)
    np.testing.assert_allclose((wide["limit_nm"] - usual["limit_nm"])[1000:], 0.4 * friction_nm[1000:], rtol=0.1)
    np.testing.assert_array_equal(wide["tau_ext"], usual["tau_ext"])
    assert (usual["held_alarm"] == 2).any() and not (wide["held_alarm"] == 2).any()
    first = replace(
        made, **dict(zip(("t_ns", "q", "dq", "tau"), (s[: 30 * int(RATE_HZ)] for s in signals), strict=True))
    )
    assert refit_motion(bundle, motion_kept).bundle.prior.weights == refitted(bundle, first).bundle.prior.weights


def test_reset_restore_and_wrong_shares_end_or_leave_a_refit(fitted):
    bundle = fitted[0]
    monitor = _core.Monitor(bundle)
    state = monitor.save_state()
    for seconds in (0.0, 601.0, np.nan):
        with pytest.raises(_core.CoreError, match="at most 600"):
            monitor.reserve_refit(seconds)
    monitor.reserve_refit(0.1)
    for share in (-0.1, 2.1, np.nan):
        with pytest.raises(_core.CoreError, match="friction_share"):
            monitor.start_refit(share)
    made = day(seconds=1.0)
    for end in (monitor.reset, lambda: monitor.restore_state(state)):
        monitor.start_refit()
        monitor.run(*made.signals)
        assert monitor.refit_full
        end()
        assert not monitor.refit_full
        said = monitor.run(*made.signals)
        np.testing.assert_array_equal(said["limit_nm"], _core.Monitor(bundle).run(*made.signals)["limit_nm"])


def test_a_span_is_seconds_of_the_recording():
    made = day(seconds=5.0)
    part = Span(1.0, 3.0).of(made)
    assert part.samples == 2 * RATE_HZ and part.t_ns[0] == made.t_ns[250]
    assert Span(6.0).of(made) is None
    for wrong in ((-1.0, None), (2.0, 2.0), (np.nan, None), (0.0, np.inf), (0.0, np.nan)):
        with pytest.raises(ConfigError, match="time of the recording"):
            Span(*wrong)


@pytest.fixture
def files(fitted, tmp_path):
    fitted[0].save(str(tmp_path / "old.tauext"))
    save_recording(day(coulomb=1.3), tmp_path / "today.parquet")
    return tmp_path


def test_the_command_prints_a_row_a_joint_and_writes_where_it_came_from(files, capsys):
    arguments = ["refit", str(files / "old.tauext"), "--data", str(files / "today.parquet"), "--out"]
    assert main([*arguments, str(files / "new.tauext")]) == 0
    out = capsys.readouterr().out
    assert "shoulder" in out and "x 1.3" in out and out.rstrip().endswith("new.tauext")
    facts = json.loads(load_bundle(files / "new.tauext").provenance)["refitted"]
    assert facts["command"] == "tauext refit" and facts["settings"]["bundle"] == "old.tauext"
    assert set(facts["settings"]["data"]) == {"today.parquet"} and len(facts["settings"]["bundle_sha256"]) == 64
    assert json.loads((files / "new.run.json").read_text())["refitted"]["joints"][0]["joint"] == "shoulder"
    assert main(["show", str(files / "new.tauext")]) == 0
    shown = capsys.readouterr().out
    assert "friction brought up to date" in shown and "since training, shoulder" in shown and "times 1.3" in shown
    assert main([*arguments, str(files / "short.tauext"), "--from", "5", "--to", "35", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["used_s"] == pytest.approx(29.5, abs=0.2) and told["joints"][0]["coulomb"][0] == pytest.approx(
        1.3, abs=0.02
    )


@pytest.mark.parametrize(
    "more, says",
    [
        (["--out", "{old}"], "choose another --out"),
        (["--out", "new.bundle"], "ends in .tauext"),
        (["--out", "{new}", "--from", "100"], "no recording has a sample"),
        (["--out", "{new}", "--to", "3"], "10 s of motion"),
    ],
)
def test_what_cannot_be_done_is_one_line_and_nothing_is_written(files, capsys, more, says):
    names = {"{old}": str(files / "old.tauext"), "{new}": str(files / "new.tauext")}
    arguments = ["refit", names["{old}"], "--data", str(files / "today.parquet"), *(names.get(w, w) for w in more)]
    assert main(arguments) == 2
    err = capsys.readouterr().err
    assert says in err and "error" in err.splitlines()[-1]
    assert not (files / "new.tauext").exists() and not list(files.glob("*.part"))


def test_a_bundle_without_a_prior_or_of_another_arm_is_refused(files, fitted, tmp_path):
    plain = _core.Bundle.from_bytes(fitted[0].to_bytes())
    plain.prior = _core.PriorSettings()
    plain.answer_reference()
    plain.save(str(tmp_path / "plain.tauext"))
    with pytest.raises(TrainingError, match="no prior.*recipe tauext or prior"):
        refit_bundle(tmp_path / "plain.tauext", files / "today.parquet", tmp_path / "x.tauext")
    save_recording(replace(day(), torque_timing="held"), tmp_path / "held.parquet")
    with pytest.raises(BundleError, match="averaged"):
        refit_bundle(files / "old.tauext", tmp_path / "held.parquet", tmp_path / "x.tauext")


def test_friction_that_falls_while_it_is_recorded_is_that_of_the_end(fitted):
    """Coulomb friction from 1.25 down to 1.15 of the old one over the minute; an average would be 1.2."""
    moved = motion(50, 60.0, RATE_HZ)
    share = np.linspace(1.25, 1.15, len(moved[0]))[:, None]
    made = record(planar_arm(), moved, friction(coulomb=share, viscous=share), NOISE_NM, 50, RATE_HZ)
    twice = refitted(fitted[0], made), refitted(fitted[0], *halves(made))
    for found in twice:
        for joint in found.joints:
            assert abs(joint.coulomb[0] - 1.15) < 0.02 and abs(joint.viscous[0] - 1.15) < 0.05


def halves(made: Recording) -> list[Recording]:
    """As recordings of their own, whose clocks tell nothing of each other."""
    middle = made.samples // 2
    names = ("t_ns", "q", "dq", "tau")
    first, last = ({name: getattr(made, name)[part] for name in names} for part in (slice(middle), slice(middle, None)))
    return [replace(made, **first), replace(made, **(last | {"t_ns": last["t_ns"] - last["t_ns"][0]}))]


def stands(moves_s: float = 0.0, trembles: bool = True, seed: int = 50) -> Recording:
    """The elbow stands but for the first seconds; its encoder may tremble, and its gear hold most of what it can."""
    q, dq = motion(seed, 60.0, RATE_HZ)
    first = round(moves_s * RATE_HZ)
    rng, rest = np.random.default_rng(seed), len(q) - first
    q[first:, 1] = (q[first - 1, 1] if first else 0.4) + (rng.normal(0, 1e-4, rest) if trembles else 0.0)
    dq[first:, 1] = rng.normal(0, 5e-3, rest) if trembles else 0.0
    made = record(planar_arm(), (q, dq), friction(coulomb=1.3), NOISE_NM, seed, RATE_HZ)
    tau = made.tau.copy()
    if trembles:
        held = np.linspace(0.9, -0.2, rest) * COULOMB_NM[1]
        tau[first:, 1] += held - 1.3 * COULOMB_NM[1] * np.tanh(dq[first:, 1] / 0.03)
    return replace(made, tau=tau)


def own_weights(bundle: _core.Bundle, joint: int) -> np.ndarray:
    own = [m for m, term in enumerate(bundle.prior.terms) if term.a == joint]
    return np.array(bundle.prior.weights).reshape(2, -1)[joint, own]


@pytest.mark.parametrize("trembles", [True, False])
def test_a_joint_that_stands_keeps_its_friction_and_learns_nothing_of_what_its_gear_holds(fitted, trembles):
    found = refitted(fitted[0], stands(trembles=trembles))
    assert np.array_equal(own_weights(found.bundle, 1), own_weights(fitted[0], 1))
    shoulder, elbow = found.joints
    assert abs(shoulder.coulomb[0] - 1.3) < 0.02
    for kept in (elbow.coulomb, elbow.viscous):
        assert kept == (1.0, pytest.approx(np.hypot(0.3, 0.15), rel=0.02))
    assert elbow.limit_factor >= 1.3  # nobody knows how much it is today
    assert trembles or elbow.moved_s == 0


def test_seconds_of_motion_before_it_stood_are_learned(fitted):
    found = refitted(fitted[0], stands(moves_s=15.0))
    assert abs(found.joints[1].coulomb[0] - 1.3) < 0.06 < 0.3


def test_a_joint_is_refitted_about_what_is_expected_of_it(fitted):
    bundle = fitted[0]
    settings = _core.RefitSettings()
    settings.expected, settings.expected_error = [1.0, 1.2], [0.3, 0.04]
    made = stands()
    found = _core.refit(bundle, [(*made.signals, None)], settings)
    plain = _core.refit(bundle, [(*made.signals, None)])
    kinds = [term.kind for term in bundle.prior.terms if term.a == 1]
    ratio = own_weights(found.bundle, 1) / own_weights(bundle, 1)
    moves = np.array([kind in FRICTION_KINDS for kind in kinds])
    assert ratio[moves] == pytest.approx(1.2) and ratio[~moves] == pytest.approx(1.0) and moves.sum() == 7
    assert found.joints[1].coulomb == (pytest.approx(1.2), pytest.approx(np.hypot(0.04, 0.02), rel=0.02))
    assert found.joints[0].coulomb == plain.joints[0].coulomb


@pytest.mark.parametrize(
    "wrong", [([1.0], [0.1]), ([1.0, 1.0], [0.1]), ([1.0, 9.0], [0.1, 0.1]), ([1.0, 1.0], [0.1, 0])]
)
def test_expectations_that_are_none_are_refused(fitted, wrong):
    settings, made = _core.RefitSettings(), stands()
    settings.expected, settings.expected_error = wrong
    with pytest.raises(_core.CoreError, match="a refit's expect"):
        _core.refit(fitted[0], [(*made.signals, None)], settings)
