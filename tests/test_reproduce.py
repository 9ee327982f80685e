"""What each scale of the paper's experiment trains, without training it."""

from __future__ import annotations

import pytest

from tauext.cli.reproduce import SCALES, trainings
from tauext.config import PAPER_CASES
from tauext.evaluate.results import bundle_label, place

CASES = tuple(PAPER_CASES)


def test_quick_trains_five_short_networks_and_has_the_default_recipe_beside_them():
    jobs = trainings(SCALES["quick"], CASES, seed=3)
    assert list(jobs) == [*CASES, "exact-tauext"]
    for name, (case, config) in jobs.items():
        assert case.name == name.removesuffix("-tauext") and config.seed == 3
        assert config.recipe == ("tauext" if name.endswith("-tauext") else "dense")
        assert config.resolved().max_steps <= 20_000
    assert jobs["exact-tauext"][1].recipe == type(jobs["exact-tauext"][1])().recipe


def test_full_trains_every_case_by_the_whole_recipe_of_the_paper():
    jobs = trainings(SCALES["full"], CASES, seed=0)
    assert list(jobs) == [*CASES, *(f"{case}-paper" for case in CASES)]
    for case in CASES:
        assert jobs[case][1].resolved().max_steps == 90_000
        whole = jobs[f"{case}-paper"][1].resolved()
        assert (whole.recipe, whole.epochs, whole.batch, whole.max_steps) == ("paper", 500, 1000, None)
        assert jobs[f"{case}-paper"][0] is jobs[case][0]


def test_the_two_hundred_collisions_are_the_same_at_both_scales():
    assert SCALES["quick"].collision_recordings == SCALES["full"].collision_recordings == 20


@pytest.mark.parametrize("scale", SCALES)
def test_only_the_cases_that_were_asked_for_are_trained(scale):
    jobs = trainings(SCALES[scale], ("mass",), seed=0)
    assert set(jobs) <= {"mass", "mass-paper"} and all(case.name == "mass" for case, _ in jobs.values())


def test_a_bundle_beside_another_is_called_by_its_recipe_and_stands_behind_it():
    assert bundle_label("exact-tauext", "tauext") == "exact, tauext recipe"
    assert sorted(["none", "exact-tauext", "exact"], key=place) == ["exact", "exact-tauext", "none"]
