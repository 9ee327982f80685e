"""When a recording was made, where its clock says so; the samples are not read."""

from __future__ import annotations

from datetime import UTC, date, datetime

from tauext.errors import StoreError
from tauext.files.place import Place
from tauext.files.reading import reading

EARLIEST_NS = int(datetime(2000, 1, 1, tzinfo=UTC).timestamp()) * 10**9
"""A clock before it counts from a start of its own, and tells no day."""


def recording_date(path: Place) -> date | None:
    """Day of the first sample, UTC; None: its clock is none of the calendar's, or the file cannot be read."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        with reading(path) as raw, parquet.ParquetFile(raw) as file:
            column = file.schema_arrow.get_field_index("t_ns")
            if column < 0 or not file.metadata.num_row_groups:
                return None
            told = file.metadata.row_group(0).column(column).statistics
            if told is None or not told.has_min_max:
                return None
            first_ns = int(told.min)
    except (OSError, ValueError, TypeError, StoreError, pa.ArrowException):
        return None
    return datetime.fromtimestamp(first_ns / 1e9, UTC).date() if first_ns >= EARLIEST_NS else None
