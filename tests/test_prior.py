"""The prior: its terms against their formulas in NumPy, and what the fit finds in recordings of known friction.

Recordings say that torque is averaged over the step before its stamp. Then tau_k = (p_k - p_{k-1})/dt + mean of
beta - mean of v makes the observer's recurrence exact at any rate: r of the true model is the filtered v, and nothing
else. v is friction as it stands in r: negative where the joint moves forward."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from made_arms import no_model, planar_arm, regular_times, settings
from made_bundles import constants_of

from tauext import _core
from tauext.config import PriorConfig
from tauext.data.recording import Recording
from tauext.errors import TrainingError
from tauext.fit.prior import Inertia, find_ripple, fit_friction, fit_prior, fit_terms, play_sentence
from tauext.fit.prior_terms import CORRECTED as BY_CORRECTED
from tauext.fit.prior_terms import ESTIMATED as BY_ESTIMATED
from tauext.fit.prior_terms import PriorFit, encoder_count, has_model, own_terms, shared_terms
from tauext.fit.torque_constants import with_constants
from tauext.fit.training_set import Setup
from tauext.robot.inertial import PARAMETERS, inertial_parameters, with_inertial_parameters
from tauext.robot.model_case import perturbed

Kind = _core.TermKind
RATE_HZ, GAIN = 100.0, 20.0
WIDTHS = (2e-3, 2e-2)
BRANCH = (0.4, 0.6)
NOISE_NM = 0.5
# White noise of the torque after the filter r_k = a r_{k-1} + (1 - a) d_k.
FILTERED_NOISE_NM = NOISE_NM * np.sqrt((1 - np.exp(-GAIN / RATE_HZ)) / (1 + np.exp(-GAIN / RATE_HZ)))


def twin_filter(v: np.ndarray, momentum: np.ndarray, t_ns: np.ndarray, restarts=()) -> np.ndarray:
    """The observer's recurrence of docs/method/theory.md: d = dP/dt + mean over the step of v."""
    out = np.zeros_like(v)
    for k in range(1, len(v)):
        if k in restarts:
            continue
        dt = (t_ns[k] - t_ns[k - 1]) * 1e-9
        a = np.exp(-GAIN * dt)
        d = (momentum[k] - momentum[k - 1]) / dt + (v[k] + v[k - 1]) / 2
        out[k] = a * out[k - 1] + (1 - a) * d
    return out


def twin_presliding(q: np.ndarray, width: float, restarts=()) -> np.ndarray:
    """Stop operators of every joint from both ends of what is possible, in radians; their mean, in widths."""
    low, high, out = np.full(q.shape[1], -width), np.full(q.shape[1], width), np.zeros_like(q)
    for k in range(1, len(q)):
        if k in restarts:
            low[:], high[:] = -width, width
            continue
        low, high = (np.clip(z + q[k] - q[k - 1], -width, width) for z in (low, high))
        out[k] = (low + high) / (2 * width)
    return out


def twin_memory_gap(q: np.ndarray, widths: Sequence[float], branch: Sequence[float], restarts=()) -> np.ndarray:
    """Friction along the branch from its own value on, looked up in both directions, less the stop operators' sum."""
    knots = np.r_[0.0, 2 * np.array(widths)]
    values = [np.sum(branch * np.clip(-1 + x / np.array(widths), -1, 1)) for x in knots]
    local, out = np.zeros(q.shape[1]), np.zeros_like(q)
    for k in range(1, len(q)):
        moved = q[k] - q[k - 1]
        if k in restarts:
            local[:] = 0.0
            continue
        way = np.sign(moved)
        local = np.where(way, way * np.interp(np.interp(way * local, values, knots) + abs(moved), knots, values), local)
        out[k] = local
    return out - sum(b * twin_presliding(q, w, restarts) for b, w in zip(branch, widths, strict=True))


def random_walk(samples: int, joints: int, seed: int) -> np.ndarray:
    """Strides, trembling and rests, over all widths."""
    rng = np.random.default_rng(seed)
    size = 10.0 ** rng.uniform(-5, -1.5, (samples // 50 + 1, joints)).repeat(50, axis=0)[:samples]
    return np.cumsum(size * rng.normal(size=(samples, joints)) * (rng.random((samples, joints)) < 0.8), axis=0)


def prior_of(terms, weights, widths=()) -> _core.PriorSettings:
    prior = _core.PriorSettings()
    prior.widths_rad, prior.terms = list(widths), list(terms)
    prior.weights = np.ravel(weights).tolist()
    return prior


def wild_motion(samples: int = 600) -> tuple[np.ndarray, ...]:
    """Stamps of uneven steps with a bridged gap and a restart; positions, speeds and torques that follow no law."""
    rng = np.random.default_rng(3)
    t_ns = regular_times(samples) + rng.integers(-200_000, 200_000, samples)
    t_ns[200:] += 8_000_000  # bridged: eight samples of 1 ms are missing
    t_ns[400:] += 30_000_000  # a restart
    q = random_walk(samples, 3, seed=4) + [0.5, 2.5, -1.2]  # the second joint's load is negative
    return t_ns, q, rng.normal(size=q.shape), rng.normal(0, 10, q.shape)


def three_joint_arm() -> _core.Tree:
    """The planar arm with a third, tilted joint."""
    links = planar_arm().links
    third = _core.Link()
    third.joint_name, third.parent = "wrist", 1
    third.rotation = [1, 0, 0, 0, 0, -1, 0, 1, 0]
    third.translation, third.mass, third.com = [0.25, 0, 0.05], 2.0, [0.02, 0.1, 0.03]
    third.inertia, third.rotor_inertia = [0.01, 0.02, 0.015, 0.001, 0, 0.002], 0.1
    return _core.Tree([*links, third], [0, -9.81, 0])


def formulas(
    q: np.ndarray, dq: np.ndarray, beta: np.ndarray, heavy: np.ndarray, z: list[np.ndarray]
) -> dict[str, tuple]:
    """Every kind and form: the term, what it says of each sample, and whether it acts as momentum.

    Args:
        heavy: beta of the corrected model.
    """
    s, c = np.sin(q).T, np.cos(q).T
    v = dq.T
    of = {
        "constant": (_core.Term(Kind.constant, 1), np.ones(len(q))),
        "viscous": (_core.Term(Kind.viscous, 1), v[1]),
        "coulomb": (_core.Term(Kind.coulomb, 2, speed=0.3), np.tanh(v[2] / 0.3)),
        "presliding narrow": (_core.Term(Kind.presliding, 0, b=0), z[0][:, 0]),
        "presliding wide": (_core.Term(Kind.presliding, 2, b=1), z[1][:, 2]),
        "load": (_core.Term(Kind.load, 1, speed=0.2), np.abs(beta[:, 1]) * np.tanh(v[1] / 0.2)),
        "load_presliding": (_core.Term(Kind.load_presliding, 2, b=1), np.abs(beta[:, 2]) * z[1][:, 2]),
        "ripple sin": (_core.Term(Kind.ripple, 2, b=37, form=0), np.sin(37 * q[:, 2])),
        "ripple cos": (_core.Term(Kind.ripple, 2, b=37, form=1), np.cos(37 * q[:, 2])),
        "gravity sin": (_core.Term(Kind.gravity, 1, 1, form=0), s[1]),
        "gravity cos": (_core.Term(Kind.gravity, 1, 1, form=1), c[1]),
        "gravity sin sin": (_core.Term(Kind.gravity, 0, 2, form=2), s[0] * s[2]),
        "gravity sin cos": (_core.Term(Kind.gravity, 0, 2, form=3), s[0] * c[2]),
        "gravity cos sin": (_core.Term(Kind.gravity, 0, 2, form=4), c[0] * s[2]),
        "gravity cos cos": (_core.Term(Kind.gravity, 0, 2, form=5), c[0] * c[2]),
        "gravity sin sin sin": (_core.Term(Kind.gravity, 0, 1, 2, form=6), s[0] * s[1] * s[2]),
        "gravity sin cos sin": (_core.Term(Kind.gravity, 0, 1, 2, form=8), s[0] * c[1] * s[2]),
        "gravity cos sin cos": (_core.Term(Kind.gravity, 0, 1, 2, form=11), c[0] * s[1] * c[2]),
        "quadratic sin": (_core.Term(Kind.quadratic, 0, 1, 2, form=0), v[0] * v[1] * s[2]),
        "quadratic cos": (_core.Term(Kind.quadratic, 1, 1, 0, form=1), v[1] ** 2 * c[0]),
        "local_memory": (_core.Term(Kind.local_memory, 2), twin_memory_gap(q, WIDTHS, BRANCH, restarts=(400,))[:, 2]),
        "backlash": (_core.Term(Kind.backlash, 1, b=1), beta[:, 1] * (1 - np.abs(z[1][:, 1]))),
        "load corrected": (
            _core.Term(Kind.load, 1, speed=0.2, form=BY_CORRECTED),
            np.abs(heavy[:, 1]) * np.tanh(v[1] / 0.2),
        ),
        "load_presliding corrected": (
            _core.Term(Kind.load_presliding, 1, b=1, form=BY_CORRECTED),
            np.abs(heavy[:, 1]) * z[1][:, 1],
        ),
        "backlash corrected": (
            _core.Term(Kind.backlash, 1, b=1, form=BY_CORRECTED),
            heavy[:, 1] * (1 - np.abs(z[1][:, 1])),
        ),
        "momentum": (_core.Term(Kind.momentum, 2, 0, form=0), v[2]),
        "momentum cos": (_core.Term(Kind.momentum, 2, 0, form=1), v[2] * c[0]),
        "momentum sin": (_core.Term(Kind.momentum, 2, 0, form=2), v[2] * s[0]),
    }
    return {name: (term, values, term.kind == Kind.momentum) for name, (term, values) in of.items()}


EVERY_FORM = list(formulas(*[np.zeros((1, 3))] * 4, [np.zeros((1, 3))] * 2))


def test_regressors_of_links_are_the_differences_of_r_and_may_come_in_parts():
    """Over a bridged gap and a restart; r of a model with more of one parameter falls by that parameter's column."""
    tree, observer = three_joint_arm(), settings()
    t_ns, q, dq, tau = wild_motion()
    rows, links, some = np.arange(0, len(q), 7, dtype=np.int64), [0, 2], [0, 2, 5, 8, 10]
    whole = _core.LinkRegressors(tree, observer, links, some).rows(t_ns, q, dq, rows)
    r = _core.observe(tree, observer, t_ns, q, dq, tau).residual[rows]
    for k, link in enumerate(links):
        for m, parameter in enumerate(some):
            changed = tree.links
            more = inertial_parameters(changed[link]) + np.eye(len(PARAMETERS))[parameter]
            changed[link] = with_inertial_parameters(changed[link], more)
            then = _core.observe(_core.Tree(changed, tree.gravity), observer, t_ns, q, dq, tau).residual[rows]
            np.testing.assert_allclose(whole[:, :, len(some) * k + m], r - then, rtol=0, atol=1e-11 * np.abs(r).max())
    in_parts, cuts = _core.LinkRegressors(tree, observer, links, some), [0, 100, 403, len(q)]
    parts = [
        in_parts.rows(t_ns[a:b], q[a:b], dq[a:b], rows[(rows >= a) & (rows < b)] - a)
        for a, b in zip(cuts[:-1], cuts[1:], strict=True)
    ]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    for links, some, why in (([3], [0], "link 3"), ([0], [11], "none of them 11")):
        with pytest.raises(_core.CoreError, match=why):
            _core.LinkRegressors(tree, observer, links, some)
    with pytest.raises(_core.CoreError, match="ascending and within"):
        _core.LinkRegressors(tree, observer, [0], [0]).rows(t_ns, q, dq, np.array([len(q)]))


def test_every_kind_of_term_has_a_formula_here():
    kinds = {name.split()[0] for name in EVERY_FORM}
    assert kinds == {kind.name for kind in Kind}


@pytest.mark.parametrize("name", EVERY_FORM)
def test_a_term_is_its_formula_through_the_observers_recurrence(name):
    t_ns, q, dq, tau = wild_motion()
    tree, observer = three_joint_arm(), settings()
    corrected = with_links(tree, mass=(3.0, 2.0, 4.0))
    betas = [arm.momentum(q, dq)[1] for arm in (tree, corrected)]
    z = [twin_presliding(q, width, restarts=(400,)) for width in WIDTHS]
    term, values, as_momentum = formulas(q, dq, *betas, z)[name]
    nothing = np.zeros_like(values)
    expected = twin_filter(nothing if as_momentum else values, values if as_momentum else nothing, t_ns, (400,))
    prior, without = prior_of([term], [[2.0], [0.0], [-3.0]], WIDTHS), np.zeros_like(q)
    prior.branches = 3 * list(BRANCH)
    if name.endswith("corrected"):
        with pytest.raises(_core.CoreError, match="prior term 0: it asks for the load by the corrected model"):
            _core.observe(tree, observer, t_ns, q, dq, tau, prior)
        alone = prior_of([], np.zeros((3, 0)), WIDTHS)
        prior.corrected_links = alone.corrected_links = corrected.links
        without = _core.observe(tree, observer, t_ns, q, dq, tau, alone).prior
    observation = _core.observe(tree, observer, t_ns, q, dq, tau, prior)
    assert observation.restarts == 1 and observation.held_rows == 8
    assert np.abs(expected).max() > 1e-2
    # Rounding of a momentum divided by steps of 0.6 ms at least; beta of up to 100 Nm; sin(37 q).
    tolerance = 1e-10 * (1 + np.abs(values).max() + np.abs(without).max())
    by_term = observation.prior - without
    np.testing.assert_allclose(by_term, np.outer(expected, [2.0, 0.0, -3.0]), rtol=0, atol=tolerance)
    regressors = _core.prior_regressors(tree, observer, prior, t_ns, q, dq, tau, np.arange(len(q), dtype=np.int64))
    np.testing.assert_allclose(regressors[:, 0], expected, rtol=0, atol=tolerance)


def motion(seed: int, seconds: float, rate_hz: float = RATE_HZ) -> tuple[np.ndarray, np.ndarray]:
    """Three sines a joint with their true speeds: +-1.5 rad, up to 3 rad/s, tens of turning points."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * rate_hz))[:, None, None] / rate_hz
    speed = rng.uniform(0.3, 3.0, (2, 3))
    size, phase = rng.uniform(0.2, 0.6, (2, 3)), rng.uniform(0, 2 * np.pi, (2, 3))
    q, dq = size * np.sin(speed * t + phase), size * speed * np.cos(speed * t + phase)
    return q.sum(axis=2), dq.sum(axis=2)


def record(
    tree: _core.Tree,
    moved: tuple[np.ndarray, np.ndarray],
    friction: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None = None,
    noise_nm: float = 0.0,
    seed: int = 0,
    rate_hz: float = RATE_HZ,
    timing: str = "averaged",
) -> Recording:
    """What this arm records on this motion; friction(q, dq, beta) as it stands in r. A held torque acts from its stamp
    to the next, so that the torque of a step stands one sample earlier."""
    q, dq = moved
    p, beta = tree.momentum(q, dq)
    v = friction(q, dq, beta) if friction else np.zeros_like(q)
    u = beta - v
    tau = u.copy()
    of_steps = slice(0, -1) if timing == "held" else slice(1, None)
    tau[of_steps] = np.diff(p, axis=0) * rate_hz + (u[1:] + u[:-1]) / 2
    tau += np.random.default_rng(seed).normal(0, noise_nm, tau.shape)
    signals = {"t_ns": regular_times(len(q), rate_hz), "q": q, "dq": dq, "tau": tau}
    meta = {"rate_hz": rate_hz, "torque_timing": timing, "source": "test", "robot_sha256": ""}
    return Recording(name=f"made-{seed}", joints=("shoulder", "elbow"), **signals, **meta)


def setup_of(tree: _core.Tree, widths=WIDTHS) -> Setup:
    prior = _core.PriorSettings()
    prior.widths_rad = list(widths)
    return Setup(tree, settings("averaged", RATE_HZ, GAIN), 100, prior)


FRICTION = {  # of shoulder and elbow, as it stands in r
    "constant": (0.8, -0.5),  # N m
    "viscous": (-1.5, -0.7),  # N m s/rad
    "coulomb": (-4.0, -2.0),  # N m, over 0.05 rad/s
    "presliding": (-2.0, -1.0),  # N m, of the wider state
    "load": (-0.08, -0.05),  # of |beta|
}
SEARCHED = PriorConfig(WIDTHS, False, coulomb_speeds_rad_s=(0.05,), most_ripples=2, correct_model=False)
CORRECTED = PriorConfig(WIDTHS, False, coulomb_speeds_rad_s=(0.05,), most_ripples=0)
ONE_SPEED = replace(CORRECTED, correct_model=False)
BASIS = replace(ONE_SPEED, find_kinematics=False)


def loaded(q, dq, beta):
    """All of FRICTION."""
    return unloaded(q, dq, beta) + FRICTION["load"] * np.abs(beta) * np.tanh(dq / 0.05)


def unloaded(q, dq, beta):
    """FRICTION without what grows with the load: it needs no model."""
    known = {"constant": np.ones_like(q), "viscous": dq, "coulomb": np.tanh(dq / 0.05)}
    known["presliding"] = twin_presliding(q, WIDTHS[1])
    return sum(FRICTION[name] * values for name, values in known.items())


@cache
def rippling(*ripples: tuple[int, float]):
    """Ripple of the elbow alone, (cycles a turn, amplitude [N m]) at a phase of 0.4, beside the rest."""

    def friction(q, dq, beta):
        v = unloaded(q, dq, beta)
        v[:, 1] += sum(amplitude * np.sin(cycles * q[:, 1] + 0.4) for cycles, amplitude in ripples)
        return v

    return friction


@cache  # recordings do not change
def recordings(friction, count=6, seconds=30.0, noise_nm=NOISE_NM, tree=None, first_seed=0) -> tuple[Recording, ...]:
    seeds = range(first_seed, first_seed + count)
    return tuple(record(tree or planar_arm(), motion(seed, seconds), friction, noise_nm, seed) for seed in seeds)


def where(fit: PriorFit, joint: int, kind: str, b: int = 0) -> int:
    """Column of a joint's own term."""
    (found,) = [
        m for m, t in enumerate(fit.settings.terms) if (t.kind, t.a, t.b, t.form) == (getattr(Kind, kind), joint, b, 0)
    ]
    return found


def remaining(setup: Setup, fit: PriorFit | None, made: Recording) -> np.ndarray:
    """r minus prior after the warm-up, by the core; without a fit r itself."""
    said = _core.observe(setup.tree, setup.observer, *made.signals, *([fit.settings] if fit else []))
    return (said.residual - (said.prior if fit else 0))[said.warm.astype(bool)]


def base_parameters(tree: _core.Tree) -> np.ndarray:
    """What a motion in the plane can tell of the two links: both gravity torques (x and y) and both inertias, the
    shoulder's with the elbow's mass 0.3 m away, and the elbow's rotor inertia."""
    first, second = (dict(zip(PARAMETERS, inertial_parameters(link), strict=True)) for link in tree.links)
    carried = first["Izz"] + first["rotor"] + 0.3**2 * second["m"]
    gravity = [first["hx"] + 0.3 * second["m"], first["hy"], second["hx"], second["hy"]]
    return np.array([*gravity, carried, second["Izz"], second["rotor"]])


def test_known_friction_is_recovered_within_its_standard_errors_and_what_is_left_is_noise():
    setup = setup_of(planar_arm())
    fit = fit_prior(setup, recordings(loaded), ONE_SPEED)
    for joint in range(2):
        for kind, values in FRICTION.items():
            m = where(fit, joint, kind, 1 if kind == "presliding" else 0)
            weight, error = fit.weights[joint, m], fit.standard_errors[joint, m]
            # Four: errors from five parts scatter by a third themselves.
            assert abs(weight - values[joint]) < 4 * error, (joint, kind, weight, error)
            assert abs(weight) > 10 * error and fit.determined[joint, m] > 0.9
            assert fit.weights[1 - joint, m] == 0
        for kind, width in (("presliding", 0), ("load_presliding", 1)):  # of which the friction has none
            m = where(fit, joint, kind, width)
            assert fit.standard_errors[joint, m] > abs(fit.weights[joint, m]) / 4
            assert fit.standard_errors[joint, m] > 0
    assert fit.corrections.size == 0 and not fit.settings.corrected_links
    np.testing.assert_array_equal(fit.weights.ravel(), fit.settings.weights)
    left = np.vstack([remaining(setup, fit, made) for made in recordings(loaded, first_seed=50)])
    rmse = np.sqrt(np.mean(left**2, axis=0))
    # 180 s of noise with a memory of 0.1 s determine its RMS to 2 %.
    np.testing.assert_allclose(rmse, FILTERED_NOISE_NM, rtol=0.06)
    np.testing.assert_allclose(fit.error_nm, rmse, rtol=0.06)


def test_held_torques_at_1_khz_tell_the_same_friction():
    def simple(q, dq, beta):
        return FRICTION["viscous"] * dq + FRICTION["coulomb"] * np.tanh(dq / 0.05)

    made = [
        record(planar_arm(), motion(seed, 15.0, 1000.0), simple, 5 * NOISE_NM, seed, 1000.0, "held")
        for seed in range(3)
    ]
    setup = Setup(planar_arm(), settings("held", 1000.0, GAIN), 100)
    fit = fit_prior(setup, made, ONE_SPEED)
    for joint in range(2):
        for kind in ("viscous", "coulomb"):
            m = where(fit, joint, kind)
            assert abs(fit.weights[joint, m] - FRICTION[kind][joint]) < 4 * fit.standard_errors[joint, m]
    # White noise after the filter, as FILTERED_NOISE_NM; 45 s with a memory of 0.1 s determine its RMS to some 4 %.
    a = np.exp(-GAIN / 1000.0)
    np.testing.assert_allclose(fit.error_nm, 5 * NOISE_NM * np.sqrt((1 - a) / (1 + a)), rtol=0.15)


@pytest.mark.parametrize(
    "factors", [{"mass_factor": 0.5}, {"com_factor": 0.5}, {"mass_factor": 0.5, "com_factor": 0.5}, {}]
)
def test_a_wrong_mass_and_a_wrong_centre_of_mass_are_found_and_a_right_one_stays(factors):
    wrong = perturbed(planar_arm(), **factors)
    setup, made = setup_of(wrong), recordings(unloaded)
    fit = fit_prior(setup, made, CORRECTED)
    corrected = _core.Tree(fit.settings.corrected_links, wrong.gravity)
    found, true = base_parameters(corrected), base_parameters(planar_arm())
    # Filtered noise of 0.16 Nm over some 3600 independent samples is 3e-3 Nm; gravity turns that into 3e-4 kg m, and
    # friction that resembles a part of it leaves some times as much. The errors looked for are 0.5 kg m and 0.1 kg m^2.
    np.testing.assert_allclose(found, true, rtol=0, atol=0.015)
    assert not factors or np.abs(base_parameters(wrong) - true).max() > 0.4
    np.testing.assert_allclose(fit.error_nm, FILTERED_NOISE_NM, rtol=0.06)
    q, dq = (np.random.default_rng(1).uniform(-2, 2, (200, 2)) for _ in range(2))
    for ours, theirs in zip(corrected.momentum(q, dq), planar_arm().momentum(q, dq), strict=True):
        assert np.abs(ours - theirs).max() < 5e-3 * np.abs(theirs).max()


def test_a_joint_of_unknown_torque_constant_gets_friction_alone_and_the_model_of_the_others_is_found():
    """Its amperes are a 38th of its torque, and gravity and inertia hardly show in them. A model in N m there would be
    corrected until it vanishes in the poses of training, and in no others."""
    wrong, k = perturbed(planar_arm(), mass_factor=0.5), 38.0
    setup = setup_of(wrong)
    setup = replace(setup, observer=with_constants(setup.observer, constants_of(np.ones(2), [0])))
    alone = recordings(unloaded, tree=no_model(planar_arm()))
    made = [
        replace(one, tau=np.column_stack([of_friction.tau[:, 0] / k, one.tau[:, 1]]))
        for one, of_friction in zip(recordings(unloaded), alone, strict=True)
    ]
    fit = fit_prior(setup, made[:3], CORRECTED)
    found, true = (
        base_parameters(tree) for tree in (_core.Tree(fit.settings.corrected_links, wrong.gravity), planar_arm())
    )
    np.testing.assert_allclose(found[[2, 3, 5, 6]], true[[2, 3, 5, 6]], rtol=0, atol=0.02)  # the elbow's own
    for one in made[3:]:  # motion that was not trained on
        left = remaining(setup, fit, one)
        np.testing.assert_allclose(np.sqrt(np.mean(left**2, axis=0)), FILTERED_NOISE_NM / np.array([k, 1.0]), rtol=0.15)


def test_corrections_that_only_the_ridge_decides_are_distinguished_from_those_that_the_data_do():
    fit = fit_prior(setup_of(perturbed(planar_arm(), mass_factor=0.5)), recordings(unloaded), CORRECTED)
    told = dict(zip(PARAMETERS, fit.corrections_determined.T, strict=True))
    # The elbow's gravity torque, inertia and rotor follow from its own motion. Its mass shows only together with the
    # shoulder's first moment, and the shoulder's inertia only together with its rotor.
    assert min(told["hx"][1], told["hy"][1], told["Izz"][1], told["rotor"][1]) > 0.99
    assert max(told["m"][1], told["hx"][0], told["Izz"][0], told["rotor"][0]) < 0.9
    out_of_plane = [told[name] for name in ("hz", "Ixx", "Iyy", "Ixy", "Ixz", "Iyz")]
    np.testing.assert_array_equal(out_of_plane, 0)
    m = PARAMETERS.index("hx")
    assert abs(fit.corrections[1, m] - 0.5 * 9.920 * 0.16078) < 5 * fit.correction_errors[1, m]


def test_without_a_model_gravity_and_inertia_terms_reach_the_noise():
    bare = no_model(planar_arm())
    setup = setup_of(bare)
    fit = fit_prior(setup, recordings(unloaded), BASIS)
    # 26 more weights a joint cost a few percent.
    assert (fit.error_nm < 1.08 * FILTERED_NOISE_NM).all()
    before = np.std(np.vstack([remaining(setup, None, made) for made in recordings(unloaded, count=1)]), axis=0)
    assert (before > 30 * FILTERED_NOISE_NM).all()
    left = remaining(setup, fit, recordings(unloaded, count=1, first_seed=60)[0])
    assert (np.sqrt(np.mean(left**2, axis=0)) < 1.15 * FILTERED_NOISE_NM).all()
    assert fit.corrections.size == 0 and not fit.settings.corrected_links


def test_the_filtered_basis_without_a_model_holds_the_planar_arm_exactly():
    """No noise, no friction: gravity, momentum and quadratic terms are the arm, so that only the ridge remains."""
    setup, made = setup_of(no_model(planar_arm())), recordings(None, noise_nm=0.0, count=5, seconds=10.0)
    fit = fit_prior(setup, made, BASIS)
    largest = np.abs(remaining(setup, None, made[0])).max(axis=0)
    assert fit.ridge == 1e-7 and (fit.error_nm < 1e-3 * largest).all()


def ripples_of(fit: PriorFit) -> list[tuple[int, int]]:
    """(joint, cycles) that the fit holds."""
    return sorted({(t.a, t.b) for t in fit.settings.terms if t.kind == Kind.ripple})


def test_a_ripple_of_37_cycles_a_turn_is_found_with_its_amplitude_and_phase_and_not_found_again():
    setup, made = setup_of(planar_arm()), recordings(rippling((37, 1.2)), count=2)
    fit = fit_prior(setup, made, SEARCHED)
    assert ripples_of(fit) == [(1, 37)]
    sine = where(fit, 1, "ripple", 37)
    assert fit.settings.terms[sine + 1].form == 1
    for m, expected in ((sine, 1.2 * np.cos(0.4)), (sine + 1, 1.2 * np.sin(0.4))):
        assert abs(fit.weights[1, m] - expected) < 4 * fit.standard_errors[1, m] + 0.01  # the ridge shortens it
    without = fit_terms(setup, made, ONE_SPEED, [[], []], Inertia())
    assert find_ripple(setup, made, without, [[], []]) == [[], [37]]
    assert find_ripple(setup, made, without, [[], [37]]) == [[], []]


def test_two_ripples_of_a_joint_are_found_one_after_the_other_and_no_more_than_asked_for():
    made = recordings(rippling((37, 1.2), (100, 2.5)), count=2)
    assert ripples_of(fit_prior(setup_of(planar_arm()), made, SEARCHED)) == [(1, 37), (1, 100)]
    assert len(ripples_of(fit_prior(setup_of(planar_arm()), made, replace(SEARCHED, most_ripples=1)))) == 1


@pytest.mark.parametrize(
    "made",
    [
        # 80 s: in much shorter recordings the largest of 400 candidates explains 3 % of mere noise.
        lambda: recordings(unloaded, count=2, seconds=40.0),
        lambda: recordings(rippling((37, 1.2)), count=1, seconds=20.0),  # less than 45 s
    ],
)
def test_no_ripple_is_found_where_there_is_none_or_too_little_motion(made):
    assert ripples_of(fit_prior(setup_of(planar_arm()), made(), SEARCHED)) == []


def test_noise_and_short_recordings_ask_for_a_stronger_ridge():
    quiet = fit_prior(setup_of(planar_arm()), recordings(loaded, noise_nm=0.05), ONE_SPEED)
    noisy = fit_prior(setup_of(planar_arm()), recordings(loaded, seconds=2.0, count=5, noise_nm=20.0), ONE_SPEED)
    assert noisy.ridge > 100 * quiet.ridge


def test_recordings_shorter_than_the_warm_up_are_left_out_and_refused_where_there_are_no_others():
    long, short = recordings(loaded, count=4), recordings(loaded, count=5, seconds=0.5, first_seed=70)
    with pytest.raises(TrainingError, match="no training recording is longer than the observer's warm-up"):
        fit_prior(setup_of(planar_arm()), short, CORRECTED)
    with_short = fit_prior(setup_of(planar_arm()), long + short[:1], ONE_SPEED)
    assert np.isfinite(with_short.error_nm).all() and (with_short.error_nm < 1.1 * FILTERED_NOISE_NM).all()


@pytest.mark.parametrize("short", [0, 5])
def test_a_single_recording_is_cross_validated_in_parts_also_beside_short_ones(short):
    made = recordings(loaded, count=1, seconds=60.0)
    made += recordings(loaded, count=short, seconds=0.5, first_seed=70)
    fit = fit_prior(setup_of(planar_arm()), made, ONE_SPEED)
    assert (fit.standard_errors[0, : len(fit.settings.terms) // 2] > 0).all()
    np.testing.assert_allclose(fit.error_nm, FILTERED_NOISE_NM, rtol=0.15)


def test_a_fit_does_not_depend_on_how_many_rows_of_the_links_are_held(monkeypatch):
    made, setup = recordings(loaded, count=1, seconds=60.0), setup_of(planar_arm())
    whole = fit_prior(setup, made, ONE_SPEED)
    monkeypatch.setattr("tauext.fit.ridge.BLOCK", 100)
    in_blocks = fit_prior(setup, made, ONE_SPEED)
    np.testing.assert_allclose(in_blocks.weights, whole.weights, rtol=0, atol=1e-9)
    np.testing.assert_allclose(in_blocks.error_nm, whole.error_nm, rtol=1e-9)


def test_a_joint_that_never_moves_gets_no_friction_and_says_so():
    made = []
    for seed in range(3):
        q, dq = motion(seed, 20.0)
        q[:, 1], dq[:, 1] = 0.7, 0.0
        made.append(record(planar_arm(), (q, dq), unloaded, NOISE_NM, seed))
    fit = fit_prior(setup_of(planar_arm()), made, ONE_SPEED)
    for kind in ("viscous", "coulomb", "presliding", "load"):
        m = where(fit, 1, kind)
        assert fit.weights[1, m] == 0 and fit.determined[1, m] == 0
    assert abs(fit.weights[0, where(fit, 0, "viscous")] - FRICTION["viscous"][0]) < 0.1


@pytest.mark.parametrize(
    "config", [PriorConfig(WIDTHS, most_ripples=0), SEARCHED, pytest.param(PriorConfig(WIDTHS), marks=pytest.mark.slow)]
)
def test_the_same_recordings_give_the_same_bytes_on_any_number_of_threads(config):
    made, factor = recordings(rippling((37, 1.2)), count=2), 0.5 if config.correct_model else 1.0
    setup = setup_of(perturbed(planar_arm(), mass_factor=factor))
    one, other = (fit_prior(replace(setup, threads=n), made, config) for n in (1, 4))
    assert config is not SEARCHED or ripples_of(one) == [(1, 37)]
    assert bool(one.settings.corrected_links) == config.correct_model == bool(one.corrections.size)
    of_both = [[(t.kind, t.a, t.b, t.c, t.form, t.speed) for t in fit.settings.terms] for fit in (one, other)]
    assert of_both[0] == of_both[1]
    for name in ("error_nm", "weights", "standard_errors", "determined", "corrections", "correction_errors"):
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes()
    assert one.settings.weights == other.settings.weights and one.ridge == other.ridge
    for a, b in zip(one.settings.corrected_links, other.settings.corrected_links, strict=True):
        assert (a.mass, a.com, a.inertia, a.rotor_inertia) == (b.mass, b.com, b.inertia, b.rotor_inertia)


def with_links(tree: _core.Tree, **changes: tuple) -> _core.Tree:
    """The tree with these members of its links, a value a link."""
    links = tree.links
    for name, values in changes.items():
        for link, value in zip(links, values, strict=True):
            setattr(link, name, value)
    return _core.Tree(links, tree.gravity)


NO_ROTORS = {"rotor_inertia": (0.0, 0.0)}
LARGE = {"inertia": ([0.2, 0.2, 0.2, 0, 0, 0], [0.14, 0.14, 0.14, 0, 0, 0])}
NOTHING = {"mass": 0.0, "com": [0.0] * 3, "inertia": [0.0] * 6}


def massless(which: int) -> dict[str, tuple]:
    """This link as a file has it that states no inertial."""
    links = planar_arm().links
    return {name: tuple(none if k == which else getattr(link, name) for k, link in enumerate(links))
            for name, none in NOTHING.items()}  # fmt: skip


@pytest.mark.parametrize(
    ("true", "estimated", "first_seed"),
    [
        (NO_ROTORS, NO_ROTORS | LARGE, 0),  # must not end as a negative rotor inertia
        (NO_ROTORS, {}, 0),  # noise decides on which side of zero what is left of a rotor comes out; both must do
        (NO_ROTORS, {}, 30),
        ({}, massless(0), 0),
        ({}, massless(1), 0),
    ],
)
def test_what_the_robot_file_has_too_much_or_too_little_is_corrected(true, estimated, first_seed):
    made = recordings(unloaded, tree=with_links(planar_arm(), **true), first_seed=first_seed)
    setup = setup_of(with_links(planar_arm(), **estimated))
    fit = fit_prior(setup, made, CORRECTED)
    assert all(link.rotor_inertia >= 0 for link in fit.settings.corrected_links)
    left = np.vstack([remaining(setup, fit, one) for one in made])
    np.testing.assert_allclose(np.sqrt(np.mean(left**2, axis=0)), FILTERED_NOISE_NM, rtol=0.06)


def test_the_terms_of_an_arm_of_any_size_fit_it():
    for joints in (1, 2, 3, 7):
        links = []
        for k in range(joints):
            link = with_inertial_parameters(planar_arm().links[0], inertial_parameters(planar_arm().links[0]))
            link.joint_name, link.parent = f"joint{k}", k - 1
            links.append(link)
        with_model = _core.Tree(links, [0, -9.81, 0])
        for tree in (with_model, no_model(with_model)):
            setup = setup_of(tree, PriorConfig().widths_rad)
            assert has_model(setup) == (tree is with_model)
            load = BY_ESTIMATED if has_model(setup) else None
            terms = [t for joint in range(joints) for t in own_terms(setup, PriorConfig(), joint, [37, 100], load)]
            terms += [] if has_model(setup) else shared_terms(setup)
            q = np.zeros((3, joints))
            prior = prior_of(terms, np.zeros((joints, len(terms))), setup.widths_rad)
            _core.observe(tree, setup.observer, regular_times(3, RATE_HZ), q, q, q, prior)
            different = {(t.kind.value, t.a, t.b, t.c, t.form, t.speed) for t in terms}
            assert len(different) == len(terms)


def test_no_presliding_widths_are_a_prior_without_presliding_states():
    config = PriorConfig((), coulomb_speeds_rad_s=(0.05,), most_ripples=0, correct_model=False)
    fit = fit_prior(setup_of(planar_arm(), ()), recordings(unloaded, count=2), config)
    assert {t.kind for t in fit.settings.terms} == {Kind.constant, Kind.viscous, Kind.coulomb, Kind.load}


def trembling(seed: int, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Slow strides with a tremble on them, so that joints reverse again before they slide."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE_HZ))[:, None, None] / RATE_HZ
    size, speed = np.array([0.15, 0.02, 0.008]), rng.uniform([0.5, 4.0, 9.0], [0.8, 7.0, 15.0], (2, 3))
    phase = rng.uniform(0, 2 * np.pi, (2, 3))
    return (size * np.sin(speed * t + phase)).sum(axis=2), (size * speed * np.cos(speed * t + phase)).sum(axis=2)


def remembering(local: tuple[float, float]):
    """Presliding friction of which each joint has such a share with local memory."""

    def friction(q, dq, beta):
        bank = sum(b * twin_presliding(q, w) for b, w in zip(BRANCH, WIDTHS, strict=True))
        return np.array([-6.0, -3.0]) * (bank + np.array(local) * twin_memory_gap(q, WIDTHS, BRANCH))

    return friction


@pytest.mark.parametrize("local", [(0.0, 1.0), (1.0, 0.5), (0.0, 0.0)])
def test_free_motion_shows_which_friction_has_local_memory(local):
    friction = remembering(local)
    made = [record(planar_arm(), trembling(k, 30.0), friction, NOISE_NM, k) for k in range(6)]
    bank = fit_terms(setup_of(planar_arm()), made, ONE_SPEED, [[], []], Inertia(load=BY_ESTIMATED))
    fit = fit_prior(setup_of(planar_arm()), made, ONE_SPEED)
    np.testing.assert_allclose(np.reshape(fit.settings.branches, (2, 2)).sum(axis=1), 1.0)
    found = {t.a: fit.weights[t.a, m] for m, t in enumerate(fit.settings.terms) if t.kind == Kind.local_memory}
    assert set(found) == {j for j in range(2) if local[j]}
    # The branch is that of a fit with nonlocal memory alone: not quite the true one where half of all reversals are.
    for j, share in enumerate(local):
        assert found.get(j, 0.0) / [-6.0, -3.0][j] == pytest.approx(share, abs=0.35)
        assert fit.error_nm[j] < (0.6 if share else 1.01) * bank.error_nm[j]


def test_a_width_that_friction_knows_nothing_of_is_left_out_and_one_that_it_needs_is_kept():
    widths = (5e-4, 2e-3, 2e-2, 6e-2)  # friction bends over the third; the last is the region's, and stays
    config = replace(ONE_SPEED, widths_rad=widths, drop_widths=True, region_width_rad=6e-2)
    all_of_them = fit_prior(setup_of(planar_arm(), widths), recordings(unloaded), replace(config, drop_widths=False))
    fit = fit_prior(setup_of(planar_arm(), widths), recordings(unloaded), config)
    assert fit.settings.widths_rad == [2e-2, 6e-2]
    assert sorted(fit.dropped_widths) == [5e-4, 2e-3]
    assert all("the error grows by" in reason for reason in fit.dropped_widths.values())
    assert (fit.error_nm < 1.002 * all_of_them.error_nm).all()
    assert {t.b for t in fit.settings.terms if t.kind == Kind.presliding} == {0, 1}


def test_widths_within_two_counts_of_the_encoder_are_left_out():
    def bent_narrowly(q, dq, beta):
        return FRICTION["presliding"] * twin_presliding(q, 2e-3)

    made = recordings(bent_narrowly)
    coarse = [replace(one, q=np.round(one.q / 1.5e-3) * 1.5e-3) for one in made]
    config = replace(ONE_SPEED, drop_widths=True)
    assert encoder_count(coarse) == pytest.approx(1.5e-3, rel=1e-9)
    fit = fit_prior(setup_of(planar_arm()), coarse, config)
    assert list(fit.dropped_widths) == [2e-3] and "2 encoder counts of 0.0015 rad" in fit.dropped_widths[2e-3]
    assert fit.settings.widths_rad == [2e-2]
    # The same friction seen by a fine encoder needs that width.
    assert fit_prior(setup_of(planar_arm()), made, config).settings.widths_rad == [2e-3, 2e-2]


def test_an_encoder_that_never_moves_has_no_count():
    still = recordings(unloaded, count=1)[0]
    assert encoder_count([replace(still, q=np.ones_like(still.q))]) == 0.0


def test_textbook_friction_finds_its_three_numbers_a_joint_and_nothing_else():
    def textbook(q, dq, beta):
        return FRICTION["constant"] + FRICTION["viscous"] * dq + FRICTION["coulomb"] * np.tanh(dq / 0.03)

    setup = setup_of(planar_arm(), ())
    fit = fit_friction(setup, recordings(textbook))
    assert [(t.kind, t.a) for t in fit.settings.terms] == [
        (kind, joint) for joint in range(2) for kind in (Kind.constant, Kind.viscous, Kind.coulomb)
    ]
    assert not fit.settings.corrected_links and not fit.settings.widths_rad
    for joint in range(2):
        for kind in ("constant", "viscous", "coulomb"):
            m = where(fit, joint, kind)
            assert abs(fit.weights[joint, m] - FRICTION[kind][joint]) < 4 * fit.standard_errors[joint, m]
            assert fit.weights[1 - joint, m] == 0
    np.testing.assert_allclose(fit.error_nm, FILTERED_NOISE_NM, rtol=0.06)


def test_textbook_friction_without_a_model_leaves_gravity_in_r():
    setup, made = setup_of(no_model(planar_arm()), ()), recordings(unloaded)
    fit = fit_friction(setup, made)
    assert len(fit.settings.terms) == 6
    gravity_nm = np.vstack([planar_arm().momentum(one.q, np.zeros_like(one.dq))[1] for one in made]).std(axis=0)
    assert (fit.error_nm > 0.5 * gravity_nm).all()


SERVO = {"servo": {"torque_from": "duty", "velocity_steps": 20}}


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
def servo_recordings():
    made = [record(planar_arm(), turning(seed), with_play, 0.2, seed) for seed in range(6)]
    return [replace(one, provenance=SERVO) for one in made]


def test_play_is_found_at_its_joint_and_width(servo_recordings):
    said = []
    fit = fit_prior(setup_of(planar_arm()), servo_recordings, ONE_SPEED, said.append)
    assert [(t.a, t.b) for t in fit.settings.terms if t.kind == Kind.backlash] == [(0, 1)]
    # r holds beta (1 - |z|) whole: a weight of 1.
    assert fit.weights[0, where(fit, 0, "backlash", 1)] == pytest.approx(1.0, abs=0.05)
    assert said[-1] == "play that carries no weight: shoulder 40 mrad"


def test_other_arms_and_arms_without_play_have_none(servo_recordings):
    plain = [replace(one, provenance={}) for one in servo_recordings]
    made = [record(planar_arm(), turning(seed), loaded, 0.2, seed) for seed in range(6)]
    for recorded in (plain, [replace(one, provenance=SERVO) for one in made]):
        fit = fit_prior(setup_of(planar_arm()), recorded, ONE_SPEED)
        assert not [t for t in fit.settings.terms if t.kind == Kind.backlash]
    assert play_sentence((None, None), WIDTHS, ("shoulder", "elbow")) == ""
