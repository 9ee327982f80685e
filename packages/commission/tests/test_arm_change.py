"""What has changed on an arm: a ball in the hand, and the friction of one joint; and its words."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tauext_commission.arm_change import LoadChange, change_words, find_change
from tauext_lab.sim.arms import GearedArm, rig_arm, seven_axis_arm
from tauext_lab.sim.config import changed_friction
from tauext_lab.sim.source import DrivenArm, command_of

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.config import PAPER_CASES, PriorConfig, TrainConfig
from tauext.data.recording import Recording
from tauext.robot.model_case import chosen_case
from tauext.train.preparation import TrainingInput
from tauext.train.stage import accepted_settings, train_on_recordings

WHY = "no reason"


def moved(arm: GearedArm, seconds: float, seed: int, load_kg: float = 0.0) -> Recording:
    """The arm's own motion with a ball in its hand."""
    moving = DrivenArm(arm, seed)
    moving.obey(command_of(f"load mass={load_kg}", arm.joints))
    q, dq, tau, _ = np.array([moving.step() for _ in range(round(seconds * arm.rate_hz))]).transpose(1, 0, 2).copy()
    t_ns = np.arange(len(q)) * 1_000_000
    return Recording("moved", arm.joints, t_ns, q, dq, tau, 1000.0, "held", "test", "")


def trained(arm: GearedArm, load_kg: float, path: Path) -> _core.Bundle:
    (path / "robot.xml").write_text(arm.xml)
    config = accepted_settings(TrainConfig(recipe="prior", threads=1, prior=PriorConfig(most_ripples=0)), ())
    given = TrainingInput(
        path / "robot.xml", PAPER_CASES[chosen_case(None, path / "robot.xml")[0]], [moved(arm, 60.0, 1, load_kg)]
    )
    train_on_recordings(given, config, path / "arm.tauext")
    return load_bundle(path / "arm.tauext")


@pytest.mark.slow
@pytest.mark.parametrize(("make", "before_kg", "now_kg"), [(seven_axis_arm, 0.0, 0.8), (rig_arm, 1.5, 0.3)])
def test_a_changed_load_is_weighed_and_a_changed_gear_is_not(tmp_path, make, before_kg, now_kg):
    arm = make()
    bundle = trained(arm, before_kg, tmp_path)
    load, _ = find_change(bundle, [moved(arm, 30.0, 2, now_kg)], 1)
    more = now_kg - before_kg
    assert load is not None and abs(load.mass_kg - more) < min(load.within_kg, 0.2 * abs(more))
    if arm.hand_m is not None:
        assert load.lever_m is not None and abs(load.lever_m - arm.hand_m) < 0.02
    assert find_change(bundle, [moved(arm, 30.0, 2, before_kg)], 1)[0] is None

    k = len(arm.joints) // 2
    stiff = (*arm.friction[:k], *changed_friction(arm.friction[k : k + 1], 6.0), *arm.friction[k + 1 :])
    none, errors = find_change(bundle, [moved(replace(arm, friction=stiff), 30.0, 2, before_kg)], 1)
    assert none is None and change_words(none, errors, WHY).startswith(f"only {arm.joints[k]} (error ")

    settings = bundle.load_settings
    settings.refused = "the bundle has no model of the arm"
    bundle.load_settings = settings
    assert find_change(bundle, [moved(arm, 5.0, 2, now_kg)], 1) == (None, {})


def test_a_load_is_named_with_its_error_and_its_place():
    more = LoadChange(1.424, 0.104, 0.1984, "the frame tool0")
    assert change_words(more, {}, WHY) == (
        "the hand carries 1.42 kg more than in training (within 0.10 kg, 198 mm from the origin of the frame tool0): "
        "another tool or payload?"
    )
    less = LoadChange(-0.8, 0.001, None, "")
    assert change_words(less, {"a": 9.0}, WHY) == (
        "the hand carries 0.80 kg less than in training (within 0.01 kg): another tool or payload?"
    )


@pytest.mark.parametrize(
    ("errors", "words"),
    [
        ((1.0, 1.2, 7.3), "only c (error 7.3 times that of training) is not as before: gear, damage, or a weight"),
        ((1.0, 6.0, 7.3), "the arm is not as before"),
        ((1.0, 2.3, 7.3), "the arm is not as before"),
        ((1.0, 1.2, 4.0), "the arm is not as before"),
        ((1.0, 1.0, 1.0), "the arm is not as before"),
        ((), "the arm is not as before, and no friction explains it (tool, payload or damage?): no reason"),
    ],
)
def test_single_joints_are_named_if_the_others_are_as_before(errors, words):
    assert change_words(None, dict(zip("abc", errors, strict=False)), WHY).startswith(words)


def test_two_of_six_joints_are_named_together():
    errors = {"a": 1.0, "b": 8.0, "c": 1.0, "d": 5.5, "e": 1.0, "f": 1.0}
    assert " and d (error 5.5 times that of training) are not as before" in change_words(None, errors, WHY)
