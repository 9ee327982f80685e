"""A LeRobot robot that wraps another one and adds contact to its observation."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any
from weakref import WeakSet

import numpy as np
from tauext_lerobot.frames import FrameLabeller, element_names

import tauext
from lerobot_robot_tauext.config_tauext import TauextConfig
from lerobot_robot_tauext.wrapping import Wrapping
from tauext.data.description import load_arm

logger = logging.getLogger(__name__)
Action = dict[str, float]


class Tauext(Wrapping):
    """The wrapped robot's observation and actions, with additional floats that LeRobot records:

    `<joint>.tau_ext` in the bundle's estimate units; `contact` and `collision` (1, 0, or -1: unknown, tau_ext is 0);
    `<joint>.current`, `.duty`, `.voltage` if arm.toml names them; `<joint>.goal`, the goal sent last, if it can differ
    from the recorded action (on_collision is not none, or the robot clips its goals).
    """

    config_class = TauextConfig
    name = "tauext"

    def __init__(self, config: TauextConfig):
        super().__init__(config)
        self.config = config
        self._bundle = tauext.load_bundle(config.bundle)
        arm = load_arm(config.arm)
        clips = getattr(config.wrapped, "max_relative_target", None) is not None
        self._goal_names = {key: f"{key.removesuffix('.pos')}.goal" for key in self.goal_names}
        self._records_goal = config.on_collision != "none" or clips
        held = self.floats
        self.read_also(arm)
        self._elements = element_names(arm.names)
        names = self.names_of(key for key in (*held, *self._own_features) if key not in self._elements)
        rate_hz = 1e9 / self._bundle.observer.sample_period_ns
        self._fps = round(rate_hz) if abs(rate_hz / round(rate_hz) - 1) < 0.01 else rate_hz
        self._labeller = FrameLabeller(self._bundle, arm, names, self._fps)
        self._hold = Hold(config.resume_within)
        self._touching = self._stopped = False
        self._sent: dict[str, float] = {}
        """Goals of the last action: the goals sent if these are recorded, else those of the dataset."""

    @cached_property
    def _own_features(self) -> dict[str, type]:
        joints = [key.removesuffix(".pos") for key in self._goal_names]
        own = [f"{joint}.{signal}" for signal in self.signals for joint in joints]
        if self._records_goal:
            own += list(self._goal_names.values())
        return dict.fromkeys([*own, *self._elements], float)

    @property
    def observation_features(self) -> dict[str, Any]:
        """The wrapped robot's features, then additional floats, which LeRobot puts into observation.state."""
        return {**self.robot.observation_features, **self._own_features}

    def connect(self, calibrate: bool = True) -> None:
        """Connect the wrapped robot and restart the monitor."""
        self.robot.connect(calibrate)
        self.start_episode()
        self._hold.end()
        self._stopped, self._sent = False, {}
        if self.config.episodes_begin_anew:
            call_at_episodes(self)
        logger.info("tauext: %s, %g Hz%s", self._bundle.name, self._fps, self.requests)

    def disconnect(self) -> None:
        """Disconnect the wrapped robot, which may disable its torque: option disable_torque_on_disconnect."""
        stop_calling(self)
        self.robot.disconnect()

    def start_episode(self) -> None:
        """Begin an episode with the next observation. Called automatically when LeRobot's dataset ends an episode."""
        self._labeller.restart()
        self._touching = False

    def get_observation(self) -> dict[str, Any]:
        """Observe, estimate and react in the same call.

        Raises:
            CollisionStop: on_collision is stop, and the arm has collided since connect().
        """
        if self._stopped:
            raise CollisionStop("the arm collided and is stopped; check it, then connect again")
        observation = self.observed()
        first = self._labeller.frame == 0 and not self._records_goal  # the dataset has no earlier action
        sent = {} if first else self._sent
        goals: dict[str, Any] = {key: sent.get(key, observation[key]) for key in self._goal_names}
        if self._records_goal:
            observation |= {self._goal_names[key]: float(np.float32(goal)) for key, goal in goals.items()}
        labels = self._labeller.step(self.numbers(observation, goals))
        observation |= dict(zip(self._elements, labels.columns[0].tolist(), strict=True))
        self._react(observation, bool(labels.collision[0] == 1.0))
        return observation

    def _react(self, observation: dict[str, Any], collides: bool) -> None:
        begins, self._touching = collides and not self._touching, collides
        if self.config.on_collision == "none" or not collides:
            return
        if not self._hold.holding:
            self._send(self._hold.begin({key: float(observation[key]) for key in self._goal_names}))
        if begins:
            logger.warning("tauext: collision; %s", self.config.on_collision)
        if self.config.on_collision == "stop":
            self._stopped = True
            worst = max(self._elements[:-2], key=lambda name: abs(observation[name]))
            raise CollisionStop(
                f"the arm collided ({worst} = {observation[worst]:.3g}) and holds its position; check what it touches"
            )

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Send the goals, or the held position in their place; returns what was sent."""
        if self._stopped:
            raise CollisionStop("the arm collided and is stopped; check it, then connect again")
        return self._send(action if self.config.on_collision == "none" else self._hold.passed(action, self._touching))

    def _send(self, action: dict[str, Any]) -> dict[str, Any]:
        sent = self.robot.send_action(action)
        kept = sent if self._records_goal else action
        self._sent |= {key: float(np.float32(kept[key])) for key in self._goal_names if key in kept}
        return sent


# --- Goals that are sent to the arm during and after a collision.


class CollisionStop(RuntimeError):
    """The arm collided and on_collision is stop: it holds its position, and the program ends."""


class Hold:
    """Holds the arm where it collided until the commanded goal returns there.

    Goals are elements `<joint>.pos`; other elements of an action pass unchanged.
    """

    def __init__(self, resume_within: float):
        self._within = resume_within
        self._held: Action = {}

    @property
    def holding(self) -> bool:
        """Whether goals are replaced."""
        return bool(self._held)

    def begin(self, present: Mapping[str, float]) -> Action:
        """Hold this position; a position that is held already stays."""
        if not self._held:
            self._held = dict(present)
        return dict(self._held)

    def end(self) -> None:
        """End the hold: goals pass again."""
        self._held = {}

    def passed(self, action: Mapping[str, float], touching: bool) -> Action:
        """The action to send, with held goals. A hold ends if the goal is near it and nothing touches the arm."""
        if self._held and not touching:
            near = all(abs(float(action[k]) - held) <= self._within for k, held in self._held.items() if k in action)
            if near:
                self.end()
        return dict(action) | {k: held for k, held in self._held.items() if k in action}


# --- The end of recorded episodes, from LeRobot's dataset, since LeRobot does not report it to robots.


ENDS = ("save_episode", "clear_episode_buffer")
_called: WeakSet[Any] = WeakSet()


def call_at_episodes(robot: Any) -> None:
    """Call `robot.start_episode()` whenever a dataset of this process ends an episode.

    LeRobot's record loop saves or drops an episode right before the first frame of the next one. Without the dataset
    library there are no datasets, and nothing is called.
    """
    try:
        from lerobot.datasets.lerobot_dataset import LeRobotDataset
    except ImportError:
        return
    for name in ENDS:
        method = getattr(LeRobotDataset, name, None)
        if method is None:
            logger.warning(
                "LeRobotDataset has no %s: call start_episode() of the robot at the first frame of each episode", name
            )
        elif not hasattr(method, "calls_robots"):
            setattr(LeRobotDataset, name, _calling(method))
    _called.add(robot)


def stop_calling(robot: Any) -> None:
    """Stop calling the robot."""
    _called.discard(robot)


def _calling(method: Callable) -> Callable:
    @functools.wraps(method)
    def calling(*args: Any, **kwargs: Any) -> Any:
        result = method(*args, **kwargs)
        for robot in list(_called):
            robot.start_episode()
        return result

    calling.calls_robots = True  # type: ignore[attr-defined]
    return calling
