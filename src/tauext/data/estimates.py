"""What a bundle said of a recording, sample by sample, and its file."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tauext.errors import RecordingError

WARMING_UP, OK, STALE, FAULT = range(4)  # health


@dataclass(frozen=True)
class Estimates:
    """One row a sample of the recording; torques are (samples, joints) float32, [N m]."""

    joints: tuple[str, ...]
    t_ns: np.ndarray  # (samples,) int64
    r: np.ndarray  # the observer
    network: np.ndarray  # NaN while warming up
    tau_ext: np.ndarray  # r - network; NaN while warming up
    limit: np.ndarray
    near_stiction: np.ndarray  # (samples, joints) bool: region of the limit
    health: np.ndarray  # (samples,) int8
    detection: np.ndarray  # (samples,) bool: healthy and some |tau_ext| over its limit

    @property
    def healthy(self) -> np.ndarray:
        return self.health == OK


TORQUES = ("r", "network", "tau_ext", "limit")


def save_estimates(estimates: Estimates, path: Path) -> None:
    """Write under a temporary name, then rename."""
    columns: dict[str, np.ndarray] = {"t_ns": estimates.t_ns}
    for signal in (*TORQUES, "near_stiction"):
        values = getattr(estimates, signal)
        columns |= {f"{signal}_{joint}": np.ascontiguousarray(values[:, j]) for j, joint in enumerate(estimates.joints)}
    columns |= {"health": estimates.health, "detection": estimates.detection}
    table = pa.table(columns).replace_schema_metadata(
        {"tauext_estimates_format": "1", "joints": json.dumps(estimates.joints)}
    )
    torques = [f"{signal}_{joint}" for signal in TORQUES for joint in estimates.joints]
    part = path.with_name(path.name + ".part")
    pq.write_table(
        table,
        part,
        compression="zstd",
        compression_level=1,
        use_dictionary=False,
        column_encoding={name: "BYTE_STREAM_SPLIT" for name in torques},
    )
    os.replace(part, path)


def load_estimates(path: Path) -> Estimates:
    """Read what save_estimates wrote.

    Raises:
        RecordingError: missing, damaged or foreign file.
    """
    try:
        table = pq.read_table(path)
        joints = tuple(json.loads(table.schema.metadata[b"joints"]))
        column = {name: table.column(name).to_numpy() for name in table.column_names}
        signals = {
            signal: np.stack([column[f"{signal}_{joint}"] for joint in joints], axis=1)
            for signal in (*TORQUES, "near_stiction")
        }
        return Estimates(joints, column["t_ns"], **signals, health=column["health"], detection=column["detection"])
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: there are no such estimates; `tauext evaluate` writes them") from error
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError) as error:
        raise RecordingError(f"{path}: not a readable estimates file ({error}); evaluate again") from error
