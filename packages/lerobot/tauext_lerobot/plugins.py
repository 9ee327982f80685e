"""What tauext finds by this package's entry points: servo buses as sources, and the commands `label` and `guard`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tauext.cli.commands import Command
from tauext.sources.open import SourceKind

if TYPE_CHECKING:
    from tauext._core import Bundle
    from tauext.monitor.cell_file import Cell
    from tauext.monitor.source import Source


def serial_bus(kind: str) -> SourceKind:
    """The source of a series of serial servos."""

    def open_serial(target: str, bundle: Bundle | None, cell: Cell) -> Source:
        from tauext_lerobot.servo import ServoSource
        from tauext_lerobot.servo_bus_file import servo_bus
        from tauext_lerobot.servo_series import SERIES

        return ServoSource(SERIES[kind], target, servo_bus(cell))

    return SourceKind(open_serial, "PORT", takes_bus=True)


def open_damiao(target: str, bundle: Bundle | None, cell: Cell) -> Source:
    from tauext_lerobot.damiao import DamiaoSource, can_bus

    return DamiaoSource(target, can_bus(cell), cell.path)


FEETECH = serial_bus("feetech")
DYNAMIXEL = serial_bus("dynamixel")
DAMIAO = SourceKind(open_damiao, "CAN", takes_bus=True)
LABEL = Command("add contact and collision labels to a LeRobot dataset", "tauext_lerobot.label:label")
GUARD = Command(
    "make a guard of a servo arm against stalls, from ten minutes of its motion", "tauext_lerobot.make_guard:guard"
)
