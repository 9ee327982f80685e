"""LeRobot's own programs with force feedback: lerobot-teleoperate and lerobot-record with one more step.

LeRobot's loops do not pass observations to a leader; the step does.
"""

from __future__ import annotations

import importlib
from typing import Any
from weakref import WeakSet

from lerobot.processor import ProcessorStepRegistry, RobotActionProcessorStep, TransitionKey, make_default_processors

FEELING: WeakSet[Any] = WeakSet()
"""Connected leaders."""


@ProcessorStepRegistry.register("tauext_feel")
class FeelStep(RobotActionProcessorStep):
    """Passes each tick's observation to the connected leaders; the action passes unchanged."""

    def action(self, action: dict[str, Any]) -> dict[str, Any]:
        observation = self.transition.get(TransitionKey.OBSERVATION)
        for leader in list(FEELING) if observation else ():
            leader.send_feedback(observation)
        return action

    def transform_features(self, features: Any) -> Any:
        return features


def processors() -> tuple[Any, Any, Any]:
    """LeRobot's default pipelines for teleoperation; the first one has the additional step."""
    teleop_action, robot_action, robot_observation = make_default_processors()
    teleop_action.steps = [FeelStep(), *teleop_action.steps]
    return teleop_action, robot_action, robot_observation


def teleoperate() -> None:
    """lerobot-teleoperate, with the same options."""
    _run("lerobot.scripts.lerobot_teleoperate")


def record() -> None:
    """lerobot-record, with the same options."""
    _run("lerobot.scripts.lerobot_record")


def _run(name: str) -> None:
    program: Any = importlib.import_module(name)
    program.make_default_processors = processors
    program.main()
