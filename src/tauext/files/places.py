"""Places of files: paths, or URLs of an object store that behave like paths."""

from __future__ import annotations

import errno
import os
import posixpath
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import timedelta
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import parse_qsl, unquote, urlencode, urlsplit

from tauext.config import StoreConfig
from tauext.errors import ConfigError, StoreError

# --- Errors of a store in one line: which URL, what happened, how often it was tried, what to do.


TRANSPORT = ("AWS Error", "curlCode", "google::cloud", "Azure", "HTTP status")
"""Texts that occur in errors of the store, and not in errors of a file's content."""
REFUSED = (
    "accessdenied",
    "invalidaccesskeyid",
    "signaturedoesnotmatch",
    "invalidclienttokenid",
    "unrecognizedclient",
    "expiredtoken",
    "http status 401",
    "http status 403",
    "permissiondenied",
    "unauthenticated",
    "authenticationfailed",
    "authorizationfailure",
)
"""In lower case and without underscores: servers spell them in several ways."""
LOST = ("curlCode: 18", "curlCode: 52", "curlCode: 55", "curlCode: 56", "curlCode: 35")
LONGEST = 200
"""Letters that are kept of an unknown error's text."""


@contextmanager
def answers(place: Any) -> Iterator[None]:
    """Raise errors of the store at this place as StoreError; a missing file stays FileNotFoundError.

    Errors that are none of the store's, a damaged file's for example, pass. So does everything of a path.
    """
    try:
        yield
    except FileNotFoundError as error:
        raise FileNotFoundError(2, "No such file or directory", str(place)) from error
    except OSError as error:
        if not hasattr(place, "server") or not is_transport(error):
            raise
        raise meaning(place, str(error)) from error


def is_transport(error: BaseException) -> bool:
    """Whether the error is one of the connection to the store or of the store itself."""
    return any(sign in str(error) for sign in TRANSPORT)


def meaning(place: Any, message: str) -> StoreError:
    """The error in one line: the URL, what happened, how often it was tried, what to do."""
    limits, where = StoreConfig.of_environment(), place.server.location
    if "NO_SUCH_BUCKET" in message or "NoSuchBucket" in message:
        return no_bucket(place)
    if any(sign in message.lower().replace("_", "") for sign in REFUSED):
        return StoreError(
            f"{place}: access is denied by {where}; check the keys in the environment, and what they may do"
        )
    tried = f"tried {limits.tries} times"
    if "curlCode: 28" in message:
        return StoreError(
            f"{place}: {where} stalled, {tried}: nothing came for {limits.stall_s:g} s, or no connection within "
            f"{limits.connect_s:g} s; check the network, or set TAUEXT_STORE_STALL_S to wait longer"
        )
    if "curlCode: 6," in message or "curlCode: 7," in message:
        return StoreError(f"{place}: {where} cannot be reached, {tried}; check the endpoint and the network")
    if any(sign in message for sign in LOST):
        return StoreError(f"{place}: the connection to {where} was lost, {tried}; the same command again goes on")
    if (
        "HTTP status 5" in message
        or "SLOW_DOWN" in message
        or "SERVICE_UNAVAILABLE" in message
        or "INTERNAL_FAILURE" in message
    ):
        return StoreError(f"{place}: {where} is overloaded or failed, {tried}; the same command later goes on")
    line = " ".join(message.split())
    return StoreError(f"{place}: {where} could not do it ({line[:LONGEST]}); check the URL")


def no_bucket(place: Any) -> StoreError:
    """There is no such bucket."""
    return StoreError(
        f"{place}: there is no bucket '{place.server.root}' at {place.server.location}; make it, or correct the URL"
    )


# --- pyarrow's file system for a bucket: where it is, and how long it may take.


OPTIONS = {
    "s3": ("endpoint_override", "region", "scheme"),
    "gs": ("endpoint_override", "scheme"),
    "abfs": ("blob_storage_authority", "dfs_storage_authority", "enable_tls"),
}
OPTIONS["abfss"] = OPTIONS["abfs"]
"""Keys that the query of a URL may hold: they locate the store; none is secret."""


KEYS = ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN", "AWS_PROFILE")


@dataclass(frozen=True, order=True)
class Server:
    """A bucket and the store that holds it."""

    scheme: str
    bucket: str
    """Bucket as in the URL; for abfs CONTAINER@ACCOUNT.dfs.core.windows.net."""
    query: str = ""

    @classmethod
    def of(cls, scheme: str, bucket: str, query: str, plain: str) -> Server:
        """Raises ConfigError where the query has other keys than OPTIONS."""
        options = dict(parse_qsl(query))
        for name in options:
            if name not in OPTIONS[scheme]:
                raise ConfigError(f"{plain}: '{name}' in its query is unknown; known are {', '.join(OPTIONS[scheme])}")
        return cls(scheme, bucket, urlencode(options))

    @property
    def root(self) -> str:
        """Name of the bucket or container in the file system."""
        return self.bucket.partition("@")[0]

    @property
    def options(self) -> dict[str, str]:
        return dict(parse_qsl(self.query))

    @property
    def endpoint(self) -> tuple[str | None, str | None]:
        """HOST:PORT and scheme of S3, from the query or the environment; None: Amazon's own."""
        given = self.options.get("endpoint_override")
        given = given or os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL")
        if not given:
            return None, self.options.get("scheme")
        url = urlsplit(given if "://" in given else f"{self.options.get('scheme', 'https')}://{given}")
        return url.netloc.rpartition("@")[2] + url.path.rstrip("/"), url.scheme

    @property
    def region(self) -> str | None:
        """Region of S3, from the query or the environment."""
        return self.options.get("region") or os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION")

    @property
    def location(self) -> str:
        """Address of the store for messages."""
        return (self.endpoint[0] if self.scheme == "s3" else None) or f"the store of {self.scheme}://{self.root}"


def file_system(server: Server) -> Any:
    """The file system, one for each bucket, process and environment; sends nothing yet."""
    keys = hash(tuple(os.environ.get(name) for name in KEYS))
    return made(server, server.endpoint, server.region, keys, StoreConfig.of_environment())


@cache
def made(
    server: Server,
    endpoint: tuple[str | None, str | None],
    region: str | None,
    keys: int,
    limits: StoreConfig,
) -> Any:
    """The file system.

    Args:
        keys: hash of the environment's keys, so that other keys give another file system; the store's library
            reads the keys themselves.
    """
    from pyarrow import fs

    if server.scheme == "s3":
        host, scheme = endpoint
        return fs.S3FileSystem(
            endpoint_override=host,
            scheme=scheme,
            region=region or (None if host is None else "us-east-1"),
            connect_timeout=limits.connect_s,
            request_timeout=limits.stall_s,
            retry_strategy=fs.AwsStandardS3RetryStrategy(max_attempts=limits.tries),
            allow_delayed_open=True,  # a small file is one PUT then
        )
    if server.scheme == "gs":
        again = timedelta(seconds=max(1, round(limits.tries * limits.stall_s)))
        return fs.GcsFileSystem(retry_time_limit=again, **server.options)
    query = f"?{server.query}" if server.query else ""
    found, _ = fs.FileSystem.from_uri(f"{server.scheme}://{server.bucket}{query}")
    return found


# --- A file or folder in an object store, with the methods of a path; pyarrow's file systems do the work on demand.


SCHEMES = ("s3", "gs", "abfs", "abfss")


@dataclass(frozen=True, order=True)
class StoredPlace:
    """A URL. A folder is a common beginning of the store's keys: it needs no mkdir, and an empty folder does not exist.

    As text it is the URL without its query, so that messages and provenance hold no more than where something lies.
    """

    server: Server
    key: str
    """Below the bucket, without slashes at its ends; "" is the bucket itself."""
    found: Any = field(default=None, compare=False, repr=False)
    """FileInfo from a listing, which is not requested again; None: unknown."""

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
                f"{plain}: a URL appears in messages and files, so it must hold no key; the store's usual environment "
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
        """The URL with the query that locates the store, for another process."""
        return str(self) + (f"?{self.server.query}" if self.server.query else "")

    @property
    def path(self) -> str:
        """Path in the file system."""
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
        """The file, to read by ranges; later failures raise pyarrow's own errors, see `answers`.

        Raises:
            FileNotFoundError: there is none.
        """
        assert mode == "rb", "written files pass through atomic_write"
        with answers(self):
            return file_system(self.server).open_input_file(self.path)

    def read_bytes(self) -> bytes:
        with answers(self), self.open() as file:
            return bytes(file.read())

    def iterdir(self) -> Iterator[StoredPlace]:
        """The entries of the folder, by name; none where there is no such folder."""
        yield from self._list(recursive=False)

    def glob(self, pattern: str) -> Iterator[StoredPlace]:
        """The entries whose name fits the pattern; `**/PATTERN` searches folders, too."""
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
        """Raise StoreError unless the bucket exists and can be reached."""
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
    """Raise StoreError where there is no such bucket; otherwise only the file in it would be reported as missing."""
    if place.server in KNOWN_BUCKETS:
        return
    (info,) = file_system(place.server).get_file_info([place.server.root])
    if not info.type:
        raise no_bucket(place)
    KNOWN_BUCKETS.add(place.server)


def clean(key: str) -> str:
    """Without `.`, `..`, and slashes at its ends or twice."""
    return posixpath.normpath(f"/{key}").lstrip("/")


# --- A place of a file or folder, as a person writes it.


Place = Path | StoredPlace
"""Both have the methods of a path: name, parent, /, is_file(), open("rb"), ..."""
URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://")


def place_of(text: Place | str, base: Place | None = None) -> Place:
    """The place of this name: s3://, gs://, abfs:// and abfss:// are stores, file:// and all else are paths.

    Args:
        base: what a relative path counts from; None: the working directory.

    Raises:
        ConfigError: a URL of another scheme, without a bucket, or with a secret in it.
    """
    if not isinstance(text, str):
        return text
    found = URL.match(text)
    if found is None:
        return Path(text) if base is None else base / text
    scheme = found[1].lower()
    if scheme == "file":
        host, slash, path = text[found.end() :].partition("/")
        if host not in ("", "localhost") or not slash:
            raise ConfigError(f"{text}: a file URL of this machine begins with file:///")
        return Path("/" + unquote(path))
    if scheme not in SCHEMES:
        known = ", ".join(f"{name}://" for name in (*SCHEMES, "file"))
        raise ConfigError(f"{scheme}://...: no such store is known; a place is a path, or a URL of {known}")
    return StoredPlace.of_url(text)


def same_place(one: Place, other: Place) -> bool:
    """Whether both are the same file, which is there."""
    if isinstance(one, Path) and isinstance(other, Path):
        return one.exists() and other.exists() and one.samefile(other)
    return one == other


def is_stored(place: Place) -> bool:
    """Whether it lies in an object store."""
    return isinstance(place, StoredPlace)


# --- Files that a robot file names: meshes and includes, which MuJoCo reads masses off.


NAMED_FILE = re.compile(r"""\b(?:file|filename)\s*=\s*["']([^"']+)["']""")
NAMED_FOLDER = re.compile(r"""\b(?:meshdir|assetdir)\s*=\s*["']([^"']+)["']""")
SHAPES_FILE = "robot.shapes.json"
"""Beside the robot file of a dataset: shapes of its links."""
ROBOT_SUFFIXES = (".xml", ".urdf", ".mjcf")


def named_files(robot: Place) -> Iterator[Place]:
    """The robot file itself, its shapes, and what it names and is there, and what that names, each once."""
    shapes = robot.with_name(SHAPES_FILE)
    waiting: list[Place] = [robot, *([shapes] if shapes.is_file() else [])]
    seen: set[Place] = set(waiting)
    while waiting:
        file: Place = waiting.pop()
        yield file
        text: str = file.read_bytes().decode("utf-8", "replace") if file.suffix.lower() in ROBOT_SUFFIXES else ""
        folders = [file.parent, *(file.parent / name for name in NAMED_FOLDER.findall(text))]
        named = [folder / name for name in NAMED_FILE.findall(text) for folder in folders]
        found = [place for place in dict.fromkeys(named) if place not in seen and place.is_file()]
        seen.update(found)
        waiting += reversed(found)
