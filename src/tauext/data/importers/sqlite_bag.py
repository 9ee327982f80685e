"""Sqlite3 files of ROS 2 bags, also those that the recorder did not close or that are damaged."""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import quote

from tauext.data.importers.bag import Channel, CountLost, ros_type
from tauext.errors import RecordingError

MAGIC = b"SQLite format 3\0"


class SqliteBag:
    """An open sqlite3 file."""

    def __init__(self, path: Path):
        self.notes: list[str] = []
        self._copies: TemporaryDirectory | None = None
        self._database = self._opened(path)
        self._damaged = False
        try:
            definitions = self._definitions()
            topics = self._database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        except (RecordingError, sqlite3.DatabaseError) as error:
            self.close()
            damaged = (
                "its table of topics cannot be read: it is damaged, or the recorder kept its last rows in "
                f"{path.name}-wal; copy all files of the bag's folder again"
            )
            raise RecordingError(f"{path}: {error if isinstance(error, RecordingError) else damaged}") from error
        counts = self._counts()
        self._by_id = {
            number: Channel(name, ros_type(kind), encoding, *definitions.get(kind, ("", "")), counts.get(number, 0))
            for number, name, kind, encoding in topics
        }
        self.channels = list(self._by_id.values())

    def close(self) -> None:
        """Close the file."""
        self._database.close()
        if self._copies:
            self._copies.cleanup()

    def _opened(self, path: Path) -> sqlite3.Connection:
        """Open the file without a change to it: rows beside it are taken in, part of a page left out, on a copy."""
        # The recorder's last rows are there until it closes the bag.
        beside = [path.with_name(path.name + end) for end in ("-wal", "-journal")]
        beside = [part for part in beside if part.is_file() and part.stat().st_size]
        part_of_page = 0 if beside else path.stat().st_size % _page_bytes(path)
        if not beside and not part_of_page:
            return sqlite3.connect(f"file:{quote(str(path))}?immutable=1", uri=True)
        self._copies = TemporaryDirectory()
        for part in (path, *beside):
            shutil.copyfile(part, Path(self._copies.name) / part.name)
        copy = Path(self._copies.name) / path.name
        if beside:
            self.notes.append(
                f"not closed by the recorder: the rows in {', '.join(p.name for p in beside)} are read too"
            )
        else:  # sqlite would take the missing end of the last page for zeros
            os.truncate(copy, copy.stat().st_size - part_of_page)
        return sqlite3.connect(copy)

    def _definitions(self) -> dict[str, tuple[str, str]]:
        """Kind and text of the definition of each type; older bags have none."""
        # A file that is shorter than its header states is refused otherwise, with every row that it has.
        self._database.execute("PRAGMA writable_schema=ON")
        self._expect_tables()
        tables = {name for (name,) in self._database.execute("SELECT name FROM sqlite_master")}
        if "message_definitions" not in tables:
            return {}
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions ORDER BY id DESC"
        return {kind: (schema, text) for kind, schema, text in self._database.execute(query)}

    def _expect_tables(self) -> None:
        """Raise RecordingError where rows are computed, not stored: a view can have any number of rows."""
        kinds = {name: kind for name, kind in self._database.execute("SELECT name, type FROM sqlite_master")}
        for name in ("topics", "messages", "message_definitions"):
            columns = self._database.execute(f"PRAGMA table_xinfo({name})").fetchall()
            if kinds.get(name, "table") != "table" or any(column[-1] for column in columns):
                raise RecordingError(f"its '{name}' is no plain table: no recorder of ROS 2 writes such a file")

    def _counts(self) -> dict[int, int]:
        try:
            return dict(self._database.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id"))
        except sqlite3.DatabaseError:
            self._damaged = True
        counts: dict[int, int] = {}
        for number, _, _ in self._readable():
            counts[number] = counts.get(number, 0) + 1
        self.notes.append(f"the file is damaged or cut off: the {sum(counts.values())} readable messages are read")
        return counts

    def messages(self, wanted: Sequence[Channel], lost: CountLost) -> Iterator[tuple[Channel, int, bytes]]:
        """Yield channel, log time [ns] and bytes of each message, by log time; of a damaged file as they lie."""
        del lost
        channels = {number: channel for number, channel in self._by_id.items() if channel in wanted}
        last_ns = -1
        if not self._damaged:
            marks = ",".join("?" * len(channels))
            query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}) ORDER BY timestamp"
            try:
                for number, log_ns, raw in self._database.execute(query, tuple(channels)):
                    if isinstance(raw, bytes):
                        yield channels[number], log_ns, raw
                        last_ns = log_ns
                return
            except sqlite3.DatabaseError:  # of the index of times
                self.notes.append("the file is damaged: its readable messages are read")
        for number, log_ns, raw in self._readable():
            if number in channels and isinstance(raw, bytes) and isinstance(log_ns, int) and log_ns > last_ns:
                yield channels[number], log_ns, raw

    def _readable(self) -> Iterator[tuple[int, int, bytes]]:
        """Yield the rows that can be read, in the order of the file."""
        query = "SELECT id, topic_id, timestamp, data FROM messages NOT INDEXED WHERE id > ? ORDER BY id"
        last, step = 0, 1
        while step < 1 << 32:  # rows to step over, in search of the next readable one
            try:
                for row, number, log_ns, raw in self._database.execute(query, (last,)):
                    if row <= last:  # damaged pages may lead in a circle
                        raise sqlite3.DatabaseError
                    last, step = row, 1
                    yield number, log_ns, raw
                return
            except sqlite3.DatabaseError:
                last += step
                step *= 2


def _page_bytes(path: Path) -> int:
    """Size of a database's pages, from its header."""
    with path.open("rb") as file:
        size = int.from_bytes(file.read(18)[16:], "big")
    return 65536 if size == 1 else max(size, 1)
