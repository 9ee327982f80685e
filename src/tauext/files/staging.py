"""What is written to a store: on this machine until it is whole, then sent.

A file is one PUT, or an upload in parts that the store puts together at the end: nobody sees half of it. A folder is
sent file by file, the ones that say that it is whole at last; a store renames no folder.
"""

from __future__ import annotations

import hashlib
import shutil
import threading
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tauext.errors import TauextError
from tauext.files.answers import answers
from tauext.files.caching import cache_folder
from tauext.files.file_systems import file_system
from tauext.files.place import Place
from tauext.files.stored import StoredPlace

BLOCK = 8 << 20
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
    parent = f"{place.parent.url} {place.server.told}"  # one name at two servers is two places
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
    """By which files of a folder are to appear: those of LAST at last."""
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
