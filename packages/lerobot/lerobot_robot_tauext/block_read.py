"""Reads the monitor's additional signals in the bus transaction that reads the position."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from tauext_lerobot.servo_series import FEETECH, SERIES, Register

POSITION = "Present_Position"
SIGNALS = ("current", "duty", "voltage")
"""Signals that can be read."""
NAMES = {
    "feetech": ("Present_Current", "Present_Load", "Present_Voltage"),
    "dynamixel": ("Present_Current", "Present_PWM", "Present_Input_Voltage"),
}
"""LeRobot's names of their registers, by kind of series."""
MODELS = {name: (series, ampere) for series in SERIES.values() for name, ampere in series.models.values()}
Registers = dict[str, Register]
"""By motor: the register, with the unit of that motor's counts in A, shares of the supply or V."""


class BlockRead:
    """Reads registers of all servos of a LeRobot bus in one sync read that spans them and the position.

    The wrapped robot reads the position as before; `reading()` widens that request. A bus with different register
    tables, or that is not one of LeRobot's serial buses, gets one additional request per register.

    Args:
        bus: bus of the wrapped robot.
        signals: some of current, duty, voltage.

    Raises:
        ValueError: a servo has no such register, or its unit is unknown.
    """

    def __init__(self, bus: Any, signals: tuple[str, ...]):
        self._bus = bus
        self._registers: dict[str, tuple[str, Registers]] = {}
        for signal in signals:
            self._registers[signal] = _register(bus, signal)
        self._tables = [bus.model_ctrl_table[motor.model] for motor in bus.motors.values()]
        names = [POSITION, *(register for register, _ in self._registers.values())]
        places = {tuple(table[name] for name in names) for table in self._tables}
        self._block: dict[str, tuple[int, int]] = {}
        if len(places) == 1 and all(
            hasattr(bus, name) for name in ("_setup_sync_reader", "_decode_sign", "_normalize")
        ):
            self._block = dict(zip(names, places.pop(), strict=True))
        self.values: dict[str, dict[str, float]] = {}
        """Values of the last `reading()` in SI units, by signal and motor."""

    @property
    def in_one_transaction(self) -> bool:
        """Whether one request reads everything."""
        return bool(self._block)

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Widen the wrapped robot's request for the position inside this context."""
        self.values = {}
        original = self._bus.sync_read

        def sync_read(
            data_name: str, motors: Any = None, *, normalize: bool = True, num_retry: int = 0
        ) -> dict[str, Any]:
            everything = motors is None or list(motors) == list(self._bus.motors)
            if data_name != POSITION or not everything or self.values:
                return original(data_name, motors, normalize=normalize, num_retry=num_retry)
            if self._block:
                return self._widened(normalize, num_retry)
            position = original(data_name, motors, normalize=normalize, num_retry=num_retry)
            for signal, (name, registers) in self._registers.items():
                counts = original(name, normalize=False, num_retry=num_retry)
                self.values[signal] = _in_si(counts, registers)
            return position

        self._bus.sync_read = sync_read
        try:
            yield
        finally:
            del self._bus.sync_read  # restores the method of the class

    def _widened(self, normalize: bool, num_retry: int) -> dict[str, Any]:
        bus = self._bus
        ids = [motor.id for motor in bus.motors.values()]
        start = min(address for address, _ in self._block.values())
        length = max(address + size for address, size in self._block.values()) - start
        bus._setup_sync_reader(ids, start, length)
        for _ in range(1 + num_retry):
            result = bus.sync_reader.txRxPacket()
            if bus._is_comm_success(result):
                break
        else:
            words = bus.packet_handler.getTxRxResult(result)
            raise ConnectionError(
                f"Failed to sync read {length} bytes from {start} on {ids} after {num_retry + 1} tries: {words}"
            )
        counts = {
            name: {id_: bus.sync_reader.getData(id_, address, size) for id_ in ids}
            for name, (address, size) in self._block.items()
        }
        for signal, (name, registers) in self._registers.items():
            self.values[signal] = _in_si({bus._id_to_name(id_): n for id_, n in counts[name].items()}, registers)
        position: Mapping[int, Any] = bus._decode_sign(POSITION, counts[POSITION])
        if normalize and POSITION in bus.normalized_data:
            position = bus._normalize(position)
        return {bus._id_to_name(id_): value for id_, value in position.items()}


def _in_si(counts: Mapping[str, int], registers: Registers) -> dict[str, float]:
    """Values of counts. LeRobot has decoded the sign of some: 0.6 that of the load, 0.3 none."""
    return {
        motor: count * registers[motor].unit
        if count < 0
        else registers[motor].of(int(count).to_bytes(registers[motor].block[1], "little"), registers[motor].address)
        for motor, count in counts.items()
    }


def _register(bus: Any, signal: str) -> tuple[str, Registers]:
    """LeRobot's name of the register of a signal, and each motor's register."""
    name, registers = "", Registers()
    for motor, one in bus.motors.items():
        series, ampere = MODELS.get(one.model, (FEETECH, None))
        name = NAMES[series.kind][SIGNALS.index(signal)]
        unit = ampere if signal == "current" else series.registers[signal].unit
        if one.model not in MODELS or unit is None or name not in bus.model_ctrl_table[one.model]:
            raise ValueError(f"motor '{motor}' is a {one.model}: tauext cannot read its {signal}")
        registers[motor] = series.registers[signal]._replace(unit=unit)
    return name, registers
