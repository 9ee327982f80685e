"""Files and folders in object stores; pyarrow's file systems do the work."""

from __future__ import annotations

import os
import posixpath
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from functools import cache
from io import BytesIO
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO
from urllib.parse import parse_qsl, urlencode

from tauext.errors import ConfigError, TauextError
from tauext_fleet.config import StoreConfig

# --- Errors of a store in one line: which URL, what happened, what to do.


TRANSPORT = ("AWS Error", "curlCode", "google::cloud", "Azure", "HTTP status")
"""Texts that occur in errors of a store, and not in errors of this machine's files."""
MEANINGS = (
    ("nosuchbucket", "there is no such bucket; make it, or correct the URL"),
    (
        "accessdenied invalidaccesskeyid signaturedoesnotmatch invalidclienttokenid unrecognizedclient expiredtoken "
        "status401 status403 permissiondenied unauthenticated authenticationfailed authorizationfailure",
        "access is denied; check the keys in the environment, and what they may do",
    ),
    ("curlcode:28,", "the store stalls; check the network, or set TAUEXT_STORE_STALL_S to wait longer"),
    ("curlcode:6, curlcode:7,", "the store cannot be reached; check the endpoint and the network"),
    (
        "curlcode:18, curlcode:35, curlcode:52, curlcode:55, curlcode:56,",
        "the connection was lost; the same command again goes on",
    ),
    (
        "status5 slowdown serviceunavailable internalfailure",
        "the store is overloaded or failed; the same command later goes on",
    ),
)
"""Texts in an error, without blanks and underscores, which servers spell in several ways; and what they mean."""
LONGEST = 200
"""Letters that are kept of an unknown error's text."""


class StoreError(TauextError):
    """An object store that cannot be reached, refuses, stalls, or whose file changed while it was read."""


@contextmanager
def answers(url: object) -> Iterator[None]:
    """Raise errors of the store as StoreError; a missing file stays FileNotFoundError."""
    try:
        yield
    except FileNotFoundError as error:
        raise FileNotFoundError(2, "No such file or directory", str(url)) from error
    except OSError as error:
        if not any(sign in str(error) for sign in TRANSPORT):
            raise
        text = "".join(str(error).lower().replace("_", "").split())
        known = (words for signs, words in MEANINGS if any(sign in text for sign in signs.split()))
        unknown = f"the store failed ({' '.join(str(error).split())[:LONGEST]}); check the URL"
        raise StoreError(f"{url}: {next(known, unknown)}") from error


# --- The file system of a bucket.


SCHEMES = ("s3", "gs", "abfs", "abfss")
OPTIONS = ("endpoint_override", "region", "scheme", "blob_storage_authority", "dfs_storage_authority", "enable_tls")
"""Keys that the query of a URL may hold: they locate the store; none is secret."""


def endpoint_of(options: dict[str, str]) -> str | None:
    """Address of a server of S3, from the query or the environment; None: Amazon's own."""
    given = options.get("endpoint_override") or os.environ.get("AWS_ENDPOINT_URL_S3")
    return (given or os.environ.get("AWS_ENDPOINT_URL") or "").rstrip("/") or None


@cache
def file_system(bucket: str, query: str, endpoint: str | None, limits: StoreConfig) -> Any:
    """pyarrow's file system; sends nothing yet."""
    from pyarrow import fs

    options = dict(parse_qsl(query))
    if bucket.startswith("s3:"):
        region = options.get("region") or os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION")
        return fs.S3FileSystem(
            endpoint_override=endpoint,
            scheme=options.get("scheme"),
            region=region or (None if endpoint is None else "us-east-1"),
            connect_timeout=limits.connect_s,
            request_timeout=limits.stall_s,
            retry_strategy=fs.AwsStandardS3RetryStrategy(max_attempts=limits.tries),
            allow_delayed_open=True,  # a small file is one PUT then
        )
    if bucket.startswith("gs:"):
        again = timedelta(seconds=max(1, round(limits.tries * limits.stall_s)))
        return fs.GcsFileSystem(retry_time_limit=again, **options)
    return fs.FileSystem.from_uri(f"{bucket}?{query}" if query else bucket)[0]


# --- A file or folder.


BLOCK = 8 << 20


@dataclass(frozen=True, order=True)
class Stored:
    """A file or folder at a URL. A folder is a common beginning of the store's keys: an empty one does not exist.

    As text it is the URL without its query, so that messages and files hold no more than where something lies.
    """

    bucket: str
    """The place of the store in the URL: s3://BUCKET, abfs://CONTAINER@ACCOUNT.dfs.core.windows.net."""
    key: str
    """Below the bucket, without slashes at its ends; "" is the bucket itself."""
    query: str = ""

    @classmethod
    def of_url(cls, text: str) -> Stored:
        """Raises ConfigError of an unknown store, of a URL without a bucket, or with a secret in it."""
        scheme, _, rest = text.partition("://")
        scheme, (rest, _, query) = scheme.lower(), rest.partition("?")
        bucket, _, key = rest.partition("/")
        user, _, host = bucket.rpartition("@")
        plain = f"{scheme}://{host}/{key}"
        if scheme not in SCHEMES:
            known = ", ".join(f"{name}://" for name in SCHEMES)
            raise ConfigError(f"{scheme}://...: no such store is known; give a path, or a URL of {known}")
        if user and (scheme in ("s3", "gs") or ":" in user):
            raise ConfigError(
                f"{plain}: a URL appears in messages and files, so it must hold no key; the store's usual environment "
                "variables give it"
            )
        if not bucket:
            raise ConfigError(f"{plain}: it names no bucket; {scheme}://BUCKET/NAME does")
        options = dict(parse_qsl(query))
        if odd := [name for name in options if name not in OPTIONS]:
            raise ConfigError(f"{plain}: '{odd[0]}' in its query is unknown; known are {', '.join(OPTIONS)}")
        return cls(f"{scheme}://{bucket}", clean(key), urlencode(options))

    def __str__(self) -> str:
        return f"{self.bucket}/{self.key}"

    @property
    def url(self) -> str:
        """The URL with its query, for another process."""
        return f"{self}?{self.query}" if self.query else str(self)

    @property
    def endpoint(self) -> str | None:
        """Address of the server, where it is not the store's own."""
        return endpoint_of(dict(parse_qsl(self.query)))

    @property
    def system(self) -> Any:
        return file_system(self.bucket, self.query, self.endpoint, StoreConfig.of_environment())

    @property
    def root(self) -> str:
        """Name of the bucket or container in the file system."""
        return self.bucket.partition("://")[2].partition("@")[0]

    @property
    def path(self) -> str:
        """Path in the file system."""
        return posixpath.join(self.root, self.key)

    @property
    def name(self) -> str:
        return posixpath.basename(self.key) or self.root

    @property
    def suffix(self) -> str:
        return PurePosixPath(self.name).suffix

    @property
    def parent(self) -> Stored:
        return Stored(self.bucket, posixpath.dirname(self.key), self.query)

    def __truediv__(self, name: str) -> Stored:
        return Stored(self.bucket, clean(posixpath.join(self.key, name)), self.query)

    def with_name(self, name: str) -> Stored:
        return self.parent / name

    def exists(self) -> bool:
        """Raises StoreError, as everything below, where the store cannot be reached or refuses."""
        from pyarrow.fs import FileType

        return bool(self._info().type != FileType.NotFound)

    def is_file(self) -> bool:
        return bool(self._info().is_file)

    def _info(self) -> Any:
        with answers(self):
            (info,) = self.system.get_file_info([self.path])
        return info

    def files(self) -> dict[str, tuple[int, int]]:
        """Size [bytes] and time of the last change [ns] of all files of a folder, by their paths from there; of a file
        under ""."""
        from pyarrow.fs import FileSelector

        own = self._info()
        with answers(self):
            selector = FileSelector(self.path, allow_not_found=True, recursive=True)
            found = [own] if own.is_file else self.system.get_file_info(selector)
        below = len(self.path)
        return {one.path[below:].lstrip("/"): (one.size, one.mtime_ns) for one in found if one.is_file}

    def version(self) -> str:
        """Something that differs when the file's content does: ETag and size, or time of the last change and size."""
        with answers(self), self.system.open_input_file(self.path) as file:
            facts = {key.lower(): value for key, value in (file.metadata() or {}).items()}
            mark = facts.get("etag") or facts.get("last-modified") or b""
            return f"{mark.decode(errors='replace') if isinstance(mark, bytes) else mark} {file.size()}"

    def read_bytes(self) -> bytes:
        with answers(self), self.system.open_input_file(self.path) as file:
            return bytes(file.read())

    def download(self, path: Path) -> None:
        """Copy the file, or all files of the folder.

        Raises:
            FileNotFoundError: nothing is there.
            StoreError: a file was replaced meanwhile.
        """
        from pyarrow.fs import copy_files

        before = self.files()
        (path.parent if "" in before else path).mkdir(parents=True, exist_ok=True)
        with answers(self):
            copy_files(self.path, str(path), source_filesystem=self.system)
        if self.files() != before:
            raise StoreError(f"{self}: it was replaced while it was read; begin again")

    def write_bytes(self, content: bytes) -> None:
        self._write(BytesIO(content))

    def upload(self, path: Path) -> None:
        """Write this file, which appears whole or not at all."""
        with path.open("rb") as file:
            self._write(file)

    def _write(self, file: BinaryIO) -> None:
        """pyarrow's copy_files loses errors of a stream's end; and a closed stream is a file, so a failed one goes."""
        with answers(self):
            out = self.system.open_output_stream(self.path)
            try:
                shutil.copyfileobj(file, out, BLOCK)
            except BaseException:
                with suppress(OSError):
                    out.close()
                    self.system.delete_file(self.path)
                raise
            out.close()

    def unlink(self, missing_ok: bool = False) -> None:
        try:
            with answers(self):
                self.system.delete_file(self.path)
        except FileNotFoundError:
            if not missing_ok:
                raise


def clean(key: str) -> str:
    """Without `.`, `..`, and slashes at its ends or twice."""
    return posixpath.normpath(f"/{key}").lstrip("/")
