"""A LeRobot robot around another one, which also reads the servo signals that arm.toml names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import nullcontext
from typing import Any

from lerobot.robots import Robot, make_robot_from_config

from lerobot_robot_tauext.block_read import SIGNALS, BlockRead
from lerobot_robot_tauext.config_wrapping import WrappingConfig
from tauext.data.description import Arm


class Wrapping(Robot):
    """Passes everything on to the wrapped robot."""

    def __init__(self, config: WrappingConfig):
        super().__init__(config)
        self.robot = make_robot_from_config(config.wrapped)
        self.signals: tuple[str, ...] = ()
        """Signals that read_also() added, by name."""
        self._block: BlockRead | None = None

    def read_also(self, arm: Arm) -> None:
        """Read the currents, duties and voltages that arm.toml names and the wrapped robot does not observe.

        Raises:
            ValueError: the wrapped robot has no serial bus to read them from.
        """
        held = self.floats
        self.signals = tuple(
            signal
            for signal in SIGNALS
            if signal in arm.signals and not any(key.endswith(f".{signal}") for key in held)
        )
        if not self.signals:
            return
        bus = getattr(self.robot, "bus", None)
        if bus is None or not hasattr(bus, "model_ctrl_table"):
            raise ValueError(
                f"{arm.path} names {', '.join(self.signals)}, but {self.robot.name} does not observe these and "
                "has no serial bus to read them from; a bundle with torque from the goal does not need them"
            )
        self._block = BlockRead(bus, self.signals)

    def observed(self) -> dict[str, Any]:
        """The wrapped robot's observation, with the signals of read_also()."""
        with self._block.reading() if self._block is not None else nullcontext():
            observation = dict(self.robot.get_observation())
        if self._block is not None:
            for signal, values in self._block.values.items():
                observation |= {f"{motor}.{signal}": value for motor, value in values.items()}
        return observation

    @property
    def requests(self) -> str:
        """Note about the bus for the log; empty: one request a tick."""
        one = self._block is None or self._block.in_one_transaction
        return "" if one else "; more than one bus request a tick"

    @property
    def goal_names(self) -> list[str]:
        """Actions that are positions: `<joint>.pos`."""
        return [key for key in self.robot.action_features if key.endswith(".pos")]

    @property
    def floats(self) -> list[str]:
        """Numbers in the wrapped robot's observation; images are left out."""
        return [key for key, kind in self.robot.observation_features.items() if kind is float]

    def names_of(self, observed: Iterable[str]) -> list[str]:
        """Names of the importer for observed numbers and for the goals."""
        return [f"observation.state[{key}]" for key in observed] + [f"goal[{key}]" for key in self.goal_names]

    @staticmethod
    def numbers(observation: Mapping[str, Any], goals: Mapping[str, Any]) -> dict[str, Any]:
        """An observation and the goals under these names."""
        values = {f"observation.state[{key}]": value for key, value in observation.items()}
        return values | {f"goal[{key}]": goal for key, goal in goals.items()}

    observation_features = property(lambda self: self.robot.observation_features)
    action_features = property(lambda self: self.robot.action_features)
    cameras = property(lambda self: getattr(self.robot, "cameras", {}))
    is_connected = property(lambda self: self.robot.is_connected)
    is_calibrated = property(lambda self: self.robot.is_calibrated)

    def connect(self, calibrate: bool = True) -> None:
        self.robot.connect(calibrate)

    def calibrate(self) -> None:
        self.robot.calibrate()

    def configure(self) -> None:
        self.robot.configure()

    def disconnect(self) -> None:
        """Disconnect the wrapped robot, which may disable its torque: option disable_torque_on_disconnect."""
        self.robot.disconnect()
