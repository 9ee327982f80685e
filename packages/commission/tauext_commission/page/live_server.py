"""The server of a live page: a process of its own that reads the loop's socket and the folder's files, and sends lines
to the control socket. It serves one HTML file, JSON, and the loop's lines on a WebSocket. A chosen budget of false
alarms is a line of the folder's journal."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import hmac
import json
import re
import socket
import threading
from collections.abc import Awaitable, Callable
from contextlib import suppress
from http import HTTPStatus
from importlib.resources import files
from multiprocessing.connection import Connection as Pipe
from pathlib import Path
from typing import Any

from aiohttp import web

from tauext.errors import TauextError
from tauext_commission.budget import Promise, alarm_in, chosen_alarm, promise_of, rate_of
from tauext_commission.history_file import active_bundle, read_events, read_history, read_question
from tauext_commission.journal_lines import is_number
from tauext_commission.page.access import is_from_own_page, is_own_host
from tauext_commission.page.connections import Connection

LONGEST_BODY = 1000
LONGEST_LINE = 1 << 20
"""Bytes of a line from the loop."""
PATIENCE_S = 10.0
"""Time for an answer of the control socket."""
ALIVE_S = 6.0
"""Time between two pings of a stream; one without an answer for half as long is closed."""
UNREAD_S = 10.0
"""Time in which a stream must take a line."""
RETRY_S = 0.3
MOST_ROWS = 800
"""Rows of a trace that the page draws."""
SHOWN_EVENTS, SHOWN_HISTORY = 40, 200
COOKIE = "tauext"
PUSH_S = 0.5
"""After which a push at a simulated arm ends unless it is sent again, [s]."""
MOST_LOAD_KG, MOST_COLD = 5.0, 3.0
"""Bounds of the load in a simulated hand, and of the factor on a simulated arm's friction."""
WARM_MINUTES = 20
"""Time constant with which the friction of a simulated cold morning falls to the arm's own."""
WHOLE = ("commission", "coverage", "findings", "trainer")
"""JSON files of the folder that the page reads."""


class Folder:
    """The folder's files as JSON; a file is read again when it has changed."""

    def __init__(self, folder: Path):
        self.path = folder
        self._kept: dict[str, tuple[tuple[int, int], Any]] = {}
        self._reading = threading.Lock()
        self._promise: tuple[object, Promise] = None, Promise()

    def state(self) -> dict[str, Any]:
        """All that the page shows beside the live line; a missing or damaged file is None or empty."""
        with self._reading:
            whole = {name: self._read(f"{name}.json", json.loads) for name in WHOLE}
        history = read_history(self.path)
        begun = [one for one in history if one["kind"] == "activation"]
        return whole | {
            "active": {"bundle": begun[-1].get("bundle")} if begun else None,
            "question": read_question(self.path) or None,
            "limits": self._limits(whole["commission"] or {}),
            "name": self.path.resolve().name,
            "robot": self._robot_stamp(),
            "history": history[-SHOWN_HISTORY:],
            "events": read_events(self.path)[-SHOWN_EVENTS:],
        }

    def _limits(self, facts: dict[str, Any]) -> dict[str, Any]:
        """What the limits of the bundle that monitors are set for, its table of budgets, and the chosen rate."""
        active = active_bundle(self.path)
        name = facts.get("running") or (active.stem if active else None)
        if self._promise[0] != name or self._promise[1].per_hour is None:
            self._promise = name, promise_of(self.path, name)
        promise = self._promise[1]
        words = {"set_words": promise.set_words(), "proved_words": promise.proved_words()}
        return promise._asdict() | words | {"bundle": name, "chosen_per_hour": rate_of(chosen_alarm(self.path))}

    def choose(self, per_hour: float) -> str:
        """Keep a budget of the table for the training process; returns `ok` or `error: ...`."""
        from tauext_commission.folder import CommissionFolder

        try:
            active = active_bundle(self.path)
            alarm = alarm_in(promise_of(self.path, active.stem if active else None).budgets, per_hour)
            CommissionFolder.open(self.path).choose(alarm, "page")
        except TauextError as error:
            return f"error: {error}"
        except OSError as error:
            return f"error: not stored: {error.strerror or error}; please choose again"
        return "ok"

    def arm(self) -> dict[str, Any]:
        """See arm_facts()."""
        from tauext_commission.page.live_arm import arm_facts

        with self._reading:
            facts = self._read("commission.json", json.loads) or {}
        joints = (facts.get("arm") or {}).get("joints") or []
        return arm_facts(self._robot(), tuple(map(str, joints)))

    def _robot(self) -> Path | None:
        """The robot file of the folder's description; None: it is not written yet."""
        robots = [path for name in ("robot.urdf", "robot.xml") if (path := self.path / name).is_file()]
        return robots[0] if robots else None

    def _robot_stamp(self) -> str:
        """Changes with the robot file; empty: there is none."""
        with suppress(OSError):
            if (robot := self._robot()) is not None:
                return str(robot.stat().st_mtime_ns)
        return ""

    def trace(self, event: int) -> dict[str, Any] | None:
        """The estimates around an event, thinned; None: there is no flight of it."""
        found = [one for one in self.state()["events"] if one.get("id") == event]
        name = Path(str(found[0].get("flight") or "")).name if found else ""
        path = self.path / "flights" / f"{name.removesuffix('.parquet')}.estimates.parquet"
        if not name or not path.is_file():
            return None
        return trace_of(path, int(found[0].get("t_ns") or 0))

    def _read(self, name: str, parse: Callable[[bytes], Any]) -> Any:
        path = self.path / name
        try:
            now = path.stat()
            stamp = (now.st_mtime_ns, now.st_size)
            if name not in self._kept or self._kept[name][0] != stamp:
                self._kept[name] = stamp, parse(path.read_bytes())
            return self._kept[name][1]
        except FileNotFoundError:
            return None
        except (OSError, ValueError):
            return self._kept.get(name, (0, None))[1]


def trace_of(path: Path, event_ns: int) -> dict[str, Any] | None:
    """Rows of an event for each joint: time from the event [s], tau_ext, standard error and limits.

    Each bin has the row with the largest share of a limit.
    """
    import numpy as np

    from tauext.bundle.estimates import load_estimates

    try:
        found = load_estimates(path)
    except TauextError:
        return None
    share = np.nan_to_num(np.abs(found.tau_ext) / found.limit_nm).max(axis=1)
    edges = np.linspace(0, len(share), min(MOST_ROWS, len(share)) + 1).astype(int)
    rows = np.array([a + int(np.argmax(share[a:b])) for a, b in zip(edges[:-1], edges[1:], strict=True)])
    columns = {"tau": found.tau_ext, "sigma": found.band_nm, "limit": found.limit_nm, "touch": found.contact_limit_nm}
    values = {
        name: None if column is None else np.where(np.isfinite(column[rows]), column[rows], 1e30).T.round(4).tolist()
        for name, column in columns.items()
    }
    return values | {"joints": list(found.joints), "t_s": ((found.t_ns[rows] - event_ns) * 1e-9).round(4).tolist()}


class LiveLine:
    """The newest line of the loop's socket, for any number of readers; connects again for ever."""

    def __init__(self, path: Path):
        self._path, self._line, self._number = path, "", 0
        self._news = asyncio.Condition()

    async def next(self, number: int) -> tuple[int, str]:
        """Number and text of the newest line once it is not this one."""
        async with self._news:
            await self._news.wait_for(lambda: self._number != number)
            return self._number, self._line

    async def follow(self) -> None:
        """Read lines until it is cancelled."""
        while True:
            with suppress(OSError, ValueError):  # ValueError: a line is too long
                lines, wire = await asyncio.open_unix_connection(self._path, limit=LONGEST_LINE)
                try:
                    while (line := await lines.readline()).endswith(b"\n"):
                        async with self._news:
                            self._line, self._number = line.decode(errors="replace").strip(), self._number + 1
                            self._news.notify_all()
                finally:
                    wire.close()
            await asyncio.sleep(RETRY_S)


async def ask(path: Path, line: str) -> str:
    """Send a line to the control socket; its answer, `ok` or `error: ...`."""
    try:
        async with asyncio.timeout(PATIENCE_S):
            answers, wire = await asyncio.open_unix_connection(path)
            try:
                wire.write(line.encode() + b"\n")
                answer = await answers.readline()
            finally:
                wire.close()
    except (OSError, ValueError):
        return "error: the loop does not answer; look at the events for what was stored"
    return answer.decode(errors="replace").strip() or "error: the loop has ended"


BUDGET = "/budget"
COMMANDS = ("/answer", "/reset", "/learn", "/push", "/sim")


def line_of(path: str, body: dict[str, Any]) -> str | None:
    """The control line of a POST; None: the request is malformed."""
    number = body.get("id")
    if path == "/answer" and body.get("what") in ("touched", "nothing"):
        if number is None:
            return str(body["what"])
        return f"{body['what']} {number}" if is_whole(number) else None
    if path == "/reset" and not body:
        return "acknowledge"
    if path == "/learn" and isinstance(body.get("yes"), bool):
        return f"learn {'yes' if body['yes'] else 'no'}"
    if path == "/push" and re.fullmatch(r"[\w.:/-]{1,100}", str(body.get("joint"))):
        point, force = vector_of(body.get("point")), vector_of(body.get("force"))
        if point and force:
            return f"sim push joint={body['joint']} force={force} point={point} seconds={PUSH_S}"
    return sim_line(body) if path == "/sim" and len(body) == 1 else None


def rate_in(body: Any) -> float | None:
    """The rate of a request for another budget, [1/h]; None: the request is malformed."""
    value = body.get("per_hour") if isinstance(body, dict) and len(body) == 1 else None
    return float(value) if value is not None and is_number(value, 1e-9) else None


def sim_line(body: dict[str, Any]) -> str | None:
    """The control line that changes a simulated arm; None: the request is malformed."""
    ((what, value),) = body.items()
    if what == "move" and isinstance(value, bool):
        return "sim move" if value else "sim stop"
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    if what == "load" and 0 <= value <= MOST_LOAD_KG:
        return f"sim load mass={value:g}"
    if what == "cold" and 1 <= value <= MOST_COLD:
        return f"sim friction factor=1 start={value:g} minutes={WARM_MINUTES}"
    return None


def vector_of(value: Any) -> str:
    """Three numbers as a control line has them; empty: they are none."""
    if not isinstance(value, list) or len(value) != 3:
        return ""
    if not all(isinstance(one, int | float) and not isinstance(one, bool) and abs(one) < 1e4 for one in value):
        return ""
    return ",".join(f"{one:.4g}" for one in value)


def is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 53


class Server:
    """The page's server; its address accepts connections from the start, run() answers them."""

    def __init__(self, host: str, listening: socket.socket, folder: Path, live: Path, control: Path, token: str):
        """token: that a browser must show; empty: none."""
        self._host, self._token, self._control, self._live_path = host, token, control, live
        self._folder = Folder(folder)
        self._page = files("tauext_commission.page").joinpath("live_page.html").read_text(encoding="utf-8")
        script = self._page.partition("<script>")[2].partition("</script>")[0]
        kept = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        self._headers = {
            "Content-Security-Policy": f"default-src 'none'; script-src 'sha256-{kept}'; style-src 'unsafe-inline'; "
            "connect-src 'self'; img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
            "Server": "tauext",
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cache-Control": "no-store",
        }
        self._socket = listening
        self.port: int = listening.getsockname()[1]

    async def run(self) -> None:
        """Serve until it is cancelled."""
        self._live = LiveLine(self._live_path)
        app = web.Application(middlewares=[self._guard], client_max_size=LONGEST_BODY + 1)
        app.on_response_prepare.append(self._finish_head)
        pages = {"/": self._show, "/state": self._state, "/arm": self._arm, "/live": self._stream}
        app.add_routes([web.get(path, show, allow_head=False) for path, show in pages.items()])
        app.add_routes([web.get(r"/event/{id:[0-9]{1,18}}", self._event, allow_head=False)])
        app.add_routes([web.post(path, self._send) for path in (*COMMANDS, BUDGET)])
        runner = web.AppRunner(app, handle_signals=False)
        await runner.setup()
        assert runner.server is not None
        server, loop = runner.server, asyncio.get_running_loop()
        open_ones: set[Connection] = set()
        listening = await loop.create_server(lambda: Connection(open_ones, server, loop), sock=self._socket)
        try:
            await self._live.follow()
        finally:
            listening.close()
            for one in tuple(open_ones):
                one.abort()
            await runner.cleanup()

    # Who may use it.

    @web.middleware
    async def _guard(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        """Refuse a request that is not of its own page; a failure is reported to the browser."""
        try:
            if why := self._refusal(request):
                return refuse(HTTPStatus.FORBIDDEN, why)
            if request.method != "POST":
                connection_of(request).has_request()
            return await handler(request)
        except web.HTTPException as error:
            return refuse(HTTPStatus(error.status), error.reason)
        except ConnectionError:
            raise
        except Exception as error:
            return refuse(HTTPStatus.INTERNAL_SERVER_ERROR, f"the request failed: {type(error).__name__}: {error}")

    def _refusal(self, request: web.Request) -> str:
        """Why this request is refused; empty: it is not."""
        if not is_own_host(request.headers.get("Host", ""), self._host):
            return "this server has another name"
        if not is_from_own_page(request.method, request.path, request.headers):
            return "only its own page may use this server"
        is_link = request.path == "/" and bool(request.query_string)
        shown = request.query.get("token", "") if is_link else request.cookies.get(COOKIE, "")
        if not self._token:
            return ""
        if hmac.compare_digest(shown.encode(errors="replace"), self._token.encode()):
            connection_of(request).is_trusted = True
            return ""
        if is_link:
            return "this token is not valid: each start makes a new one; open the address that was printed last"
        return "open the address with the token that `tauext commission` printed"

    async def _finish_head(self, request: web.Request, response: web.StreamResponse) -> None:
        response.headers.update(self._headers)
        response.force_close()

    # What it shows.

    async def _show(self, request: web.Request) -> web.StreamResponse:
        if not request.query_string:
            return web.Response(text=self._page, content_type="text/html")
        # The address with the token is exchanged for a cookie, so that the token stays in no history.
        found = web.Response(status=HTTPStatus.SEE_OTHER, headers={"Location": "/"})
        if self._token:
            found.set_cookie(COOKIE, self._token, httponly=True, samesite="Strict", path="/")
        return found

    async def _state(self, request: web.Request) -> web.StreamResponse:
        return web.json_response(await asyncio.to_thread(self._folder.state))

    async def _arm(self, request: web.Request) -> web.StreamResponse:
        return web.json_response(await asyncio.to_thread(self._folder.arm))

    async def _event(self, request: web.Request) -> web.StreamResponse:
        found = await asyncio.to_thread(self._folder.trace, int(request.match_info["id"]))
        return web.json_response(found) if found else refuse(HTTPStatus.NOT_FOUND, "this event has no trace")

    async def _stream(self, request: web.Request) -> web.StreamResponse:
        """The newest line each time, as a message; one that a slow browser has not taken is skipped."""
        stream = web.WebSocketResponse(heartbeat=ALIVE_S, compress=False, max_msg_size=LONGEST_BODY, writer_limit=0)
        await stream.prepare(request)
        connection = connection_of(request)
        connection.has_stream()
        sending = asyncio.create_task(self._send_lines(stream, connection))
        try:
            await stream.receive()  # answers pings; a page sends nothing, so any message ends the stream
        finally:
            sending.cancel()
            connection.abort()
        return stream

    async def _send_lines(self, stream: web.WebSocketResponse, connection: Connection) -> None:
        number = 0
        with suppress(OSError):
            while True:
                number, line = await self._live.next(number)
                async with asyncio.timeout(UNREAD_S):
                    await stream.send_str(line)
        connection.abort()

    # What it sends to the loop.

    async def _send(self, request: web.Request) -> web.StreamResponse:
        if request.content_type != "application/json":
            return refuse(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "only JSON is accepted")
        if (request.content_length or 0) > LONGEST_BODY:
            raise web.HTTPRequestEntityTooLarge(LONGEST_BODY, request.content_length or 0)
        content = await request.read()
        connection_of(request).has_request()
        try:
            body = json.loads(content)
        except (ValueError, RecursionError):
            body = None
        if request.path == BUDGET and (rate := rate_in(body)) is not None:
            answer = await asyncio.to_thread(self._folder.choose, rate)
        elif line := line_of(request.path, body) if isinstance(body, dict) else None:
            answer = await ask(self._control, line)
        else:
            return refuse(HTTPStatus.BAD_REQUEST, "the request is malformed")
        return web.json_response({"answer": answer}, status=HTTPStatus.OK if answer == "ok" else HTTPStatus.CONFLICT)


def connection_of(request: web.Request) -> Connection:
    assert isinstance(request.protocol, Connection)
    return request.protocol


def refuse(status: HTTPStatus, why: str) -> web.Response:
    return web.Response(text=f"{why}\n", status=status)


def serve(
    pipe: Pipe, folder: Path, live: Path, control: Path, host: str, listening: socket.socket, token: str
) -> None:  # pragma: no cover - a process of its own
    """Serve until the pipe to the parent closes."""
    server = Server(host, listening, folder, live, control, token)

    async def run() -> None:
        serving = asyncio.create_task(server.run())
        asyncio.get_running_loop().add_reader(pipe.fileno(), serving.cancel)  # the parent sends nothing: it has ended
        with suppress(asyncio.CancelledError):
            await serving

    asyncio.run(run())
