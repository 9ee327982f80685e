"""Files of stores: reading by ranges, local copies, what is sent, and the cache folder."""

from __future__ import annotations

import atexit
import glob
import hashlib
import os
import shutil
import tempfile
import threading
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, overload

from tauext.errors import StoreError, TauextError
from tauext.files.places import Place, StoredPlace, answers, file_system, named_files

# --- Reading a file by ranges, the same one from the first byte to the last.


@contextmanager
def reading(place: Place) -> Iterator[Any]:
    """The argument from which libraries read a place: the path, or a stored file, whose requested ranges alone are
    sent.

    A connection that is lost is tried again. A range that comes short is an error.

    Raises:
        FileNotFoundError: there is no such file.
        StoreError: the store cannot be reached, refuses or stalls, or the file was replaced while it was read.
    """
    if not isinstance(place, StoredPlace):
        yield place
        return
    with answers(place), place.open() as file:
        before = version(file)
        yield file
        with place.open() as again:
            if version(again) != before:
                raise StoreError(f"{place}: it was replaced while it was read; begin again")


def version_of(place: Place) -> str:
    """Something that differs when the content does: ETag and size where a store has them, else size and time."""
    if not isinstance(place, StoredPlace):
        status = place.stat()
        return f"{status.st_size} {status.st_mtime_ns}"
    with answers(place), place.open() as file:
        return version(file)


def version(file: Any) -> str:
    """Version of an open file: the store's mark of its content, or else its time of change, and its size."""
    facts = {key.lower(): value for key, value in (file.metadata() or {}).items()}
    mark = facts.get("etag") or facts.get("last-modified") or b""
    return f"{mark.decode(errors='replace') if isinstance(mark, bytes) else mark} {file.size()}"


# --- Copies on this machine of what cannot be read by ranges: bundles, robot files, bags.


BLOCK = 8 << 20
COPIES: dict[StoredPlace, tuple[str, Path]] = {}
"""Version and path of every file that this process fetched."""


@overload
def local_file(place: Place) -> Path: ...
@overload
def local_file(place: None) -> None: ...


def local_file(place: Place | None) -> Path | None:
    """A path of this file: itself, or a copy of the same name that goes when the process ends. None stays None.

    A place where nothing is, or a folder, gives a path where nothing is.

    Raises:
        StoreError: the store cannot be reached, refuses or stalls; no disk is left.
    """
    if not isinstance(place, StoredPlace):
        return place
    try:
        there = version_of(place)
    except FileNotFoundError:
        return all_copies(os.getpid()) / "nothing" / place.name
    kept = COPIES.get(place)
    if kept is None or kept[0] != there:
        path = copy_of(place)
        fetch(place, path)
        COPIES[place] = kept = (there, path)
    return kept[1]


def local_folder(place: Place) -> Path:
    """A path of this folder with all of its content, or of this file, as local_file.

    Raises:
        StoreError: as local_file.
    """
    if not isinstance(place, StoredPlace):
        return place
    files = [found for found in place.rglob("*") if found.is_file()]
    if not files:
        return local_file(place)
    folder = copy_of(place)
    expect_disk(place, folder, sum(file.stat().st_size for file in files))
    for file in files:
        path = folder / file.relative_to(place)
        path.parent.mkdir(parents=True, exist_ok=True)
        fetch(file, path)
    return folder


def local_beside(place: Place) -> Path:
    """A path of this file, with all files beside it whose names begin alike: NAME.run.json of NAME.tauext."""
    if not isinstance(place, StoredPlace):
        return place
    for file in place.parent.glob(f"{glob.escape(place.stem)}.*"):
        local_file(file)
    return local_file(place)


def local_robot(place: Place) -> Path:
    """A path of this robot file; of a store, what it names is copied, too, and lies to it as it does there."""
    if not isinstance(place, StoredPlace):
        return place
    for file in named_files(place):
        local_file(file)
    return local_file(place)


def fetch(place: StoredPlace, path: Path) -> None:
    """The whole file, to this path; under a temporary name first."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    with reading(place) as file, part.open("wb") as out:
        while block := file.read(BLOCK):
            out.write(block)
    changed_ns = place.stat().st_mtime_ns
    os.utime(part, ns=(changed_ns, changed_ns))  # the newest of a folder is so here, too
    os.replace(part, path)


def expect_disk(place: StoredPlace, folder: Path, size: int) -> None:
    """Raise StoreError where a copy of so many bytes does not fit."""
    free = shutil.disk_usage(all_copies(os.getpid())).free
    if free < size:
        raise StoreError(
            f"{place}: its copy needs {size / 1e9:.3g} GB, and {free / 1e9:.3g} GB are free in {folder.parent}; set "
            "TMPDIR to a folder with more"
        )


def copy_of(place: StoredPlace) -> Path:
    """Where its copy is: files of a bucket lie to one another as they do there."""
    return all_copies(os.getpid()) / f"{abs(hash(place.server)):x}" / place.key


@cache
def all_copies(process: int) -> Path:
    """A temporary folder of this process."""
    folder = Path(tempfile.mkdtemp(prefix="tauext-"))

    def clear() -> None:
        if os.getpid() == process:
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(clear)
    return folder


# --- Where things are kept that can be made again.


def cache_folder() -> Path:
    """$XDG_CACHE_HOME/tauext, or ~/.cache/tauext; it may not be there yet."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base and Path(base).is_absolute() else Path.home() / ".cache") / "tauext"


# --- What is written to a store: on this machine until it is whole, then sent.
#
# A file is one PUT, or an upload in parts that the store puts together at the end: half a file is never visible. A
# folder is sent file by file, those that mark it as whole last; a store renames no folder.


LAST = ("fleet.html", "task.json", "results.json", "report.html", "split.json", "run.json", "check.json")
"""Names of files by which a folder is known to be whole; the first of these comes last."""


def written_as(place: Place) -> Path:
    """The name to write under: NAME.part beside a path, in the staging folder for a store. Folders of it are made."""
    if not isinstance(place, StoredPlace):
        return place.with_name(place.name + ".part") if place.name else place / ".part"
    part = at_home(place)
    return part.with_name(part.name + ".part")


def put(part: Path, place: Place) -> None:
    """Give a file that is complete its name: renamed, or sent and removed here.

    Raises:
        OSError: it cannot be renamed.
        StoreError: it cannot be sent.
    """
    if not isinstance(place, StoredPlace):
        part.replace(place)
        return
    send(part, place)
    part.unlink()


def at_home(place: Place) -> Path:
    """Where on this machine work on this place is kept until it is done: the same for the same URL."""
    if not isinstance(place, StoredPlace):
        return place
    parent = f"{place.parent.url} {place.server.location}"  # one name at two servers is two places
    url = hashlib.sha256(parent.encode()).hexdigest()[:16]
    folder = cache_folder() / "staged" / url
    folder.mkdir(parents=True, exist_ok=True)
    return folder / place.name


@contextmanager
def staged(place: Place, fresh: bool = False) -> Iterator[Path]:
    """A folder to write results into: itself, or one here that is sent when the work ends without an error.

    What a killed command has written stays here, and the same command goes on with it. Errors name the place itself.

    Args:
        fresh: what is left of an earlier command is removed.
    """
    if not isinstance(place, StoredPlace):
        yield place
        return
    place.expect_bucket()
    folder = at_home(place)
    if fresh:
        shutil.rmtree(folder, ignore_errors=True)
    try:
        yield folder
    except TauextError as error:
        error.args = tuple(str(one).replace(str(folder), str(place)) for one in error.args)
        raise
    send_folder(folder, place)
    shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def added(place: Place) -> Iterator[Path]:
    """A folder to add files to, whose names must be new: itself, or one here that is sent however the work ends.

    For names that the store's folder has already there is an empty file here.
    """
    if not isinstance(place, StoredPlace):
        yield place
        return
    folder = at_home(place)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    taken = {one.name for one in place.iterdir()}
    for name in taken:
        (folder / name).touch()
    try:
        yield folder
    finally:
        send_folder(folder, place, taken)
        shutil.rmtree(folder, ignore_errors=True)


def send_folder(folder: Path, place: StoredPlace, but: Collection[str] = ()) -> None:
    """All files in it, those of LAST at last; a file of the same name is replaced, others stay.

    Args:
        but: names of files that are left out.
    """
    files = [path.relative_to(folder) for path in folder.rglob("*") if path.is_file() and path.name not in but]
    for file in sorted(files, key=in_order):
        send(folder / file, place / file.as_posix())


def in_order(file: Path) -> tuple[int, str]:
    """Sort key of the order in which a folder's files appear: those of LAST come last."""
    return -LAST.index(file.name) if file.name in LAST else -len(LAST), str(file)


def send(path: Path, place: StoredPlace) -> None:
    """One file; it appears whole or not at all, also where a Ctrl-C comes: a thread of its own ends what it began."""
    failed: list[BaseException] = []

    def work() -> None:
        try:
            upload(path, place)
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=work, name="send", daemon=True)
    thread.start()
    thread.join()
    if failed:
        raise failed[0]


def upload(path: Path, place: StoredPlace) -> None:
    """Block by block. A stream that is closed is a whole file, whatever came before: what failed is deleted."""
    system = file_system(place.server)
    with answers(place), path.open("rb") as file:
        out = system.open_output_stream(place.path)
        try:
            while block := file.read(BLOCK):
                out.write(block)
        except BaseException:
            with suppress(OSError):
                out.close()
                system.delete_file(place.path)
            raise
        out.close()
