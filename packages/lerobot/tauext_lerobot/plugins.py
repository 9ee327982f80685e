"""What tauext finds by this package's entry points: servo buses as sources, and the commands `label` and `guard`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tauext.cli.commands import Command
from tauext.errors import ConfigError
from tauext.sources.open import Option, SourceKind

if TYPE_CHECKING:
    from tauext._core import Bundle
    from tauext.monitor.source import Source

BUS = Option(
    "bus",
    Path | None,
    "TOML file of --source feetech, dynamixel or damiao: servo, zero position and direction of each joint. LeRobot's"
    " calibration file (*.json) also works for serial servos.",
)


def expect_bus(text: str, bus: Path | None) -> Path:
    """Raises ConfigError without a bus file."""
    if bus is None:
        raise ConfigError(f"--source {text} needs --bus FILE: which servo is which joint (docs/servo-arms.md)")
    return bus


def serial_bus(kind: str) -> SourceKind:
    """The source of a series of serial servos."""

    def open_serial(target: str, bundle: Bundle | None, bus: Path | None = None) -> Source:
        from tauext_lerobot.servo import ServoSource
        from tauext_lerobot.servo_bus_file import load_servo_bus
        from tauext_lerobot.servo_series import SERIES

        return ServoSource(SERIES[kind], target, load_servo_bus(expect_bus(f"{kind}:PORT", bus)))

    return SourceKind(open_serial, "PORT", (BUS,))


def open_damiao(target: str, bundle: Bundle | None, bus: Path | None = None) -> Source:
    from tauext_lerobot.damiao import DamiaoSource, load_can_bus

    return DamiaoSource(target, load_can_bus(expect_bus("damiao:CAN", bus)))


FEETECH = serial_bus("feetech")
DYNAMIXEL = serial_bus("dynamixel")
DAMIAO = SourceKind(open_damiao, "CAN", (BUS,))
LABEL = Command("add contact and collision labels to a LeRobot dataset", "tauext_lerobot.label:label")
GUARD = Command(
    "make a guard of a servo arm against stalls, from ten minutes of its motion", "tauext_lerobot.make_guard:guard"
)
