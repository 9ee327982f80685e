"""Connections of the page's server: bounded in number, bytes and time, so that strangers cannot keep its owner out."""

from __future__ import annotations

import asyncio
import resource
from typing import Any

from aiohttp import web

MOST = min(512, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 2)
MOST_OF_ADDRESS = MOST // 2
"""Connections at a time, of all and of one address."""
LARGEST_REQUEST = 1 << 15
"""Bytes of a whole request."""
REQUEST_S, ANSWER_S = 10.0, 30.0
"""Time from connecting to the end of the request, and from there to the end of the answer."""
FRESH_S, PROVEN_S = 1.0, 10.0
"""Ages from which a request is slow, and a stream has answered pings."""
SLOW, UNPROVEN, FRESH, ASKS, PROVEN = range(5)
"""What a connection is, in the order in which connections are closed if there are too many."""


class Connection(web.RequestHandler):
    """One request and its answer, or a stream. If there are too many, one without the token is closed first, of the
    first kind above, of equals the oldest; never the new one."""

    def __init__(self, others: set[Connection], server: web.Server, loop: asyncio.AbstractEventLoop):
        """others: all connections of this server."""
        super().__init__(server, loop=loop, lingering_time=1.0, auto_decompress=False)
        self.is_trusted = False
        """Its request has shown the token."""
        self._others, self._is_whole, self._streams, self._left = others, False, False, LARGEST_REQUEST
        self._born_s, self._timer = loop.time(), loop.call_later(REQUEST_S, self.abort)
        self._wire: asyncio.Transport | None = None
        self._address = ""

    def has_request(self) -> None:
        """The request is whole."""
        self._is_whole = True
        self._set_timer(ANSWER_S)

    def has_stream(self) -> None:
        """The answer is a stream, which has limits of its own."""
        self._streams = True
        self._timer.cancel()

    def abort(self) -> None:
        """Close it now; what is not sent yet is lost."""
        self._others.discard(self)
        if self._wire is not None:
            self._wire.abort()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        assert isinstance(transport, asyncio.Transport)
        self._wire, self._address = transport, (transport.get_extra_info("peername") or ("",))[0]
        transport.set_write_buffer_limits(0)  # a slow stream skips lines instead of storing them
        of_address = [one for one in self._others if one._address == self._address]
        if len(of_address) >= MOST_OF_ADDRESS:
            min(of_address, key=Connection._rank).abort()
        elif len(self._others) >= MOST:
            min(self._others, key=Connection._rank).abort()
        self._others.add(self)

    def connection_lost(self, exc: BaseException | None) -> None:
        self._timer.cancel()
        self._others.discard(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        if not self._streams:
            self._left -= len(data)
            if self._left < 0:
                return self.abort()
        super().data_received(data)

    def log_exception(self, *args: Any, **kw: Any) -> None:
        """Bytes that are no HTTP are not reported."""

    def _rank(self) -> tuple[bool, int, float]:
        """The smallest is closed first."""
        age_s = self._loop.time() - self._born_s
        if self._streams:
            kind = UNPROVEN if age_s < PROVEN_S else PROVEN
        else:
            kind = ASKS if self._is_whole else FRESH if age_s < FRESH_S else SLOW
        return self.is_trusted, kind, self._born_s

    def _set_timer(self, seconds: float) -> None:
        self._timer.cancel()
        self._timer = self._loop.call_later(seconds, self.abort)
