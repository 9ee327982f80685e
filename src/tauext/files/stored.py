"""A file or folder in an object store, asked as a path is: pyarrow's file systems do the work, once it is asked."""

from __future__ import annotations

import errno
import os
import posixpath
import stat
from collections.abc import Iterator
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import PurePosixPath
from typing import Any

from tauext.errors import ConfigError
from tauext.files.answers import answers, no_bucket
from tauext.files.file_systems import Server, file_system

SCHEMES = ("s3", "gs", "abfs", "abfss")


@dataclass(frozen=True, order=True)
class StoredPlace:
    """A URL. Folders are what the store's keys have in common: they need not be made, and an empty one is none.

    As text it is the URL without its query, so that messages and provenance hold no more than where something lies.
    """

    server: Server
    key: str
    """Below the bucket, without slashes at its ends; "" is the bucket itself."""
    found: Any = field(default=None, compare=False, repr=False)
    """What a listing said of it, which nobody asks for again."""

    @classmethod
    def of_url(cls, text: str) -> StoredPlace:
        """Raises ConfigError where there is no bucket, or a secret in it."""
        scheme, _, rest = text.partition("://")
        rest, _, query = rest.partition("?")
        bucket, _, key = rest.partition("/")
        plain = f"{scheme.lower()}://{bucket.rpartition('@')[2]}/{key}"
        user = bucket.rpartition("@")[0]
        if user and (scheme.lower() in ("s3", "gs") or ":" in user):
            raise ConfigError(
                f"{plain}: a URL stands in messages and files, so it must hold no key; the store's usual environment "
                "variables give it"
            )
        if not bucket:
            raise ConfigError(f"{plain}: it names no bucket; {scheme}://BUCKET/NAME does")
        return cls(Server.of(scheme.lower(), bucket, query, plain), clean(key))

    def __str__(self) -> str:
        return f"{self.server.scheme}://{self.server.bucket}/{self.key}"

    def __repr__(self) -> str:
        return f"StoredPlace({str(self)!r})"

    @property
    def url(self) -> str:
        """With the query that says where the store is, for another process."""
        return str(self) + (f"?{self.server.query}" if self.server.query else "")

    @property
    def path(self) -> str:
        """As the file system calls it."""
        return posixpath.join(self.server.root, self.key)

    @property
    def name(self) -> str:
        return posixpath.basename(self.key) or self.server.root

    @property
    def stem(self) -> str:
        return PurePosixPath(self.name).stem

    @property
    def suffix(self) -> str:
        return PurePosixPath(self.name).suffix

    @property
    def parts(self) -> tuple[str, ...]:
        return f"{self.server.scheme}://{self.server.bucket}", *PurePosixPath(self.key).parts

    @property
    def parent(self) -> StoredPlace:
        return StoredPlace(self.server, posixpath.dirname(self.key))

    def __truediv__(self, name: str | PurePosixPath) -> StoredPlace:
        return StoredPlace(self.server, clean(posixpath.join(self.key, str(name))))

    def with_name(self, name: str) -> StoredPlace:
        return self.parent / name

    def with_suffix(self, suffix: str) -> StoredPlace:
        return self.with_name(PurePosixPath(self.name).with_suffix(suffix).name)

    def relative_to(self, other: StoredPlace) -> PurePosixPath:
        return PurePosixPath(self.key).relative_to(other.key)

    def absolute(self) -> StoredPlace:
        return self

    def resolve(self) -> StoredPlace:
        return self

    def samefile(self, other: object) -> bool:
        return self == other

    def info(self) -> Any:
        """pyarrow's FileInfo; of nothing that is there, its type is NotFound.

        Raises:
            StoreError: the store or its bucket cannot be reached or refuses.
        """
        if self.found is not None:
            return self.found
        with answers(self):
            (info,) = file_system(self.server).get_file_info([self.path])
            if not info.type and self.key:
                expect_bucket(self)
        return info

    def is_file(self) -> bool:
        from pyarrow.fs import FileType

        return bool(self.info().type == FileType.File)

    def is_dir(self) -> bool:
        from pyarrow.fs import FileType

        return bool(self.info().type == FileType.Directory)

    def exists(self) -> bool:
        from pyarrow.fs import FileType

        return bool(self.info().type != FileType.NotFound)

    def stat(self) -> os.stat_result:
        """Mode, size and time of the last change, as of a path; all else is 0.

        Raises:
            FileNotFoundError: nothing is there.
        """
        info = self.info()
        if not info.type:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(self))
        mode, size, changed_ns = stat.S_IFDIR if info.size is None else stat.S_IFREG, info.size or 0, info.mtime_ns or 0
        whole, exact = changed_ns // 10**9, changed_ns * 1e-9
        return os.stat_result(
            (mode, 0, 0, 0, 0, 0, size, 0, whole, 0),
            {"st_atime": 0.0, "st_mtime": exact, "st_ctime": 0.0, "st_mtime_ns": changed_ns},
        )

    def open(self, mode: str = "rb") -> Any:
        """The file, to read by ranges; whatever fails later comes as pyarrow says it, see `answers`.

        Raises:
            FileNotFoundError: there is none.
        """
        assert mode == "rb", "what is written passes through whole_file"
        with answers(self):
            return file_system(self.server).open_input_file(self.path)

    def read_bytes(self) -> bytes:
        with answers(self), self.open() as file:
            return bytes(file.read())

    def iterdir(self) -> Iterator[StoredPlace]:
        """What lies in it, by name; nothing where there is no such folder."""
        yield from self._list(recursive=False)

    def glob(self, pattern: str) -> Iterator[StoredPlace]:
        """Of these the ones whose name the pattern fits; `**/PATTERN` looks into folders, too."""
        deep, pattern = pattern.startswith("**/"), pattern.removeprefix("**/")
        yield from (place for place in self._list(deep) if fnmatchcase(place.name, pattern))

    def rglob(self, pattern: str) -> Iterator[StoredPlace]:
        yield from self.glob(f"**/{pattern}")

    def _list(self, recursive: bool) -> list[StoredPlace]:
        from pyarrow.fs import FileSelector

        with answers(self):
            expect_bucket(self)
            selector = FileSelector(self.path, allow_not_found=True, recursive=recursive)
            found = file_system(self.server).get_file_info(selector)
        root = f"{self.server.root}/"
        places = (StoredPlace(self.server, clean(one.path.removeprefix(root)), one) for one in found)
        return sorted(place for place in places if place.key != self.key)

    def expect_bucket(self) -> None:
        """Raise StoreError unless the bucket is there and can be asked."""
        with answers(self):
            expect_bucket(self)

    def mkdir(self, parents: bool = False, exist_ok: bool = False) -> None:
        """Folders of a store are there with their first file."""

    def unlink(self, missing_ok: bool = False) -> None:
        try:
            with answers(self):
                file_system(self.server).delete_file(self.path)
        except FileNotFoundError:
            if not missing_ok:
                raise


KNOWN_BUCKETS: set[Server] = set()


def expect_bucket(place: StoredPlace) -> None:
    """Raise StoreError where there is no such bucket: else a file in it would only be said not to be there."""
    if place.server in KNOWN_BUCKETS:
        return
    (info,) = file_system(place.server).get_file_info([place.server.root])
    if not info.type:
        raise no_bucket(place)
    KNOWN_BUCKETS.add(place.server)


def clean(key: str) -> str:
    """Without `.`, `..`, and slashes at its ends or twice."""
    return posixpath.normpath(f"/{key}").lstrip("/")
