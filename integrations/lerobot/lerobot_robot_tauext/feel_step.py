"""A processor step that passes observations to a leader, since LeRobot's loops do not."""

from __future__ import annotations

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
