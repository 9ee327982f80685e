"""A regression that knows before what weights may be, against the minimum of its cost written out row by row."""

import numpy as np
import pytest
from made_arms import planar_arm
from scipy.optimize import minimize
from tauext_fleet.map_regression import MapRegression, WeightPrior
from test_small_datasets import corrections_problem

from tauext.fit.links import ROTOR, bound_links
from tauext.fit.regression import NormalEquations
from tauext.robot.inertial import PARAMETERS

NOISE = np.array([0.5, 2.0])
COLUMNS = (np.array([0, 1, 4]), np.array([2, 3, 4]))  # two of its own a joint, one that both share
TRUE = np.array([3.0, -1.0, 2.0, 0.5, 1.5])
MEAN = np.array([2.5, -1.2, 2.2, 0.4, 1.0])


def rows(seed: int = 0, count: int = 300) -> list[tuple[np.ndarray, np.ndarray]]:
    """Regressors and target of each joint."""
    rng = np.random.default_rng(seed)
    made = []
    for at, noise in zip(COLUMNS, NOISE, strict=True):
        X = rng.normal(size=(count, len(at)))
        made.append((X, X @ TRUE[at] + noise * rng.normal(size=count)))
    return made


def equations(made, pieces: int = 5) -> list[NormalEquations]:
    cut = [[(x, y) for x, y in zip(np.array_split(X, pieces), np.array_split(Y, pieces), strict=True)] for X, Y in made]
    return [
        NormalEquations(
            COLUMNS,
            [X.T @ X for X, _ in piece],
            [X.T @ y for X, y in piece],
            np.array([y @ y for _, y in piece]),
            len(piece[0][1]),
        )
        for piece in zip(*cut, strict=True)
    ]


def prior(size: float = 0.5, memory_s: float = 0.03, trust: float = 1.0) -> WeightPrior:
    rng = np.random.default_rng(5)
    mixed = rng.normal(size=(5, 5))
    return WeightPrior(MEAN, size**2 * (mixed @ mixed.T + np.eye(5)), NOISE, np.full(2, memory_s), trust)


def cost(w: np.ndarray, made, known: WeightPrior, regression: MapRegression, period_s: float) -> float:
    """As the module's docstring has it."""
    counts = known.trust * np.minimum(1, period_s / known.memory_s) / regression.error_nm**2
    left = sum(c * np.sum((y - X @ w[at]) ** 2) for c, (X, y), at in zip(counts, made, COLUMNS, strict=True))
    apart = w - known.mean
    return float(left + apart @ np.linalg.solve(known.covariance, apart))


@pytest.mark.parametrize("trust", [1.0, 0.1])
def test_the_solution_is_the_minimum(trust):
    made, known = rows(), prior(trust=trust)
    regression = MapRegression(equations(made), known, 0.01)
    found = minimize(cost, np.zeros(5), args=(made, known, regression, 0.01), method="BFGS", options={"gtol": 1e-9})
    assert regression.solve(regression.whole) == pytest.approx(found.x, abs=1e-5)


def test_a_wide_fleet_leaves_the_arm_to_itself_and_a_narrow_one_decides():
    made = rows()
    wide, narrow = (MapRegression(equations(made), prior(size), 0.01) for size in (1e4, 1e-6))
    counts = 1 / wide.error_nm**2
    A, b = np.zeros((5, 5)), np.zeros(5)
    for c, (X, y), at in zip(counts, made, COLUMNS, strict=True):
        A[np.ix_(at, at)] += c * X.T @ X
        b[at] += c * X.T @ y
    assert wide.solve(wide.whole) == pytest.approx(np.linalg.solve(A, b), rel=1e-6)
    assert narrow.solve(narrow.whole) == pytest.approx(MEAN, abs=1e-6)
    assert (wide.determined() > 0.999).all() and (narrow.determined() < 1e-3).all()


def test_a_weight_that_is_fixed_moves_the_others_as_the_cost_says():
    made, known = rows(), prior()
    regression = MapRegression(equations(made), known, 0.01)
    regression.fix(4, 0.0)

    def held(w: np.ndarray) -> float:
        return cost(np.r_[w, 0.0], made, known, regression, 0.01)

    found = minimize(held, np.zeros(4), method="BFGS", options={"gtol": 1e-9})
    assert regression.solve(regression.whole) == pytest.approx(np.r_[found.x, 0.0], abs=1e-5)


def test_the_size_of_the_error_is_found_in_what_is_left():
    made = rows(count=2000)
    regression = MapRegression(equations(made), WeightPrior(MEAN, np.eye(5), 2 * NOISE, np.full(2, 0.01)), 0.01)
    assert regression.error_nm == pytest.approx(np.maximum(NOISE, 0.5 * 2 * NOISE), rel=0.1)


def test_a_column_that_no_arm_of_the_fleet_shows_stays_at_its_mean():
    made, known = rows(), prior()
    covariance = known.covariance.copy()
    covariance[1], covariance[:, 1] = 0, 0
    dark = WeightPrior(MEAN * [1, 0, 1, 1, 1], covariance, NOISE, known.memory_s)
    regression = MapRegression(equations(made), dark, 0.01)
    assert regression.solve(regression.whole)[1] == 0 and not regression.used[1]


def test_a_fleet_whose_mean_no_link_can_have_gives_an_arm_that_can_be():
    """Columns that no arm of the fleet excited keep its mean, which may be beyond the bounds by rounding."""
    tree, plain = planar_arm(), corrections_problem(ROTOR, 0.1)
    width = 2 * len(PARAMETERS)
    mean, covariance = np.zeros(width), np.eye(width)
    mean[ROTOR], covariance[ROTOR, :], covariance[:, ROTOR] = -0.85, 0.0, 0.0
    prior = WeightPrior(mean, covariance, np.ones(2), np.ones(2))
    regression = MapRegression(plain.folds, prior, 0.01)
    bound_links(regression, tree)
    solution = regression.solve(regression.whole)
    assert tree.links[0].rotor_inertia + solution[ROTOR] == 0 and not regression.used[ROTOR]
