"""pyarrow's file system for a bucket: where it is, and how long it may take."""

from __future__ import annotations

import os
from dataclasses import dataclass
from datetime import timedelta
from functools import cache
from typing import Any
from urllib.parse import parse_qsl, urlencode, urlsplit

from tauext.config import StoreConfig
from tauext.errors import ConfigError

OPTIONS = {
    "s3": ("endpoint_override", "region", "scheme"),
    "gs": ("endpoint_override", "scheme"),
    "abfs": ("blob_storage_authority", "dfs_storage_authority", "enable_tls"),
}
OPTIONS["abfss"] = OPTIONS["abfs"]
"""What the query of a URL may say: where the store is, and nothing secret."""


KEYS = ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN", "AWS_PROFILE")


@dataclass(frozen=True, order=True)
class Server:
    """Whom to ask for a bucket."""

    scheme: str
    bucket: str
    """As the URL has it; of abfs CONTAINER@ACCOUNT.dfs.core.windows.net."""
    query: str = ""

    @classmethod
    def of(cls, scheme: str, bucket: str, query: str, plain: str) -> Server:
        """Raises ConfigError where the query says something else than OPTIONS."""
        said = dict(parse_qsl(query))
        for name in said:
            if name not in OPTIONS[scheme]:
                raise ConfigError(f"{plain}: '{name}' in its query is unknown; known are {', '.join(OPTIONS[scheme])}")
        return cls(scheme, bucket, urlencode(said))

    @property
    def root(self) -> str:
        """The bucket or container as the file system calls it."""
        return self.bucket.partition("@")[0]

    @property
    def said(self) -> dict[str, str]:
        return dict(parse_qsl(self.query))

    @property
    def endpoint(self) -> tuple[str | None, str | None]:
        """HOST:PORT of S3 and how it is spoken to, from the query or the environment; None: Amazon's own."""
        given = self.said.get("endpoint_override")
        given = given or os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL")
        if not given:
            return None, self.said.get("scheme")
        url = urlsplit(given if "://" in given else f"{self.said.get('scheme', 'https')}://{given}")
        return url.netloc.rpartition("@")[2] + url.path.rstrip("/"), url.scheme

    @property
    def region(self) -> str | None:
        """Of S3, from the query or the environment."""
        return self.said.get("region") or os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION")

    @property
    def told(self) -> str:
        """Where it is, for people."""
        return (self.endpoint[0] if self.scheme == "s3" else None) or f"the store of {self.scheme}://{self.root}"


def file_system(server: Server) -> Any:
    """One a bucket, process and environment; nothing is asked yet."""
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
        keys: tells others of the environment apart; which they are the store's own library reads there.
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
        return fs.GcsFileSystem(retry_time_limit=again, **server.said)
    query = f"?{server.query}" if server.query else ""
    found, _ = fs.FileSystem.from_uri(f"{server.scheme}://{server.bucket}{query}")
    return found
