"""Estimates of a recording, sample by sample: the table of their columns, and their file."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tauext import _core
from tauext.data.recording_file import write_parquet
from tauext.errors import RecordingError
from tauext.files.plain_file import FORMAT, expect_file, expect_format, json_of
from tauext.files.preflight import expect_rows_fit

HEALTHS = ("warming up", "ok", "stale", "fault")
"""By the core's number."""
WARMING_UP, OK, STALE, FAULT = range(4)  # health
ALARMS = ("none", "contact", "collision")
"""By the core's number."""
NONE, CONTACT, COLLISION = range(3)  # alarm
TOUCHES: tuple[str, ...] = tuple(touch.name for touch in _core.Touch)
"""Kinds of touch, by the core's number."""
FIRST_KIND = TOUCHES.index("impact")
"""The kinds before it are none and unknown."""
DECLARED: tuple[str, ...] = tuple(one.name for one in _core.Declared)
"""States of a declared contact, by the core's number."""


@dataclass(frozen=True)
class Column:
    """One quantity of an estimate. The core, `Estimates` and its file call it `name`, JSON and messages `key`."""

    name: str
    kind: type = np.float32
    """In files; float32: a torque, in the bundle's estimate unit of the joint."""
    per_joint: bool = True
    in_messages: bool = False
    """Whether it is among the torques of JSON and messages."""

    @property
    def key(self) -> str:
        return self.name.removesuffix("_nm") + "_nm"


# Described where `Estimates` has them; it does not hold the three with a comment.
COLUMNS = (
    Column("residual", in_messages=True),
    Column("prior"),
    Column("network"),
    Column("drift"),
    Column("uncertainty", in_messages=True),  # r expected in free motion: prior + network + drift
    Column("tau_ext", in_messages=True),
    Column("load_nm", in_messages=True),  # share of tau_ext taken for a load that is expected
    Column("declared_nm", in_messages=True),  # share of tau_ext that declared contacts explain
    Column("sigma_nm", in_messages=True),
    Column("contact_sigma_nm", in_messages=True),
    Column("limit_nm", in_messages=True),
    Column("contact_limit_nm", in_messages=True),
    Column("margin_nm", in_messages=True),  # limit_nm - |tau_ext|, without what is explained
    Column("near_stiction", bool),
    Column("health", np.int8, False),
    Column("causes", np.uint32, False),
    Column("detection", bool, False),
    Column("held_alarm", np.int8, False),
    Column("alarm", np.int8, False),
    Column("touch", np.int8, False),
)


@dataclass(frozen=True)
class Estimates:
    """One row a sample of the recording; of the types in COLUMNS, (samples, joints) or (samples,).

    The first rows' tau_ext is NaN: until the observer has forgotten how it began, 10/K0, and a network's window is
    full, there is no estimate (a second at K0 = 20; without a network half of that). `health` states it, `why(row)` in
    words.
    """

    joints: tuple[str, ...]
    """Names of the joints, in the order of the columns."""
    t_ns: np.ndarray
    """(samples,) int64: stamps of the samples, [ns]."""
    residual: np.ndarray
    """Residual r of the observer."""
    network: np.ndarray
    """What the network expects of r beside the prior; 0 without one, NaN while warming up."""
    tau_ext: np.ndarray
    """External torque: residual - uncertainty; NaN while warming up."""
    limit_nm: np.ndarray
    """Collision threshold of |tau_ext|."""
    near_stiction: np.ndarray
    """Whether the thresholds are those near stiction."""
    health: np.ndarray
    """0 warming up, 1 ok, 2 stale, 3 fault."""
    causes: np.ndarray
    """A bit for each cause why health is not ok; `cause_names` has the words."""
    detection: np.ndarray
    """Healthy, and some |tau_ext| over its collision threshold."""
    held_alarm: np.ndarray
    """Level held at this sample: 0 none, 1 contact, 2 collision."""
    touch: np.ndarray
    """Contact type, of `Touch`; of a monitor 0 once the alarm was acknowledged."""
    prior: np.ndarray | None = None
    """r expected from friction and model errors; None where the bundle has no prior."""
    drift: np.ndarray | None = None
    """Adaptive bias that is subtracted; None where the bundle has none."""
    sigma_nm: np.ndarray | None = None
    """Standard error of tau_ext, NaN as tau_ext; None where the bundle has no error scale."""
    contact_sigma_nm: np.ndarray | None = None
    """Standard error of tau_ext during a contact and after it; None as sigma_nm."""
    contact_limit_nm: np.ndarray | None = None
    """Contact threshold of |tau_ext|; None in files of `tauext evaluate`."""
    alarm: np.ndarray | None = None
    """The alarm level, latched until acknowledged; None unless from a monitor."""

    @classmethod
    def of(
        cls,
        joints: tuple[str, ...],
        t_ns: np.ndarray,
        values: Mapping[str, np.ndarray],
        lacking: Collection[str],
        rows: np.ndarray | slice = slice(None),
    ) -> Estimates:
        """Rows of the core's answers; `t_ns` of these rows. lacking: columns that its bundle does not have."""
        known: dict[str, Any] = {
            column.name: values[column.name][rows].astype(column.kind, copy=False)
            for column in STORED
            if column.name in values and column.name not in lacking
        }
        return cls(joints, t_ns, **known)

    @property
    def band_nm(self) -> np.ndarray | None:
        """Standard error for figures: that of contacts where it is known, else that of free motion."""
        return self.sigma_nm if self.contact_sigma_nm is None else self.contact_sigma_nm

    @property
    def limits_move(self) -> bool:
        """Whether a limit takes more values than one sliding and one near stiction."""
        return any(len(np.unique(one[np.isfinite(one)])) > 2 for one in self.limit_nm.T)

    @property
    def healthy(self) -> np.ndarray:
        """(samples,) bool: health is ok."""
        return self.health == OK

    def why(self, row: int) -> str:
        """Health of one sample in words: `ok`, `warming up`, `warming up: gap`, `fault: not finite`."""
        causes = _core.cause_names(int(self.causes[row]))
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


STORED = tuple(column for column in COLUMNS if column.name in Estimates.__dataclass_fields__)


def lacking(bundle: _core.Bundle) -> frozenset[str]:
    """Columns without content for this bundle."""
    has_prior = bool(bundle.prior.terms or bundle.prior.corrected_links)
    has = {"prior": has_prior, "drift": bundle.drift.time_constant_s > 0}
    has |= dict.fromkeys(("sigma_nm", "contact_sigma_nm"), bundle.error_scale.on)
    return frozenset(name for name, there in has.items() if not there)


def unexplained(estimates: Mapping[str, np.ndarray]) -> np.ndarray:
    """tau_ext less what an expected load and declared contacts explain, which the alarm compares with its limits."""
    left = estimates["tau_ext"]
    for name in ("load_nm", "declared_nm"):  # estimates of a bare chain have neither
        if name in estimates:
            left = left - estimates[name]
    return left


def number(value: float) -> float | None:
    """For JSON, which has no NaN."""
    return float(value) if math.isfinite(value) else None


def torque_lists(values: Callable[[str], Iterable[float]]) -> dict[str, list[float | None]]:
    """The torques of one sample for JSON and messages, a joint; null where a number does not exist.

    Args:
        values: those of the column of this name.
    """
    return {column.key: [number(value) for value in values(column.name)] for column in COLUMNS if column.in_messages}


def sample_facts(estimates: Mapping[str, np.ndarray], row: int) -> dict[str, Any]:
    """Estimate at one row of Monitor.run, as plain JSON; null for missing numbers."""
    return estimate_facts(lambda name: estimates[name][row], _core.cause_names(int(estimates["causes"][row])))


def estimate_facts(of: Callable[[str], Any], causes: Sequence[str]) -> dict[str, Any]:
    """One estimate as plain JSON.

    Args:
        of: a quantity by the core's name; health, alarm and touch as numbers.
    """
    return {
        "health": HEALTHS[of("health")],
        "causes": list(causes),
        "alarm": ALARMS[of("alarm")],
        "touch": TOUCHES[of("touch")],
        "detection": bool(of("detection")),
        "declared": DECLARED[of("declared")],
        "declared_size": number(of("declared_size")),
        **torque_lists(of),
        "unfamiliar": float(of("unfamiliar")),
        "near_stiction": [bool(near) for near in of("near_stiction")],
    }


def rounded(values: Any) -> list[float | None]:
    """One value a joint as JSON has it."""
    return [round(value, 5) if math.isfinite(value) else None for value in np.ravel(np.asarray(values, float)).tolist()]


def save_estimates(estimates: Estimates, path: Path) -> None:
    """Write under a temporary name, then rename; columns that are None are left out.

    Raises:
        RecordingError: the file cannot be written; the incomplete file is removed.
    """
    import pyarrow as pa

    columns, torques = {"t_ns": estimates.t_ns}, []
    for column in STORED:
        values = getattr(estimates, column.name)
        if values is None:
            continue
        if not column.per_joint:
            columns[column.name] = values.astype(column.kind, copy=False)
            continue
        names = [f"{column.name}_{joint}" for joint in estimates.joints]
        columns |= {name: np.ascontiguousarray(values[:, j]) for j, name in enumerate(names)}
        torques += names if column.kind is np.float32 else []
    table = pa.table(columns).replace_schema_metadata(
        {"tauext_estimates_format": str(FORMAT), "joints": json.dumps(estimates.joints)}
    )
    write_parquet(table, path, use_dictionary=False, column_encoding=dict.fromkeys(torques, "BYTE_STREAM_SPLIT"))


def load_estimates(path: Path) -> Estimates:
    """Read what save_estimates wrote; what the file has no column for is None.

    Raises:
        RecordingError: missing, damaged or foreign file.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        expect_file(path)
        held_by = pq.read_metadata(path)
        expect_rows_fit(path, held_by.num_rows, held_by.num_columns)
        table = pq.read_table(path)
        metadata = {key.decode(): value.decode() for key, value in (table.schema.metadata or {}).items()}
        expect_format(metadata, path, "evaluate or run again", RecordingError, "tauext_estimates_format")
        joints = tuple(json_of(metadata["joints"]))
        held = {name: table.column(name).to_numpy() for name in table.column_names}
        if odd := [name for name, values in held.items() if values.dtype.kind not in "fiub"]:
            raise ValueError(f"column '{odd[0]}' holds no numbers")
        content = {}
        for column in STORED:
            names = [f"{column.name}_{joint}" for joint in joints] if column.per_joint else [column.name]
            if names[0] in held:
                values = [held[name] for name in names]
                content[column.name] = np.stack(values, axis=1) if column.per_joint else values[0]
        return Estimates(joints, held["t_ns"], **content)
    except FileNotFoundError as error:
        raise RecordingError(
            f"{path}: there are no such estimates; `tauext evaluate` and `tauext run --flights` write them"
        ) from error
    except (OSError, pa.ArrowException, KeyError, IndexError, TypeError, ValueError) as error:
        raise RecordingError(f"{path}: not a readable estimates file ({error}); evaluate again") from error
