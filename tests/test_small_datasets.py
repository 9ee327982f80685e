"""Fits of small datasets that lack something: a healthy bundle or one line of refusal, and parameters that can be."""

import json
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from made_arms import planar_arm
from made_planar import CONFIG, dataset, moving
from scipy.optimize import lsq_linear
from small_datasets import ARMS, COUNT, SIGNALS, Ending, of_number

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.check.clock import repeat_findings
from tauext.check.examination import Examination
from tauext.data.dataset import load_dataset
from tauext.data.recording import Recording
from tauext.fit.bundle_writing import torque_at_rest
from tauext.fit.links import MASS, bound_links, is_possible, solve_possible
from tauext.fit.regression import NormalEquations, Regression, inverse, solve_within
from tauext.robot.inertial import PARAMETERS, inertial_parameters, with_inertial_parameters
from tauext.train.stage import train_bundle
from tauext.train.wrench import squared_distances

CHUNK = 13
"""Datasets of a slow test: one of each arm."""
EVERY = 5
"""One in so many is used: each arm meets a fifth of the signals, and each of the signals a fifth of the arms."""


def number(arm: str, signals: str) -> int:
    """Of the dataset of this arm and these signals."""
    return list(ARMS).index(arm) + len(ARMS) * list(SIGNALS).index(signals)


FEW = {
    number("one joint", "plain"),
    number("one upright joint", "zero torque"),
    number("parallel", "few seconds"),
    number("wrong masses", "constant torque"),
    number("crossed", "frozen"),
    number("weightless links", "one joint moves"),
    number("one joint, no model", "huge torques"),
    number("one joint, no model", "repeated rows"),  # its error scale ends below its bound by rounding
}
"""Always used: each ended badly once."""


def expect_sound(endings: Iterable[Ending]) -> None:
    """Every ending is a healthy bundle or one line."""
    bad = [f"{one.number} {one.words} [{one.stage}]: {one.fault}" for one in endings if one.fault]
    assert not bad, "\n".join(bad)


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, COUNT, CHUNK))
def test_every_small_dataset_ends_in_a_healthy_bundle_or_one_line(first):
    numbers = [k for k in range(first, min(first + CHUNK, COUNT)) if (k // CHUNK + k) % EVERY == 0 or k in FEW]
    expect_sound([one for k in numbers for one in of_number(k)])


def problem(rng: np.random.Generator, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Columns, some of them nearly the same, and a target."""
    X = rng.normal(size=(rows, columns)) * 10 ** rng.uniform(-2, 2, columns)
    X[:, 1] = X[:, 0] + 1e-4 * X[:, 1]
    return X, rng.normal(size=rows)


@pytest.mark.parametrize("seed", range(20))
def test_the_solution_within_bounds_is_that_of_a_bounded_least_squares_solver(seed):
    rng = np.random.default_rng(seed)
    X, y = problem(rng, 30, 8)
    low = np.where(rng.random(8) < 0.5, rng.uniform(-0.1, 0.05, 8), -np.inf)
    high = np.where(rng.random(8) < 0.3, np.maximum(low, 0) + rng.uniform(0, 0.1, 8), np.inf)
    found = solve_within(X.T @ X + 1e-6 * np.eye(8), X.T @ y, low, high)
    whole = np.vstack([X, 1e-3 * np.eye(8)])
    oracle = lsq_linear(whole, np.r_[y, np.zeros(8)], (low, high + 1e-300), method="bvls", tol=1e-14).x
    assert (low <= found).all() and (found <= high).all()
    # The cost is what both minimise; nearly equal columns leave the coefficients themselves open.
    cost, best = (float(np.sum((whole @ w - np.r_[y, np.zeros(8)]) ** 2)) for w in (found, oracle))
    assert cost <= best * (1 + 1e-9)


def test_without_a_bound_in_the_way_nothing_changes_by_a_bit():
    X, y = problem(np.random.default_rng(0), 30, 8)
    gram, moment = X.T @ X + np.eye(8), X.T @ y
    free = np.linalg.solve(gram, moment)
    np.testing.assert_array_equal(solve_within(gram, moment, free - 1e-12, free + 1e-12), free)


def test_an_inverse_that_rounding_would_spoil_stays_positive_definite():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    sound = root @ root.T
    np.testing.assert_allclose(inverse(sound), np.linalg.inv(sound), rtol=1e-9)
    for k in range(50):
        root = rng.normal(size=(6, 2)) * 10.0 ** rng.uniform(-8, 8)
        spoilt = inverse(root @ root.T + 1e-30 * np.eye(6))
        assert (np.diag(spoilt) > 0).all() and np.isfinite(spoilt).all(), k


def corrections_problem(column: int, value: float) -> Regression:
    """Equations of the planar arm's 22 corrections, of which one is not 0, with noise of 1e-3 in 500 rows."""
    rng, n = np.random.default_rng(0), 2
    truth = np.zeros(n * len(PARAMETERS))
    truth[column] = value
    columns, equations = tuple(np.arange(len(truth)) for _ in range(n)), []
    for _ in range(5):
        X = [rng.normal(size=(50, len(truth))) for _ in range(n)]
        y = np.stack([x @ truth + 1e-3 * rng.normal(size=50) for x in X], axis=1)
        gram, moment = [x.T @ x for x in X], [x.T @ y[:, i] for i, x in enumerate(X)]
        equations.append(NormalEquations(columns, gram, moment, (y**2).sum(axis=0), 50))
    return Regression(equations)


def possible_solution(regression: Regression) -> np.ndarray:
    """Within the bounds of the planar arm's links, which the core takes."""
    tree = planar_arm()
    bound_links(regression, tree)
    solution = solve_possible(regression, regression.whole, 1e-7, tree)
    moved = [inertial_parameters(link) + by for link, by in zip(tree.links, solution.reshape(2, -1), strict=True)]
    _core.Tree([with_inertial_parameters(a, b) for a, b in zip(tree.links, moved, strict=True)], tree.gravity)
    return solution


@pytest.mark.parametrize("by", [-5.0, -0.3 - 1e-9, -0.2, 0.5])
def test_a_rotor_inertia_is_bounded_in_the_fit(by):
    solution = possible_solution(corrections_problem(2 * len(PARAMETERS) - 1, by))
    # 5 standard errors of 1e-3 / sqrt(500); where the bound holds, all of what is below 0 is left unexplained.
    assert solution[-1] == (pytest.approx(by, abs=2e-4) if by > -0.3 else -planar_arm().links[1].rotor_inertia)


def test_an_impossible_mass_keeps_the_files():
    regression = corrections_problem(MASS, -20.0)  # the shoulder weighs 8 kg
    assert possible_solution(regression)[MASS] == 0 and not regression.used[MASS]


@pytest.mark.parametrize(
    ("mass", "moment", "possible"),
    [
        (1.0, 0.1, True),
        (0.0, 0.0, True),
        (0.0, 0.1, False),
        (-1.0, 0.1, False),
        (1e-9, 1e-9, False),
        (1e-3, 1e4, False),
    ],
)
def test_a_mass_goes_with_its_first_moment(mass, moment, possible):
    p = np.zeros(len(PARAMETERS))
    p[0], p[1], p[4:7] = mass, moment, 1.0 if moment else 0.0
    assert is_possible(p) == possible
    if possible:  # what is possible, the core takes
        _core.Tree([with_inertial_parameters(planar_arm().links[0], p)], [0, 0, -9.81])


def test_held_parameters_are_listed_by_the_training(tmp_path):
    """A rotor that is heavier in the file than in the arm by more than all of it cannot be told: it is 0, and named."""
    folder = dataset(tmp_path / "data", moving(1, 40.0, (1.0, 1.0)))
    text = (folder / "robot.xml").read_text().replace('mass="9.920"', 'mass="9.920"').replace("0.07 0.07 0.07", "5 5 5")
    (folder / "robot.xml").write_text(text)
    train_bundle(load_dataset(folder), tmp_path / "x.tauext", config=CONFIG, check=False)
    facts = json.loads(load_bundle(tmp_path / "x.tauext").provenance)
    links = load_bundle(tmp_path / "x.tauext").prior.corrected_links
    for name, link in zip(("shoulder", "elbow"), links, strict=True):
        assert ("rotor" in facts["prior"]["held"].get(name, [])) == (link.rotor_inertia == 0)
    held = [note for note in facts.get("notes", []) if note.startswith("the motion does not determine")]
    assert len(held) == bool(facts["prior"]["held"])


def test_the_distance_of_an_error_is_its_square_in_standard_deviations_however_unequal_they_are():
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    sound = (turn * [1.0, 4.0, 9.0]) @ turn.T
    assert squared_distances(turn[:, :1].T, sound[None])[0] == pytest.approx(1.0)
    flat = (turn * [1.0, 4.0, 1e-30]) @ turn.T  # np.linalg.inv finds it singular
    assert np.isfinite(squared_distances(turn[:, :1].T, flat[None])).all()
    assert squared_distances(np.zeros((1, 3)), flat[None])[0] == 0


def resting(tau: np.ndarray, q: np.ndarray) -> Recording:
    return replace(moving(0, len(tau) / 125.0, (1.0, 1.0)), q=q, dq=np.zeros_like(q), tau=tau)


def test_the_torque_at_rest_is_what_it_moved_by_while_the_encoder_stood():
    tau = np.zeros((6, 2))
    tau[:, 0], tau[:, 1] = [1, -1, 5, 6, 7, 0], [1, -1, 5, 6, 7, 0]
    q = np.zeros((6, 2))
    q[:, 1] = [0, 0, 1, 1, 2, 2]
    assert torque_at_rest(resting(tau, q)).tolist() == [8, 7]


def test_rows_that_are_all_the_same_are_a_finding():
    still = resting(np.ones((50, 2)), np.zeros((50, 2)))
    (found,) = repeat_findings(Examination([still]))
    assert "98.0% of the rows equal the row before" in found.evidence and "ms apart" not in found.evidence
