"""A journal: numbered, checked lines of JSON in two files, to which several processes append.

A line is on the disk twice before append() returns. Readers join both files, so that damage to one loses nothing, and
numbers without gaps show what is lost in both. It survives `kill -9`, a reboot and a full disk. compact() leaves out
lines that newer ones replace; a line names their numbers.
"""

from __future__ import annotations

import errno
import json
import os
import stat
import threading
from bisect import bisect_right
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from secrets import token_hex
from typing import Any
from zlib import crc32

from tauext.files.plain_file import FORMAT, expect_file, json_of
from tauext_commission.journal_lines import is_whole, why_unusable
from tauext_commission.synced_file import lock, set_aside, sync_folder, write_all, write_reserved, write_synced

NAME, COPY, LOCK = "journal.jsonl", "journal.copy.jsonl", ".journal.lock"
CHECK = b'{"crc32": "%08x", '
"""Begin of a line: checksum of the object that the rest of the line is, after its opening brace."""
REPAIR = "repair"
"""Kind of the line with which a person accepts that numbers are lost: `lost` holds their first and last."""
COMPACTED = "compacted"
"""Kind of the line that names lines that were left out on purpose: `dropped` holds first and last of each range."""
UNUSABLE = "unusable"
"""Kind of a line whose values break a rule of journal_lines.py: `why` holds the reason, its content is left out. It
counts as lost, as it may have been an answer."""
TAIL = 64
"""Bytes before the end of what was read, by which a grown file is distinguished from another one."""
Line = dict[str, Any]


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
class _Seen:
    """What was read of a folder's journal."""

    stamps: tuple[Any, ...]
    end: int
    tail: bytes
    contents: Contents
    is_even: bool
    """Whether both files had the same content."""


_seen: dict[Path, _Seen] = {}
_reading = threading.RLock()


def read(folder: Path) -> Contents:
    """The journal of a folder, from both files; without them, or where nothing in them is readable, empty."""
    with _reading:
        seen, stamps = _seen.get(folder), _stamps(folder)
        if seen is None or seen.stamps != stamps:
            seen = (seen and _grown(folder, seen, stamps)) or _whole(folder, seen, stamps)
            _seen[folder] = seen
        return seen.contents


def is_journal(folder: Path) -> bool:
    """Whether a journal, or what is left of one, lies in the folder."""
    return any((folder / name).is_file() for name in (NAME, COPY))


def _stamps(folder: Path) -> tuple[Any, ...]:
    return tuple(map(_stamp, (folder / NAME, folder / COPY)))


def _stamp(path: Path) -> tuple[int, int, int] | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns


def _grown(folder: Path, seen: _Seen, stamps: tuple[Any, ...]) -> _Seen | None:
    """What was read, with the lines that were appended since; None: the files are others than those."""
    (now, copy), before = stamps, seen.stamps[0]
    if not now or not before or now[0] != before[0] or now[1] < seen.end or (copy and copy[1] > now[1]):
        return None
    if any(a and b and a[1] == b[1] and a != b for a, b in zip(stamps, seen.stamps, strict=True)):
        return None  # written over in place
    try:
        expect_file(folder / NAME)
        with (folder / NAME).open("rb") as file:
            file.seek(seen.end - len(seen.tail))
            if file.read(len(seen.tail)) != seen.tail:
                return None
            added = file.read()
    except OSError:
        return None
    added = added[: added.rfind(b"\n") + 1]  # another process may be writing the rest
    fresh = [_parsed(line) for line in added.splitlines()]
    first = seen.contents.last
    if any(one is None or one["number"] != first + k for k, one in enumerate(fresh, 1)):
        return None
    contents = Contents((*seen.contents.lines, *filter(None, fresh))) if fresh else seen.contents
    return _Seen(stamps, seen.end + len(added), (seen.tail + added)[-TAIL:], contents, seen.is_even)


def _whole(folder: Path, seen: _Seen | None, stamps: tuple[Any, ...]) -> _Seen:
    """All lines of both files, and those that this process has read before from the same journal."""
    raw, copy = (_bytes(folder / name) for name in (NAME, COPY))
    lines = _lines(raw) if raw == copy else _joined(_lines(copy), _lines(raw))
    before = seen.contents.lines if seen else ()
    if before and before[0].get("journal") == lines.get(1, before[0]).get("journal"):
        lines = _joined({int(one["number"]): one for one in before}, lines) if _is_there(folder) else lines
    for first, last in dropped_ranges(lines[number] for number in sorted(lines)):
        for number in range(first, last + 1) if last - first < len(lines) else [n for n in lines if first <= n <= last]:
            lines.pop(number, None)  # the other file, or this process, still has it
    end = raw.rfind(b"\n") + 1
    contents = Contents(tuple(lines[number] for number in sorted(lines)))
    return _Seen(stamps, end, raw[max(0, end - TAIL) : end], contents, raw == copy)


def _is_there(folder: Path) -> bool:
    """Whether the folder is still one with other files: one that was removed has no journal any more."""
    try:
        return any(one.name not in (NAME, COPY, LOCK) for one in folder.iterdir())
    except OSError:
        return False


def _bytes(path: Path) -> bytes:
    """The content of a file; empty where it cannot be read."""
    with suppress(OSError):
        expect_file(path)
        with path.open("rb") as file:
            return bytes(file.read())
    return b""


def _lines(raw: bytes) -> dict[int, Line]:
    return {int(one["number"]): one for one in map(_parsed, raw.split(b"\n")) if one}


def _joined(lines: dict[int, Line], newer: dict[int, Line]) -> dict[int, Line]:
    """Lines of two origins: of each number the newer one, unless that alone cannot be used."""
    kept = {number for number, one in newer.items() if one.get("kind") == UNUSABLE and number in lines}
    return lines | {number: one for number, one in newer.items() if number not in kept}


def _parsed(line: bytes) -> Line | None:
    """The object of a line, or a line of kind UNUSABLE in its place; None: the line is damaged."""
    body = b"{" + line[len(CHECK % 0) :]
    if not line.startswith(CHECK % crc32(body)):
        return None
    with suppress(ValueError):
        one = json_of(body)
        if isinstance(one, dict) and is_whole(one.get("number"), least=1):
            why = why_unusable(one)
            return {"number": one["number"], "kind": UNUSABLE, "why": why} if why else one
    return None


def _line(content: Mapping[str, Any]) -> bytes:
    body = json.dumps(content, allow_nan=False).encode()
    return CHECK % crc32(body) + body[1:] + b"\n"


# --- Writing.


def append(folder: Path, kind: str, content: Mapping[str, Any], after: int = 0) -> str:
    """Append a line and wait until the disk holds it; what had to be refilled before, or empty.

    Args:
        after: a number that a line had, from elsewhere: it is not given twice.

    Raises:
        OSError: the line cannot be written; the journal is as before.
    """
    with _locked(folder):
        words = "" if is_even(folder) else _mend(folder)
        contents = read(folder)
        first = {} if contents.lines else {"format": FORMAT, "journal": token_hex(8)}
        line = _line({"number": max(contents.last, after) + 1, "kind": kind} | first | dict(content))
        if (found := _parsed(line[:-1])) is None or found["kind"] == UNUSABLE:  # it would not count
            why = "it has no number" if found is None else str(found["why"])
            raise OSError(errno.EINVAL, f"the journal takes no such line: {why}")
        write_reserved(folder, lambda: _add(folder / NAME, line))
        with suppress(OSError):  # the next append refills it
            write_reserved(folder, lambda: _add(folder / COPY, line))
        if first:
            sync_folder(folder)
    return words


def mend(folder: Path) -> str:
    """Refill each of the two files from the other one; what was done in words, or empty.

    Raises:
        OSError: the folder cannot be written.
    """
    with _locked(folder):
        return _mend(folder)


def compact(folder: Path, choose: Callable[[Contents], tuple[Collection[int], Mapping[str, Any]] | None]) -> None:
    """Leave lines out of both files, and add a line that names them.

    The files are replaced one after the other, each at once. A reader of an old and a new one ignores what is left out,
    so that a process may be killed in between.

    Args:
        choose: numbers of the lines to leave out, and the content of the new line; None: nothing is worth it. Other
            processes wait meanwhile.

    Raises:
        OSError: a file cannot be written; the journal has the same content as before.
    """
    with _locked(folder):
        if not is_even(folder) or not read(folder).lines or (chosen := choose(read(folder))) is None:
            return
        contents, (numbers, content) = read(folder), chosen
        kept = [one for one in contents.lines if one["number"] not in numbers]
        out = [(int(one["number"]),) * 2 for one in contents.lines if one["number"] in numbers]
        dropped = [list(one) for one in joined_ranges([*out, *contents._accepted])]
        kept.append({"number": contents.last + 1, "kind": COMPACTED} | dict(content) | {"dropped": dropped})
        text = b"".join(map(_line, kept))
        for path in _files(folder):
            write_synced(path, text.decode())
        _seen[folder] = _Seen(_stamps(folder), len(text), text[-TAIL:], Contents(tuple(kept)), True)


def is_even(folder: Path) -> bool:
    """Whether both files are as this process has read them, or have grown alike since."""
    read(folder)
    seen = _seen[folder]
    sizes = [status.st_size for status in map(_own_status, (folder / NAME, folder / COPY)) if status is not None]
    if not seen.is_even:
        return False
    return sizes == [seen.end] * 2 or (not seen.contents.lines and not any(map(os.path.lexists, _files(folder))))


def _files(folder: Path) -> tuple[Path, Path]:
    return folder / NAME, folder / COPY


def _own_status(path: Path) -> os.stat_result | None:
    """Status of a file that is no link and can be written."""
    with suppress(OSError):
        status = path.lstat()
        return status if stat.S_ISREG(status.st_mode) and os.access(path, os.R_OK | os.W_OK) else None
    return None


def _mend(folder: Path) -> str:
    _seen[folder] = _whole(folder, _seen.get(folder), _stamps(folder))
    contents = _seen[folder].contents
    text, words = b"".join(map(_line, contents.lines)), []
    for path in _files(folder):
        raw, is_file = _bytes(path), _own_status(path) is not None
        if (raw == text and is_file) or not (text or os.path.lexists(path)):
            continue
        missing = len(contents.lines) - len(_lines(raw))
        if is_file and raw.startswith(text) and b"\n" not in raw[len(text) :]:  # a process was killed while it wrote
            os.truncate(path, len(text))
            continue
        is_old = is_file and missing <= 1 and _is_superset(raw, contents)
        is_late = is_file and text.startswith(raw)
        if is_old:  # a process was killed in compact()
            write_synced(path, text.decode())
            continue
        if is_late:
            _add(path, text[len(raw) :])
        else:
            if os.path.lexists(path):
                set_aside(path)
            write_synced(path, text.decode())
        if not is_late or path.name == NAME or missing > 1:  # else a process was killed between the two files
            other = COPY if path.name == NAME else NAME
            words.append(
                f"{path.name} was damaged: {missing} of {len(contents.lines)} lines are refilled from {other}"
                if missing
                else f"{path.name} is written again without what cannot be used"
            )
    _seen[folder] = _Seen(_stamps(folder), len(text), text[-TAIL:], contents, True)
    return "; ".join(words)


def _is_superset(raw: bytes, contents: Contents) -> bool:
    """Whether a whole file has all lines but the newest, and others that were left out since."""
    own = {int(one["number"]) for one in contents.lines[:-1]}
    return raw.count(b"\n") == len(_lines(raw)) and own < _lines(raw).keys()


def _add(path: Path, line: bytes) -> None:
    file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
    try:
        end = os.lseek(file, 0, os.SEEK_END)
        try:
            write_all(file, line)
            os.fsync(file)
        except OSError:
            os.ftruncate(file, end)
            raise
    finally:
        os.close(file)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    path = folder / LOCK
    while True:
        if os.path.lexists(path) and _own_status(path) is None:
            set_aside(path)
        with _reading, path.open("a") as file:
            lock(file.fileno())
            status = _own_status(path)
            if status is None or status.st_ino != os.fstat(file.fileno()).st_ino:
                continue  # removed meanwhile: another process may hold a newer one
            yield
            return
