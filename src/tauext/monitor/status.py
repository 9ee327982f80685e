"""Single samples of a replay, at a rate that a reader asks for."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tauext import _core
from tauext.bundle.estimates import HEALTHS
from tauext.monitor.changes import ALARMS, TOUCHES
from tauext.monitor.replay import Chunk

TORQUES = {
    "residual_nm": "residual",
    "uncertainty_nm": "uncertainty",
    "tau_ext_nm": "tau_ext",
    "sigma_nm": "sigma_nm",
    "limit_nm": "limit_nm",
    "contact_limit_nm": "contact_limit_nm",
    "margin_nm": "margin_nm",
}
"""Names of lists over the joints, and of the monitor's arrays that hold them."""


class StatusClock:
    """Picks the first sample of every period, counted from a recording's first sample, whatever the chunks."""

    def __init__(self, start_ns: int, period_ns: int):
        self._start_ns, self._period_ns = start_ns, period_ns
        self._last = -1

    def rows(self, t_ns: np.ndarray) -> list[int]:
        """Rows of a chunk with these stamps, (rows,), [ns]; call it for every chunk in order."""
        periods = (t_ns - self._start_ns) // self._period_ns
        rows = np.flatnonzero(periods > np.append(self._last, periods[:-1]))
        self._last = int(periods[-1])
        return rows.tolist()


def status(chunk: Chunk, row: int) -> dict[str, Any]:
    """What the monitor said of one sample of the chunk, as plain JSON; null where a number does not exist."""
    said = chunk.said
    return {
        "health": HEALTHS[said["health"][row]],
        "causes": _core.cause_names(int(said["causes"][row])),
        "alarm": ALARMS[said["alarm"][row]],
        "touch": TOUCHES[said["touch"][row]],
        "detection": bool(said["detection"][row]),
        **{name: [number(value) for value in said[key][row].tolist()] for name, key in TORQUES.items()},
        "unfamiliar": float(said["unfamiliar"][row]),
        "near_stiction": [bool(near) for near in said["near_stiction"][row]],
    }


def number(value: float) -> float | None:
    """For JSON, which knows no NaN."""
    return value if math.isfinite(value) else None
