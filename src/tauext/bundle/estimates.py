"""Estimates of a recording, sample by sample, and their file: from `tauext evaluate` or beside a flight."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tauext._core import cause_names
from tauext.data.recording_file import write_parquet
from tauext.errors import RecordingError
from tauext.files.plain_file import expect_file, json_of

HEALTHS = ("warming up", "ok", "stale", "fault")
"""By the core's number."""
WARMING_UP, OK, STALE, FAULT = range(4)  # health
CONTACT, COLLISION = 1, 2  # alarm


@dataclass(frozen=True)
class Estimates:
    """One row a sample of the recording; torques are (samples, joints) float32, in the bundle's estimate units.

    The first rows' tau_ext is NaN: until the observer has forgotten how it began, 10/K0, and a network's window is
    full, there is no estimate (a second at K0 = 20; without a network half of that). `health` states it, `why(row)` in
    words.
    """

    joints: tuple[str, ...]
    """Names of the joints, in the order of the columns."""
    t_ns: np.ndarray
    """(samples,) int64: stamps of the samples, [ns]."""
    r: np.ndarray
    """Residual of the observer."""
    network: np.ndarray
    """What the network expects of r beside the prior; 0 where the bundle has none, NaN while warming up."""
    tau_ext: np.ndarray
    """External torque, r - prior - network - drift; NaN while warming up."""
    limit: np.ndarray
    """What |tau_ext| must exceed for a collision, at each sample."""
    near_stiction: np.ndarray
    """(samples, joints) bool: whether the limit is that near stiction, not that of sliding."""
    health: np.ndarray
    """(samples,) int8: 0 warming up, 1 ok, 2 stale, 3 fault."""
    detection: np.ndarray
    """(samples,) bool: healthy, and some |tau_ext| over its limit."""
    prior: np.ndarray | None = None
    """What physics, fitted to the data, expects of r; None where the bundle has no prior."""
    drift: np.ndarray | None = None
    """What the tracker of slow changes takes off; None where the bundle has none."""
    sigma_nm: np.ndarray | None = None
    """Standard error of tau_ext; NaN where that is, None where the bundle has no error scale."""
    contact_sigma_nm: np.ndarray | None = None
    """The same during a contact and after it."""
    contact_limit: np.ndarray | None = None
    """What |tau_ext| must exceed for a contact; None but beside flights."""
    held_alarm: np.ndarray | None = None
    """(samples,) int8: the level held at that sample, 0 none, 1 contact, 2 collision."""
    alarm: np.ndarray | None = None
    """(samples,) int8: the same, latched until somebody acknowledges it; None but of a monitor."""
    touch: np.ndarray | None = None
    """(samples,) int8: kind of the touch, of `Touch`; of a monitor 0 once the alarm was acknowledged."""
    causes: np.ndarray | None = None
    """(samples,) uint32: a bit for each cause why health is not ok; `cause_names` has the words."""

    @property
    def band_nm(self) -> np.ndarray | None:
        """Standard error for figures: that of contacts where it is known, else that of free motion."""
        return self.sigma_nm if self.contact_sigma_nm is None else self.contact_sigma_nm

    @property
    def limits_move(self) -> bool:
        """Whether a limit takes more values than one sliding and one near stiction."""
        return any(len(np.unique(one[np.isfinite(one)])) > 2 for one in self.limit.T)

    @property
    def healthy(self) -> np.ndarray:
        """(samples,) bool: health is ok."""
        return self.health == OK

    def why(self, row: int) -> str:
        """Health of one sample in words: `ok`, `warming up`, `warming up: gap`, `fault: not finite`."""
        causes = cause_names(int(self.causes[row])) if self.causes is not None else []
        return HEALTHS[int(self.health[row])] + (f": {', '.join(causes)}" if causes else "")

    @property
    def has_network(self) -> bool:
        """0 throughout for a bundle without one."""
        return bool(np.nan_to_num(self.network).any())

    @property
    def uncertainty(self) -> np.ndarray:
        """r expected in free motion: prior, network and drift, (samples, joints), [N m]."""
        parts = [part for part in (self.prior, self.network, self.drift) if part is not None]
        return np.asarray(np.sum(parts, axis=0, dtype=np.float32))


TORQUES = ("r", "network", "tau_ext", "limit")
OPTIONAL = ("prior", "drift", "sigma_nm", "contact_sigma_nm", "contact_limit")
"""Torques that some bundles have; a file holds their columns or not."""
STATES = {"held_alarm": np.int8, "alarm": np.int8, "touch": np.int8, "causes": np.uint32}
"""Columns that a file holds or not."""
FORMAT = "3"


def save_estimates(estimates: Estimates, path: Path) -> None:
    """Write under a temporary name, then rename; columns that are None are left out.

    Raises:
        RecordingError: the file cannot be written; what was written of it is removed.
    """
    import pyarrow as pa

    columns: dict[str, np.ndarray] = {"t_ns": estimates.t_ns}
    torque_names = [*TORQUES, *(signal for signal in OPTIONAL if getattr(estimates, signal) is not None)]
    for signal in (*torque_names, "near_stiction"):
        values = getattr(estimates, signal)
        columns |= {f"{signal}_{joint}": np.ascontiguousarray(values[:, j]) for j, joint in enumerate(estimates.joints)}
    columns |= {"health": estimates.health, "detection": estimates.detection}
    for name, kind in STATES.items():
        if getattr(estimates, name) is not None:
            columns[name] = getattr(estimates, name).astype(kind)
    table = pa.table(columns).replace_schema_metadata(
        {"tauext_estimates_format": FORMAT, "joints": json.dumps(estimates.joints)}
    )
    torques = [f"{signal}_{joint}" for signal in torque_names for joint in estimates.joints]
    write_parquet(table, path, use_dictionary=False, column_encoding=dict.fromkeys(torques, "BYTE_STREAM_SPLIT"))


def load_estimates(path: Path) -> Estimates:
    """Read what save_estimates wrote; what the file has no column for is None.

    In format 1 `alarm` was the held level, but in files beside flights, which have `causes`. Format 2 had no sigma.

    Raises:
        RecordingError: missing, damaged or foreign file.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        expect_file(path)
        table = pq.read_table(path)
        joints = tuple(json_of(table.schema.metadata[b"joints"]))
        column = {name: table.column(name).to_numpy() for name in table.column_names}
        if odd := [name for name, values in column.items() if values.dtype.kind not in "fiub"]:
            raise ValueError(f"column '{odd[0]}' holds no numbers")
        signals = {
            signal: np.stack([column[f"{signal}_{joint}"] for joint in joints], axis=1)
            for signal in (*TORQUES, "near_stiction", *OPTIONAL)
            if signal not in OPTIONAL or f"{signal}_{joints[0]}" in column
        }
        flags = {name: column[name] for name in ("health", "detection")}
        states: dict[str, Any] = {name: column.get(name) for name in STATES}
        if table.schema.metadata.get(b"tauext_estimates_format") == b"1" and states["causes"] is None:
            states["held_alarm"], states["alarm"] = states["alarm"], None
        return Estimates(joints, column["t_ns"], **signals, **flags, **states)
    except FileNotFoundError as error:
        raise RecordingError(
            f"{path}: there are no such estimates; `tauext evaluate` and `tauext run --flights` write them"
        ) from error
    except (OSError, pa.ArrowException, KeyError, IndexError, TypeError, ValueError) as error:
        raise RecordingError(f"{path}: not a readable estimates file ({error}); evaluate again") from error
