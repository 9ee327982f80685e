"""Reads the monitor's additional signals in the bus transaction that reads the position."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

POSITION = "Present_Position"
Scales = dict[str, tuple[float, int]]
REGISTERS: dict[str, dict[str, Scales]] = {
    "current": {
        "Present_Current": {"sts": (0.0065, 15), "xl330": (0.001, 0), "xc330": (0.001, 0), "xm": (0.00269, 0)},
    },
    "duty": {"Present_Load": {"sts": (0.001, 10)}, "Present_PWM": {"x": (1 / 885, 0)}},
    "voltage": {"Present_Voltage": {"sts": (0.1, 15)}, "Present_Input_Voltage": {"x": (0.1, 0)}},
}
"""By signal: the register and, by the beginning of the model's name, the value of a count in A, shares of the supply or
V, and the index of the sign bit (0: two's complement). Feetech: STS memory table; Dynamixel: e-Manual (885 counts of
PWM are 100 %)."""


def _signed(count: int, sign_bit: int) -> int:
    """A signed count of two bytes. Some LeRobot versions decode the sign (0.6: of the load), others do not (0.3)."""
    if count < 0:
        return count
    if not sign_bit:
        return count - 0x10000 if count & 0x8000 else count
    return -(count & ((1 << sign_bit) - 1)) if count >> sign_bit & 1 else count


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
        self._registers: dict[str, tuple[str, Scales]] = {}
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
            for signal, (register, scale) in self._registers.items():
                counts = original(register, normalize=False, num_retry=num_retry)
                self.values[signal] = _in_si(counts, scale)
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
            name: bus._decode_sign(name, {id_: bus.sync_reader.getData(id_, address, size) for id_ in ids})
            for name, (address, size) in self._block.items()
        }
        for signal, (register, scale) in self._registers.items():
            self.values[signal] = _in_si({bus._id_to_name(i): n for i, n in counts[register].items()}, scale)
        position: Mapping[int, Any] = counts[POSITION]
        if normalize and POSITION in bus.normalized_data:
            position = bus._normalize(position)
        return {bus._id_to_name(id_): value for id_, value in position.items()}


def _in_si(counts: Mapping[str, int], scales: Scales) -> dict[str, float]:
    return {motor: _signed(int(count), scales[motor][1]) * scales[motor][0] for motor, count in counts.items()}


def _register(bus: Any, signal: str) -> tuple[str, Scales]:
    """The register of a signal, and the unit of each motor's counts."""
    scales: Scales = {}
    chosen = ""
    for motor, one in bus.motors.items():
        table = bus.model_ctrl_table[one.model]
        for register, by_model in REGISTERS[signal].items():
            fits = [begin for begin in by_model if one.model.startswith(begin)]
            if register in table and fits and chosen in ("", register):
                chosen = register
                scales[motor] = by_model[max(fits, key=len)]
        if motor not in scales:
            raise ValueError(f"motor '{motor}' is a {one.model}: tauext cannot read its {signal}")
    return chosen, scales
