"""The journal of a folder: numbered lines in one SQLite database, to which several processes append.

A line is on the disk when append() returns. It survives `kill -9`, a reboot and a full disk. A second database is a
backup, at most a second older while the command runs, from which a damaged one is refilled. Numbers without gaps show
which lines are lost in both. compact() removes lines that newer ones replace; a line has their numbers.
"""

from __future__ import annotations

import errno
import json
import os
import sqlite3
import stat
import threading
from bisect import bisect_right
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any
from zlib import crc32

from tauext.errors import ConfigError
from tauext.files.plain_file import json_of
from tauext_commission.journal_lines import is_whole, why_unusable
from tauext_commission.synced_file import lock, set_aside, sync_folder, write_reserved

NAME, BACKUP, LOCK = "journal.db", "journal.backup.db", ".journal.lock"
OLD = "journal.jsonl"
"""A journal of text, as versions before the first release had it."""
FORMAT, APPLICATION = 1, 0x74617565
"""`user_version` and `application_id` of the database."""
SCHEMA = f"""
PRAGMA application_id = {APPLICATION};
PRAGMA user_version = {FORMAT};
CREATE TABLE line (number INTEGER PRIMARY KEY, kind TEXT NOT NULL, content TEXT NOT NULL, crc32 INTEGER NOT NULL);
"""
REPAIR = "repair"
"""Kind of the line with which a person accepts that numbers are lost: `lost` holds their first and last."""
COMPACTED = "compacted"
"""Kind of the line that names lines that were left out on purpose: `dropped` holds first and last of each range."""
UNUSABLE = "unusable"
"""Kind of a line whose values break a rule of journal_lines.py: `why` holds the reason, its content is left out. It
counts as lost, as it may have been an answer."""
Line = dict[str, Any]
Row = tuple[int, str, str, int]
"""Number, kind, content as JSON, and checksum of these three."""


@dataclass(frozen=True, eq=False)
class Contents:
    """The lines of a journal in the order of their numbers."""

    lines: tuple[Line, ...] = ()

    @property
    def last(self) -> int:
        """Number of the newest line; 0: there is none."""
        return int(self.lines[-1]["number"]) if self.lines else 0

    @cached_property
    def kinds(self) -> dict[str, list[Line]]:
        """The lines of each kind."""
        found: dict[str, list[Line]] = {}
        for one in self.lines:
            found.setdefault(str(one.get("kind")), []).append(one)
        return found

    @cached_property
    def gaps(self) -> list[tuple[int, int]]:
        """First and last number of each run of lines that are missing before the newest one, or cannot be used."""
        edges = [0, *(int(one["number"]) for one in self.lines if one.get("kind") != UNUSABLE), self.last + 1]
        return [(a + 1, b - 1) for a, b in pairwise(edges) if b > a + 1]

    @cached_property
    def unusable(self) -> list[str]:
        """Why lines cannot be used, a sentence each; those that a person has accepted with `--repair` are left out."""
        return [
            f"line {one['number']} is not used: {one['why']}"
            for one in self.kinds.get(UNUSABLE, ())
            if not self._is_accepted((one["number"], one["number"]))
        ]

    def lost(self, noted: int = 0) -> list[tuple[int, int]]:
        """First and last number of each gap that no person has accepted; asked once a second.

        Args:
            noted: a number that a line had, from elsewhere: it shows that the end is missing.
        """
        end = [(self.last + 1, noted)] if noted > self.last else []
        return [*self._unexplained, *(gap for gap in end if not self._is_accepted(gap))]

    @cached_property
    def _unexplained(self) -> list[tuple[int, int]]:
        return [gap for gap in self.gaps if not self._is_accepted(gap)]

    @cached_property
    def _accepted(self) -> list[tuple[int, int]]:
        """Ranges of numbers that a person gave up or that were left out on purpose, joined, in order."""
        return joined_ranges([*ranges(self.kinds.get(REPAIR, ()), "lost"), *dropped_ranges(self.lines)])

    def _is_accepted(self, gap: tuple[int, int]) -> bool:
        at = bisect_right(self._accepted, gap[0], key=lambda one: one[0]) - 1
        return at >= 0 and gap[1] <= self._accepted[at][1]


def ranges(lines: Iterable[Line], key: str) -> list[tuple[int, int]]:
    """First and last number of each range in this entry of the lines."""
    return [(int(a), int(b)) for one in lines for a, b in one.get(key, ())]


def dropped_ranges(lines: Iterable[Line]) -> list[tuple[int, int]]:
    """Numbers of the lines that compact() has left out; its newest line names all of them."""
    return ranges([one for one in lines if one.get("kind") == COMPACTED][-1:], "dropped")


def joined_ranges(found: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """The ranges in order; those that touch or overlap are one."""
    joined: list[tuple[int, int]] = []
    for first, last in sorted(found):
        if joined and first <= joined[-1][1] + 1:
            joined[-1] = joined[-1][0], max(last, joined[-1][1])
        else:
            joined.append((first, last))
    return joined


# --- Reading: whole once, then only what was appended.


@dataclass
class _Open:
    """A folder's journal in this process."""

    database: sqlite3.Connection | None
    """None: the file cannot be used."""
    contents: Contents
    stamp: tuple[int, int, int] | None
    """Identity, size and time of the database's file at its last check."""
    version: int = 0
    """SQLite's data_version, which changes with every commit of another connection."""
    backed_up: tuple[Any, ...] = ()
    """Stamp of the backup, and number of its last line and of its lines."""
    damage: str = ""
    """Why the database must be written again; empty: it is whole."""
    backup_damage: str = ""
    is_read_only: bool = False


_open: dict[Path, _Open] = {}
_using = threading.RLock()


def read(folder: Path) -> Contents:
    """The journal of a folder, with the backup's lines where lines are missing; without both, empty.

    Raises:
        ConfigError: it is of another version of tauext.
    """
    with _using:
        return _current(folder).contents


def close(folder: Path) -> None:
    """Close the database of a folder in this process."""
    with _using:
        one = _open.pop(folder, None)
        if one is not None and one.database is not None:
            one.database.close()


def close_all() -> None:
    """Close the databases of all folders in this process."""
    for folder in tuple(_open):
        close(folder)


def is_journal(folder: Path) -> bool:
    """Whether a journal, or what is left of one, lies in the folder."""
    return any((folder / name).is_file() for name in (NAME, BACKUP, OLD))


def _current(folder: Path, is_checked: bool = False) -> _Open:
    """The journal as it is now.

    Args:
        is_checked: check both files again if one has changed beside the log of SQLite.
    """
    one, stamp = _open.get(folder), _stamp(folder / NAME)
    is_same = one is not None and (stamp or (0,))[0] == (one.stamp or (0,))[0]
    if one is None or not is_same or (one.is_read_only and _takes(folder)):
        return _whole(folder)
    if is_checked and (stamp != one.stamp or _stamp(folder / BACKUP) != one.backed_up[0]):
        return _whole(folder)
    if one.database is not None:
        try:
            version = one.database.execute("PRAGMA data_version").fetchone()[0]
            if version != one.version and (one.damage or not _has_grown(one)):
                return _whole(folder)
            one.version = version
        except sqlite3.Error:
            return _whole(folder)
    return one


def _has_grown(one: _Open) -> bool:
    """Read the lines that were appended since; whether nothing else has changed."""
    assert one.database is not None
    with _snapshot(one.database) as database:
        rows = database.execute("SELECT * FROM line WHERE number > ? ORDER BY number", (one.contents.last,)).fetchall()
        (count,) = database.execute("SELECT count(*) FROM line").fetchone()
    lines = (*one.contents.lines, *_lines(rows).values())
    if count != len(lines):
        return False
    one.contents = Contents(lines)
    return True


def _whole(folder: Path) -> _Open:
    """All lines of the database, its backup, and those that this process has read before."""
    before = _open.get(folder)
    close(folder)
    if not any(os.path.lexists(folder / name) for name in (NAME, BACKUP)) and before is None:
        _expect_no_text(folder)
        return _Open(None, Contents(), None)
    path, backup = folder / NAME, folder / BACKUP
    stamp = _stamp(path)
    database, lines, damage, version = _checked(path)
    copy, copied, backup_damage, _ = _checked(backup, is_backup=True)
    if copy is not None:
        copy.close()
    found = copied | lines
    if before is not None and database is None and _is_there(folder):
        found = {int(one["number"]): one for one in before.contents.lines} | found
    for first, last in dropped_ranges(found[number] for number in sorted(found)):
        for number in [one for one in found if first <= one <= last]:
            del found[number]
    damage = damage or "lines are missing" * bool(found.keys() - lines.keys())
    contents = Contents(tuple(found[number] for number in sorted(found)))
    one = _Open(database, contents, stamp, damage=damage, backup_damage=backup_damage, is_read_only=not _takes(folder))
    one.backed_up = (_stamp(backup), max(copied, default=0), len(copied))
    one.version = version
    _open[folder] = one
    return one


def _takes(folder: Path) -> bool:
    return os.access(folder, os.W_OK)


def _expect_no_text(folder: Path) -> None:
    """Raise ConfigError if the folder has a journal of text."""
    if (folder / OLD).is_file():
        raise ConfigError(
            f"{folder}: its journal is a text file of an earlier version of tauext, which this one does not read; "
            "begin again with `tauext commission --out NEW`"
        )


def _stamp(path: Path) -> tuple[int, int, int] | None:
    """Identity, size and time of change of a file that is no link."""
    with suppress(OSError):
        status = path.lstat()
        if stat.S_ISREG(status.st_mode):
            return status.st_ino, status.st_size, status.st_mtime_ns
    return None


def _is_there(folder: Path) -> bool:
    """Whether the folder is still one with other files: one that was removed has no journal any more."""
    try:
        return any(not one.name.startswith((NAME, BACKUP, LOCK)) for one in folder.iterdir())
    except OSError:
        return False


def _checked(path: Path, is_backup: bool = False) -> tuple[sqlite3.Connection | None, dict[int, Line], str, int]:
    """The database of a file, all lines that can be read, its damage in words, and a data_version that is no newer.

    Raises:
        ConfigError: it is of a later version of tauext.
    """
    if not os.path.lexists(path):
        return None, {}, "it is missing", 0
    if _stamp(path) is None:
        return None, {}, "it is no file", 0
    database, lines = None, dict[int, Line]()
    try:
        database = _connect(path, is_backup or not _takes(path.parent))
        application, version = (
            database.execute(f"PRAGMA {one}").fetchone()[0] for one in ("application_id", "user_version")
        )
        if application != APPLICATION:
            raise sqlite3.DatabaseError("it is not a journal of tauext")
        if version > FORMAT:
            raise ConfigError(
                f"{path}: has format {version}, which this version of tauext does not read (it reads {FORMAT}); "
                "use the version that made it"
            )
        (data_version,) = database.execute("PRAGMA data_version").fetchone()
        with _snapshot(database):
            (found,) = database.execute("PRAGMA quick_check(1)").fetchone()
            lines = _readable(database)
            (count,) = database.execute("SELECT count(*) FROM line").fetchone()
        if found != "ok" or len(lines) != count:
            raise sqlite3.DatabaseError("its content is damaged")
        return database, lines, "", data_version
    except (sqlite3.Error, ConfigError) as error:
        if database is not None:
            lines = lines or _readable(database)
            database.close()
        if isinstance(error, ConfigError):
            raise
        return None, lines, str(error), 0


@contextmanager
def _snapshot(database: sqlite3.Connection) -> Iterator[sqlite3.Connection]:
    """Read one state of the database, whatever other processes commit meanwhile."""
    database.execute("BEGIN")
    try:
        yield database
    finally:
        with suppress(sqlite3.Error):
            database.execute("COMMIT")


def _connect(path: Path, is_read_only: bool) -> sqlite3.Connection:
    """Open a database; one in a folder that takes no files is read without the files of SQLite's log."""
    log = path.with_name(f"{path.name}-wal")
    mode = "rw" if not is_read_only else "ro" if log.exists() and log.stat().st_size else "ro&immutable=1"
    uri = f"{path.resolve().as_uri()}?mode={mode}"
    database = sqlite3.connect(uri, timeout=60.0, isolation_level=None, check_same_thread=False, uri=True)
    if not is_read_only:
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("PRAGMA synchronous = FULL")
    return database


def _readable(database: sqlite3.Connection) -> dict[int, Line]:
    """All whole lines up to a damage."""
    rows: list[Row] = []
    with suppress(sqlite3.Error):
        rows.extend(database.execute("SELECT * FROM line ORDER BY number"))
    return _lines(rows)


def _lines(rows: Iterable[Row]) -> dict[int, Line]:
    """The lines of these rows by number; one that breaks a rule is of kind UNUSABLE, a damaged one is left out."""
    found: dict[int, Line] = {}
    for number, kind, text, check in rows:
        if check != _check(number, kind, text):
            continue
        with suppress(ValueError):
            content = json_of(text)
            if isinstance(content, dict) and is_whole(number, least=1):
                line = {"number": number, "kind": kind} | content
                why = why_unusable(line)
                found[number] = {"number": number, "kind": UNUSABLE, "why": why} if why else line
    return found


def _check(number: object, kind: object, text: object) -> int:
    return crc32(f"{number} {kind} {text}".encode(errors="replace"))


def _row(line: Mapping[str, Any]) -> Row:
    number, kind = int(line["number"]), str(line["kind"])
    text = _text({key: value for key, value in line.items() if key not in ("number", "kind")})
    return number, kind, text, _check(number, kind, text)


def _text(content: Mapping[str, Any]) -> str:
    return json.dumps(content, allow_nan=False)


# --- Writing.


def _to_write(folder: Path, is_checked: bool = False) -> _Open:
    """The journal as it is now, for who holds its lock: a damage that was seen without the lock is checked again."""
    one = _current(folder, is_checked)
    return _whole(folder) if one.database is None or one.damage else one


def append(folder: Path, kind: str, content: Mapping[str, Any], after: int = 0) -> str:
    """Append a line and wait until the disk holds it; what had to be refilled before, or empty.

    Args:
        after: a number that a line had, from elsewhere: it is not given twice.

    Raises:
        OSError: the line cannot be written; the journal is as before.
    """
    with _locked(folder):
        one = _to_write(folder)
        words = _mend(folder, one) if one.database is None or one.damage else ""
        one = _current(folder)
        row = _row({"number": max(one.contents.last, after) + 1, "kind": kind} | dict(content))
        line = _lines([row])[row[0]]
        if line["kind"] == UNUSABLE:
            raise OSError(errno.EINVAL, f"the journal takes no such line: {line['why']}")
        write_reserved(folder, lambda: _insert(one, [row]))
        one.contents = Contents((*one.contents.lines, line))
    return words


def mend(folder: Path) -> str:
    """Write the database again if it is damaged, and renew the backup; what was done in words, or empty.

    Raises:
        OSError: the folder cannot be written.
    """
    with _locked(folder):
        one = _to_write(folder, is_checked=True)
        words = [_mend(folder, one)] if one.damage and one.contents.lines else []
        one = _current(folder)
        if one.contents.lines and one.backed_up != _backup_of(folder, one.contents):
            if is_damaged := bool(one.backup_damage) and os.path.lexists(folder / BACKUP):
                words.append(f"{BACKUP} was damaged ({one.backup_damage}), and is written again")
            _back_up(folder, one, is_damaged)
        return "; ".join(words)


def compact(folder: Path, choose: Callable[[Contents], tuple[Collection[int], Mapping[str, Any]] | None]) -> None:
    """Remove lines, and add a line that has their numbers, at once.

    Args:
        choose: numbers of the lines to remove, and the content of the new line; None: nothing is worth it. Other
            processes wait meanwhile.

    Raises:
        OSError: the database cannot be written; the journal has the same content as before.
    """
    with _locked(folder):
        one = _to_write(folder)
        if one.database is None or one.damage or (chosen := choose(one.contents)) is None:
            return
        numbers, content = chosen
        out = [(int(number),) * 2 for number in numbers]
        dropped = [list(pair) for pair in joined_ranges([*out, *one.contents._accepted])]
        line = {"number": one.contents.last + 1, "kind": COMPACTED} | dict(content) | {"dropped": dropped}
        write_reserved(folder, lambda: _insert(one, [_row(line)], numbers))
        kept = (line for line in one.contents.lines if line["number"] not in numbers)
        one.contents = Contents((*kept, line))


def _backup_of(folder: Path, contents: Contents) -> tuple[Any, ...]:
    """Value of _Open.backed_up for a backup with these lines."""
    return (_stamp(folder / BACKUP), contents.last, len(contents.lines))


def _insert(one: _Open, rows: Collection[Row], removed: Collection[int] = ()) -> None:
    """Add rows and remove others in one transaction.

    Raises:
        OSError: the disk is full, or does not take them.
    """
    database = one.database
    assert database is not None
    try:
        database.execute("BEGIN IMMEDIATE")
        database.executemany("DELETE FROM line WHERE number = ?", [(number,) for number in removed])
        database.executemany("INSERT INTO line VALUES (?, ?, ?, ?)", rows)
        database.execute("COMMIT")
    except sqlite3.Error as error:
        with suppress(sqlite3.Error):
            database.execute("ROLLBACK")
        raise _os_error(error) from error


def _os_error(error: sqlite3.Error) -> OSError:
    is_full = getattr(error, "sqlite_errorcode", 0) & 0xFF == sqlite3.SQLITE_FULL
    number = errno.ENOSPC if is_full else errno.EIO
    return OSError(number, os.strerror(number) if is_full else f"journal: {error}")


def _mend(folder: Path, one: _Open) -> str:
    """Write the database again with all known lines; what was done in words."""
    path, lines, part = folder / NAME, one.contents.lines, folder / f"{NAME}.part"
    write_reserved(folder, lambda: _create(part, lines))
    close(folder)
    missing = len(lines) - len(_checked(path)[1].keys() & {line["number"] for line in lines})
    for name in (NAME, f"{NAME}-wal"):
        if os.path.lexists(folder / name):
            set_aside(folder / name)
    (folder / f"{NAME}-shm").unlink(missing_ok=True)
    part.replace(path)
    sync_folder(folder)
    return f"{NAME} was damaged ({one.damage}): {missing} of {len(lines)} lines are refilled" if lines else ""


def _create(path: Path, lines: Iterable[Line]) -> None:
    """Write a new database.

    Raises:
        OSError: the disk does not take it.
    """
    path.unlink(missing_ok=True)
    try:
        with closing(sqlite3.connect(path, isolation_level=None)) as database:
            database.executescript(f"BEGIN; {SCHEMA}")
            database.executemany("INSERT INTO line VALUES (?, ?, ?, ?)", map(_row, lines))
            database.execute("COMMIT")
    except sqlite3.Error as error:
        path.unlink(missing_ok=True)
        raise _os_error(error) from error


def _back_up(folder: Path, one: _Open, is_damaged: bool) -> None:
    """Copy the database to the backup, whole or not at all."""
    path, database = folder / BACKUP, one.database
    part = path.with_name(f"{BACKUP}.part")
    assert database is not None

    def copy() -> None:
        part.unlink(missing_ok=True)
        try:
            with closing(sqlite3.connect(part)) as other:
                database.backup(other)
                other.execute("PRAGMA journal_mode = DELETE")
        except sqlite3.Error as error:
            part.unlink(missing_ok=True)
            raise _os_error(error) from error

    write_reserved(folder, copy)
    if is_damaged:
        set_aside(path)
    part.replace(path)
    sync_folder(folder)
    one.backed_up, one.backup_damage = _backup_of(folder, one.contents), ""


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the journal for writing. All writers wait: one of them may replace the database's file."""
    path = folder / LOCK
    while True:
        if os.path.lexists(path) and not (path.is_file() and not path.is_symlink() and os.access(path, os.W_OK)):
            set_aside(path)
        with _using, path.open("a") as file:
            lock(file.fileno())
            status = _stamp(path)
            if status is None or status[0] != os.fstat(file.fileno()).st_ino:
                continue  # removed meanwhile: another process may hold a newer one
            yield
            return
