"""What each scale of the paper's experiment trains, without training it."""

from __future__ import annotations

import time
from contextlib import contextmanager
from threading import Barrier

import pytest
from tauext_lab.evaluate.results import bundle_label, place
from tauext_lab.reproduce import SCALES, together, trainings

from tauext.config import PAPER_CASES
from tauext.errors import TrainingError

CASES = tuple(PAPER_CASES)


def test_quick_trains_five_short_networks_and_has_the_default_recipe_beside_them():
    jobs = trainings(SCALES["quick"], CASES, seed=3)
    assert list(jobs) == [*CASES, "exact-prior"]
    for name, (case, config) in jobs.items():
        assert case.name == name.removesuffix("-prior") and config.seed == 3
        assert config.recipe == ("prior" if name.endswith("-prior") else "dense")
        assert (config.resolved().max_steps or 0) <= 20_000
    assert jobs["exact-prior"][1].recipe == type(jobs["exact-prior"][1])().recipe


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


class Heard:
    def __init__(self):
        self.said, self.shown = [], []

    def say(self, sentence):
        self.said.append(sentence)

    @contextmanager
    def progress(self, title):
        yield lambda done, total, note: self.shown.append((done, total, note))


def test_trainings_at_the_same_time_have_one_bar():
    both, heard = Barrier(2, timeout=20.0), Heard()

    def train(name, report):
        both.wait()  # none goes on before the other has begun
        with report.progress(f"train {name}") as show:
            show(1, 2, "loss 1")
        with report.progress("limits") as show:
            show(1, 10, "")
        report.say(f"{name} done")

    together(train, ["exact", "none"], 2, heard)
    assert sorted(heard.said) == ["exact done", "none done"]
    assert [entry[:2] for entry in heard.shown] == [(50, 200), (100, 200)]
    assert heard.shown[0][2] in ("% (exact: loss 1)", "% (none: loss 1)")


@pytest.mark.parametrize("error", [TrainingError("the loss diverges"), KeyboardInterrupt()])
def test_what_stops_one_training_stops_all_and_none_begins(error):
    begun, stopped = [], []
    both = Barrier(2, timeout=20.0)

    def train(name, report):
        begun.append(name)
        both.wait()
        if name == "exact":
            raise error
        try:
            with report.progress("train mass") as show:
                for _ in range(2000):
                    show(1, 2, "")
                    time.sleep(0.01)
        except KeyboardInterrupt:  # where a network writes its checkpoint
            stopped.append(name)
            raise

    with pytest.raises(type(error)):
        together(train, ["exact", "mass", "com", "none"], 2, Heard())
    assert sorted(begun) == ["exact", "mass"] and stopped == ["mass"]


@pytest.mark.parametrize("scale", SCALES)
def test_only_the_cases_that_were_asked_for_are_trained(scale):
    jobs = trainings(SCALES[scale], ("mass",), seed=0)
    assert set(jobs) <= {"mass", "mass-paper"} and all(case.name == "mass" for case, _ in jobs.values())


def test_a_bundle_beside_another_is_called_by_its_recipe_and_stands_behind_it():
    assert bundle_label("exact-prior", "prior") == "exact, prior recipe"
    assert sorted(["none", "exact-prior", "exact"], key=place) == ["exact", "exact-prior", "none"]
