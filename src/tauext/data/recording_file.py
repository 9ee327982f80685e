"""The Parquet file of a recording."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tauext.config import checked
from tauext.data.labels import epoch_of, has_labels, overlay, read_labels
from tauext.data.recording import FLAGS, REQUIRED_SIGNALS, SIGNALS, Recording, check_joints
from tauext.data.servo import in_amperes
from tauext.errors import RecordingError
from tauext.files.atomic_write import atomic_write
from tauext.files.kind import why_no_recording
from tauext.files.plain_file import FORMAT, expect_file, expect_format, json_of
from tauext.files.preflight import expect_rows_fit

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

UNITS = {"t": "ns", "q": "rad", "dq": "rad/s", "tau": "N m"}
"""Units by quantity; tau of a motor current with unknown torque constants is in A."""
TEXTS = ("tauext_format", "joints", "units", "rate_hz", "torque_timing", "source", "robot_sha256", "provenance")
"""Keys of the schema's metadata, all required."""
ROW_GROUP = 225_000
"""Samples of a row group, the unit of reading: half an hour at 125 Hz; no import puts more in a file."""


def write_parquet(table: pa.Table, path: Path, **encoding: Any) -> None:
    """Write a table with its metadata.

    Args:
        encoding: further arguments of pyarrow.parquet.write_table.

    Raises:
        RecordingError: the file cannot be written; a partial file is removed.
    """
    import pyarrow.parquet as pq

    try:
        with atomic_write(path) as part:
            pq.write_table(table, part, compression="zstd", compression_level=1, **encoding)
    except (OSError, UnicodeEncodeError) as error:  # or a name that is not UTF-8
        cause = getattr(error, "strerror", None) or error
        raise RecordingError(f"{path}: cannot be written ({cause})") from error


@dataclass(frozen=True)
class Description:
    """Metadata of a recording's file, without samples."""

    name: str
    joints: tuple[str, ...]
    signals: tuple[str, ...]
    """Signals in the file, per joint or not, without `t_ns`."""
    samples: int
    rate_hz: float
    torque_timing: str
    source: str
    robot_sha256: str
    provenance: dict[str, Any]


@checked
def save_recording(recording: Recording, path: Path | str) -> None:
    """Write a recording under a temporary name in the same folder, then rename; its name becomes the stem of `path`.

    Equal recordings give equal bytes. Folders are not created.

    Raises:
        RecordingError: the name does not end in .parquet, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix != ".parquet":
        raise RecordingError(f"{path}: the name of a recording's file must end in .parquet")
    import pyarrow as pa

    held = [signal for signal in SIGNALS if getattr(recording, signal) is not None]
    columns = {"t_ns": recording.t_ns}
    for signal in held:
        by_joint = np.ascontiguousarray(getattr(recording, signal).T)
        columns |= {f"{signal}_{joint}": by_joint[j] for j, joint in enumerate(recording.joints)}
    floats = list(columns)[1:]
    flags = [flag for flag in FLAGS if getattr(recording, flag) is not None]
    columns |= {flag: getattr(recording, flag) for flag in flags}
    units = UNITS | ({"tau": "A"} if in_amperes([recording]) else {})
    texts = [str(FORMAT), json.dumps(recording.joints), json.dumps(units), repr(recording.rate_hz)]
    texts += [recording.torque_timing, recording.source, recording.robot_sha256, json.dumps(recording.provenance)]
    table = pa.table(columns).replace_schema_metadata(dict(zip(TEXTS, texts, strict=True)))
    encoding = {"t_ns": "DELTA_BINARY_PACKED"} | dict.fromkeys(floats, "BYTE_STREAM_SPLIT")
    how: dict[str, Any] = {"use_dictionary": flags, "column_encoding": encoding, "row_group_size": ROW_GROUP}
    write_parquet(table, path, write_page_checksum=True, **how)


@checked
def load_recording(
    path: Path | str, signals: Collection[str] | None = None, rows: tuple[int, int] | None = None
) -> Recording:
    """Read a recording; its name is the stem of `path`. The file is never changed.

    Labels beside a recording of `tauext commission` become its `contact`.

    Args:
        signals: optional signals to read if present; None: all.
        rows: first sample and the one after the last; None: all.

    Raises:
        RecordingError: names the file, its fault and the rule.
    """
    path = Path(path)
    with opened(path) as file:
        head = read_head(path, file)
        check_columns(path, head, file.schema_arrow)
        kept = [s for s in head.signals if signals is None or s in signals or s in REQUIRED_SIGNALS]
        names = column_names(head.joints, kept)
        expect_rows_fit(path, head.samples if rows is None else rows[1] - rows[0], len(names))
        columns = read_rows(file, names, rows)
    arrays = {flag: to_numpy(path, columns, flag) for flag in ("t_ns", *FLAGS) if flag in columns.column_names}
    for signal in kept:
        if signal not in FLAGS:
            values = np.empty((columns.num_rows, len(head.joints)))
            for j, joint in enumerate(head.joints):
                values[:, j] = to_numpy(path, columns, f"{signal}_{joint}")
            values.flags.writeable = False
            arrays[signal] = values
    if (signals is None or "contact" in signals) and (epoch := epoch_of(head.provenance)) is not None:
        if has_labels(path.parent):
            arrays["contact"] = overlay(read_labels(path.parent), epoch, arrays["t_ns"], arrays.get("contact"))
    keep = ("name", "joints", "rate_hz", "torque_timing", "source", "robot_sha256", "provenance")
    facts: dict[str, Any] = {name: getattr(head, name) for name in keep}
    try:
        return Recording(**(facts | arrays))
    except RecordingError as error:
        what = str(error).removeprefix(f"recording '{path.stem}': ")
        raise RecordingError(f"{path}: {what}") from error


def column_names(joints: Sequence[str], signals: Sequence[str]) -> list[str]:
    """Names of the columns of time and these signals."""
    per_joint = [f"{signal}_{joint}" for signal in signals if signal not in FLAGS for joint in joints]
    return ["t_ns", *per_joint, *(flag for flag in FLAGS if flag in signals)]


def read_rows(file: pq.ParquetFile, columns: list[str], rows: tuple[int, int] | None) -> pa.Table:
    """Read these columns and rows; row groups without such rows are skipped."""
    if rows is None:
        return file.read(columns)
    first, end = rows
    sizes = [file.metadata.row_group(g).num_rows for g in range(file.num_row_groups)]
    starts = [sum(sizes[:g]) for g in range(len(sizes))]
    wanted = [g for g, size in enumerate(sizes) if starts[g] < end and starts[g] + size > first]
    return file.read_row_groups(wanted, columns).slice(first - starts[wanted[0]], end - first)


def describe(path: Path | str) -> Description:
    """Read joints, signals, rate and number of samples from the metadata alone, in milliseconds for any length.

    Raises:
        RecordingError: see load_recording(), except for faults of the samples.
    """
    path = Path(path)
    with opened(path) as file:
        head = read_head(path, file)
        check_columns(path, head, file.schema_arrow)
    if "contact" in head.signals or epoch_of(head.provenance) is None or not has_labels(path.parent):
        return head
    return replace(head, signals=(*head.signals, "contact"))


def stretch_of(path: Path | str) -> tuple[Description, int, int]:
    """Description, first and last stamp [ns] of a recording, from its footer alone.

    Raises:
        RecordingError: see describe(), or the footer has no stamps.
    """
    path = Path(path)
    with opened(path) as file:
        head, groups = read_head(path, file), file.metadata.num_row_groups
        column = file.schema_arrow.get_field_index("t_ns")
        ends = [file.metadata.row_group(g).column(column).statistics for g in range(groups)] if column >= 0 else []
        if not ends or not all(one is not None and one.has_min_max for one in ends):
            raise RecordingError(f"{path}: its footer has no stamps")
        return head, int(ends[0].min), int(ends[-1].max)


def fingerprint(path: Path | str) -> str:
    """SHA-256 of the footer of a recording's file: metadata, and extremes and sizes of every column.

    It distinguishes recordings, in milliseconds for any length; it is not secure against forgery.

    Raises:
        RecordingError: the file is missing or no Parquet file.
    """
    path = Path(path)
    with opened(path), path.open("rb") as raw:
        raw.seek(-8, os.SEEK_END)
        length = int.from_bytes(raw.read(4), "little")
        raw.seek(-8 - length, os.SEEK_END)
        return hashlib.sha256(raw.read(length)).hexdigest()


@contextmanager
def opened(path: Path) -> Iterator[pq.ParquetFile]:
    """Open a Parquet file for reading; its errors become RecordingError."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        if path.is_dir():
            raise RecordingError(f"{path}: {why_no_recording(path)}")
        expect_file(path)  # a pipe would block
        try:
            parquet = pq.ParquetFile(path, page_checksum_verification=True)
        except pa.ArrowException:
            expect_whole(path)
            raise
        with parquet as file:
            expect_rows(path, file.metadata)
            yield file
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: there is no such recording") from error
    except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
        cause = str(error).splitlines()[0]
        raise RecordingError(f"{path}: cannot be read ({cause}); if it is damaged, copy or record it again") from error


def expect_rows(path: Path, footer: pq.FileMetaData) -> None:
    """Raise RecordingError unless the footer has the same number of rows for every group and column.

    A reader allocates for the one, and returns as many as the other.
    """
    groups = [footer.row_group(g) for g in range(footer.num_row_groups)]
    counts = {group.column(c).num_values - group.num_rows for group in groups for c in range(group.num_columns)}
    if sum(group.num_rows for group in groups) != footer.num_rows or not counts <= {0}:
        raise RecordingError(
            f"{path}: its footer states {footer.num_rows:,} rows, and other numbers elsewhere; copy or record it again"
        )


def expect_whole(path: Path) -> None:
    """Raise RecordingError unless the file begins and ends as a Parquet file."""
    with path.open("rb") as raw:
        begin = raw.read(4)
        raw.seek(0, os.SEEK_END)
        raw.seek(max(0, raw.tell() - 4))
        end = raw.read(4)
    if begin != b"PAR1":
        otherwise = "not a Parquet file: it begins otherwise; recordings are Parquet files"
        raise RecordingError(f"{path}: {why_no_recording(path) or otherwise}")
    if end != b"PAR1":
        raise RecordingError(f"{path}: truncated: the end of a Parquet file is missing; copy or record it again")


def read_head(path: Path, file: pq.ParquetFile) -> Description:
    """Read the metadata and check each entry."""
    metadata = file.schema_arrow.metadata or {}
    texts = {key: metadata[key.encode()].decode(errors="replace") for key in TEXTS if key.encode() in metadata}
    if "tauext_format" not in texts:
        raise RecordingError(f"{path}: not a recording: its metadata has no tauext_format; tauext writes '{FORMAT}'")
    expect_format(texts, path, "import or record it again", RecordingError, "tauext_format")
    for key in TEXTS:
        if key not in texts:
            raise RecordingError(f"{path}: its metadata has no '{key}'; needed are {', '.join(TEXTS)}")
    joints = check_joints(parse_json(path, "joints", texts["joints"], list), str(path))
    try:
        rate_hz = float(texts["rate_hz"])
    except ValueError as error:
        raise RecordingError(f"{path}: rate_hz = '{texts['rate_hz']}' must be a number, in Hz") from error
    names = set(file.schema_arrow.names)
    held = tuple(s for s in SIGNALS if any(f"{s}_{joint}" in names for joint in joints))
    signals, provenance = held + tuple(one for one in FLAGS if one in names), texts["provenance"]
    facts = (texts["torque_timing"], texts["source"], texts["robot_sha256"])
    provenance = parse_json(path, "provenance", provenance, dict)
    head = Description(path.stem, joints, signals, file.metadata.num_rows, rate_hz, *facts, provenance)
    units = parse_json(path, "units", texts["units"], dict)
    for quantity, unit in UNITS.items():
        found = units.get(quantity, "missing")
        if found != unit and not (quantity == "tau" and found == "A" and in_amperes([head])):
            rule = f"must be '{unit}'; convert the columns and write the recording again"
            raise RecordingError(f"{path}: the unit of {quantity} is {found!r}, {rule}")
    return head


def check_columns(path: Path, head: Description, schema: pa.Schema) -> None:
    """Check that every column occurs once with its type, and that a signal has all joints or none."""
    import pyarrow as pa

    per_joint = [signal for signal in SIGNALS if signal in head.signals or signal in REQUIRED_SIGNALS]
    expected = {"t_ns": pa.int64()}
    expected |= {f"{signal}_{joint}": pa.float64() for signal in per_joint for joint in head.joints}
    expected |= {flag: pa.int8() for flag in FLAGS if flag in head.signals}
    for name, kind in expected.items():
        count = schema.names.count(name)
        if count != 1:
            what = "is missing" if count == 0 else f"occurs {count} times"
            rule = f"a signal has all joints ({', '.join(head.joints)}) or none"
            raise RecordingError(f"{path}: column '{name}' {what}" + (f"; {rule}" if name != "t_ns" else ""))
        if schema.field(name).type != kind:
            raise RecordingError(f"{path}: column '{name}' is {schema.field(name).type}, must be {kind}")
    for name in schema.names:
        if name not in expected:
            raise RecordingError(
                f"{path}: column '{name}' does not belong to a recording; columns are t_ns, {', '.join(FLAGS)} and "
                f"<signal>_<joint> with signals {', '.join(SIGNALS)} and joints {', '.join(head.joints)}"
            )


def to_numpy(path: Path, columns: pa.Table, name: str) -> np.ndarray:
    """Return one column as an array; a missing entry is an error."""
    column = columns.column(name)
    if column.null_count:
        row = int(np.flatnonzero(column.is_null().to_numpy())[0])
        raise RecordingError(f"{path}: {name} at row {row} is missing; every sample must have a value")
    values = column.to_numpy()
    values.flags.writeable = False
    return values


def parse_json(path: Path, key: str, text: str, kind: type) -> Any:
    """The JSON value under this key of the metadata."""
    try:
        value = json_of(text)
    except ValueError as error:
        raise RecordingError(f"{path}: metadata '{key}' is not JSON ({error})") from error
    if not isinstance(value, kind):
        wanted = "list" if kind is list else "object"
        raise RecordingError(f"{path}: metadata '{key}' is {text[:60]}, must be a JSON {wanted}")
    return value
