"""Who may talk to the page's server: browsers that show this page, and nobody whom another page sent."""

from __future__ import annotations

import asyncio
import http
import importlib
import ipaddress
import logging
import socket
from collections.abc import Callable
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator

LOOPBACK = ("localhost", "127.0.0.1", "::1")


def is_own_name(name: str, host: str) -> bool:
    """Whether a browser that shows this page may call the server so.

    A page of another host may give its own name this machine's address and then pass for the server (DNS rebinding), so
    a name counts where nobody else can take it: loopback, an address in figures, what this machine calls itself.

    Args:
        host: address that the server listens on.
    """
    name = name.strip("[]").lower()
    if name in LOOPBACK or host in LOOPBACK:
        return name in LOOPBACK
    own = socket.gethostname().lower()
    if name in (host.lower(), own, f"{own}.local", socket.getfqdn().lower()):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def why_not(headers: Any, host: str, protocol: str) -> str:
    """Why a request is turned away; empty: it is not.

    Args:
        headers: of the request.
        host: address that the server listens on.
        protocol: that the page's own script speaks.
    """
    called = headers.get("Host", "")
    if not is_own_name(called.rpartition(":")[0] if not called.endswith("]") and ":" in called else called, host):
        return "this server has another name"
    if headers.get("Upgrade", "").lower() != "websocket":
        return ""
    if headers.get("Origin", "") != f"http://{called}":
        return "only its own page may talk to this server"
    if protocol not in (word.strip() for word in headers.get("Sec-WebSocket-Protocol", "").split(",")):
        return "this is no client of this version"
    return ""


@contextmanager
def guarded(host: str, protocol: str) -> Iterator[None]:
    """Servers that are started within check who comes, and drop whoever sends what cannot be understood.

    viser has no place for a check of its own; it starts its server by the function that is replaced here meanwhile.
    """
    library: Any = importlib.import_module("websockets.asyncio.server")

    serve: Callable[..., Any] = library.serve

    def serve_guarded(handler: Callable[..., Any], *arguments: Any, process_request: Any, **options: Any) -> Any:
        def checked(connection: Any, request: Any) -> Any:
            try:
                reason = why_not(request.headers, host, protocol)
            except LookupError:  # a header that stands twice
                reason = "a header stands twice"
            if reason:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"{reason}\n")
            return process_request(connection, request) if process_request is not None else None

        options["logger"] = silent_logger()
        return serve(dropping(handler), *arguments, process_request=checked, **options)

    library.serve = serve_guarded
    try:
        yield
    finally:
        library.serve = serve


def dropping(handler: Callable[..., Any]) -> Callable[..., Any]:
    """The handler of a connection, which closes the connection where what comes cannot be understood."""

    async def careful(connection: Any) -> None:
        asyncio.get_running_loop().set_exception_handler(lambda loop, context: None)
        try:
            await handler(connection)
        except Exception:
            await connection.close(1007, "not understood")

    return careful


def silent_logger() -> logging.Logger:
    """Takes what the library would tell of every connection that breaks off."""
    logger = logging.getLogger("tauext.page.door")
    logger.propagate = False
    logger.handlers = [logging.NullHandler()]
    return logger
