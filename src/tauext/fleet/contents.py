"""Digests of files by their content, each file read once: what did not change since is known by size and time."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

from tauext.errors import ConfigError
from tauext.files.place import Place, is_stored
from tauext.files.plain_file import expect_file, json_of, read_text
from tauext.files.provenance import write_json
from tauext.files.reading import version_of

AT_A_TIME = 4
"""Files that are read at a time: disks and networks have little more to give."""


def sha256_of(path: Place) -> str:
    """Of a file's bytes, hexadecimal."""
    expect_file(path)
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


class Contents:
    """SHA-256 of files, remembered between runs by path, size and time of the last change."""

    def __init__(self, memory: Place):
        """memory: file of what is remembered; a damaged one is none."""
        self._memory = memory
        self._known: dict[str, list] = {}
        try:
            known = json_of(read_text(memory))
            self._known = {path: entry for path, entry in known.items() if len(entry) == 3}
        except (OSError, ValueError, TypeError, AttributeError):
            pass

    def read(self, files: Iterable[Place], show: Callable[[int, int], object]) -> None:
        """Read those that nobody knows, some at a time; show is called with how many are read, and of how many."""
        each = dict.fromkeys(files)
        pool = ThreadPoolExecutor(AT_A_TIME)
        try:
            for done, _ in enumerate(pool.map(self.digest, each), 1):
                show(done, len(each))
        finally:
            pool.shutdown(cancel_futures=True)  # a Ctrl-C waits for the files that are being read, and for no other

    def digest(self, path: Place) -> str:
        """Of one file; of a stored one, what the store marks its content by.

        Raises:
            ConfigError: it cannot be read.
        """
        try:
            if is_stored(path):
                return version_of(path)
            status = path.stat()
            size, time_ns, digest = self._known.get(str(path), (None, None, ""))
            if (size, time_ns) != (status.st_size, status.st_mtime_ns):
                digest = sha256_of(path)
                self._known[str(path)] = [status.st_size, status.st_mtime_ns, digest]
        except OSError as error:
            raise ConfigError(f"{path}: cannot be read ({error.strerror or error})") from error
        return str(digest)

    def keep(self) -> None:
        """For the next run."""
        write_json(dict(sorted(self._known.items())), self._memory)


def digest_of(content: object) -> str:
    """SHA-256 of something as JSON; the order of keys does not matter."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
