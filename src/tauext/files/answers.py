"""What a store's own words mean, in one line: which URL, what happened, how often it was tried, what to do."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tauext.config import StoreConfig
from tauext.errors import StoreError

TRANSPORT = ("AWS Error", "curlCode", "google::cloud", "Azure", "HTTP status")
"""In the words of an error of the store, and not of what a file holds."""
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
"""Letters of words that are not known."""


@contextmanager
def answers(place: Any) -> Iterator[None]:
    """Raise what the store says about this place as StoreError; what is only not there stays FileNotFoundError.

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
    """Whether it is of the way to the store."""
    return any(sign in str(error) for sign in TRANSPORT)


def meaning(place: Any, said: str) -> StoreError:
    """The one line."""
    limits, told = StoreConfig.of_environment(), place.server.told
    if "NO_SUCH_BUCKET" in said or "NoSuchBucket" in said:
        return no_bucket(place)
    if any(sign in said.lower().replace("_", "") for sign in REFUSED):
        return StoreError(
            f"{place}: access is denied by {told}; check the keys in the environment, and what they may do"
        )
    tried = f"tried {limits.tries} times"
    if "curlCode: 28" in said:
        return StoreError(
            f"{place}: {told} stalled, {tried}: nothing came for {limits.stall_s:g} s, or no connection within "
            f"{limits.connect_s:g} s; check the network, or set TAUEXT_STORE_STALL_S to wait longer"
        )
    if "curlCode: 6," in said or "curlCode: 7," in said:
        return StoreError(f"{place}: {told} cannot be reached, {tried}; check the endpoint and the network")
    if any(sign in said for sign in LOST):
        return StoreError(f"{place}: the connection to {told} was lost, {tried}; the same command again goes on")
    if "HTTP status 5" in said or "SLOW_DOWN" in said or "SERVICE_UNAVAILABLE" in said or "INTERNAL_FAILURE" in said:
        return StoreError(f"{place}: {told} is overloaded or failed, {tried}; the same command later goes on")
    line = " ".join(said.split())
    return StoreError(f"{place}: {told} could not do it ({line[:LONGEST]}); check the URL")


def no_bucket(place: Any) -> StoreError:
    """There is no such bucket."""
    return StoreError(
        f"{place}: there is no bucket '{place.server.root}' at {place.server.told}; make it, or mend the URL"
    )
