"""How a Parquet file of ours is written: whole or not at all, the same content to the same bytes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tauext.errors import RecordingError
from tauext.files.place import Place
from tauext.files.whole_file import whole_file

if TYPE_CHECKING:
    import pyarrow as pa


def write_parquet(table: pa.Table, path: Place, **encoding: Any) -> None:
    """Write a table with its metadata.

    Args:
        encoding: of pyarrow.parquet.write_table, beside the compression.

    Raises:
        RecordingError: the file cannot be written; what was written of it is removed.
    """
    import pyarrow.parquet as pq

    try:
        with whole_file(path) as part:
            pq.write_table(table, part, compression="zstd", compression_level=1, **encoding)
    except (OSError, UnicodeEncodeError) as error:  # or a name that is no UTF-8
        cause = getattr(error, "strerror", None) or error
        raise RecordingError(f"{path}: cannot be written ({cause})") from error
