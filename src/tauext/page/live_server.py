"""The server of a live page: a process of its own that reads the loop's socket and the folder's files, and sends lines
to the control socket. It serves one HTML file and JSON; only the standard library is needed."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import re
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from tauext.bundle.history_file import read_events, read_history, read_question
from tauext.page.door import is_own_name

LONGEST_BODY = 1000
LONGEST_LINE = 1 << 20
"""Bytes of a line from the loop."""
MOST_CONNECTIONS = 16
PATIENCE_S = 10.0
"""Time for a request, for an answer of the control socket, and between two signs of life of /live."""
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

    def state(self) -> dict[str, Any]:
        """All that the page shows beside the live line; a missing or damaged file is None or empty."""
        with self._reading:
            whole = {name: self._read(f"{name}.json", json.loads) for name in WHOLE}
        history = read_history(self.path)
        begun = [one for one in history if one["kind"] == "activation"]
        return whole | {
            "active": {"bundle": begun[-1].get("bundle")} if begun else None,
            "question": read_question(self.path) or None,
            "name": self.path.resolve().name,
            "robot": self._robot_stamp(),
            "history": history[-SHOWN_HISTORY:],
            "events": read_events(self.path)[-SHOWN_EVENTS:],
        }

    def arm(self) -> dict[str, Any]:
        """See arm_facts()."""
        from tauext.page.live_arm import arm_facts

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
    """Of every joint: time from the event [s], tau_ext, standard error and limits; of each bin the row with the largest
    share of a limit."""
    import numpy as np

    from tauext.bundle.estimates import load_estimates
    from tauext.errors import TauextError

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


class Live:
    """The newest line of the loop's socket, for any number of readers; connects again for ever."""

    def __init__(self, path: Path):
        self._path, self._line, self._number = path, b"", 0
        self._news = threading.Condition()
        self._connection: socket.socket | None = None
        threading.Thread(target=self._work, name="live socket", daemon=True).start()

    def next(self, number: int, wait_s: float) -> tuple[int, bytes]:
        """Number and text of the newest line once it is not this one; the same number if none came in time."""
        with self._news:
            self._news.wait_for(lambda: self._number != number, wait_s)
            return self._number, self._line

    def _work(self) -> None:
        while True:
            with (
                suppress(OSError),
                socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as wire,
            ):
                wire.connect(str(self._path))
                with wire.makefile("rb") as lines:
                    while (line := lines.readline(LONGEST_LINE)).endswith(b"\n"):
                        with self._news:
                            self._line, self._number = line.strip(), self._number + 1
                            self._news.notify_all()
            time.sleep(RETRY_S)


def ask(path: Path, line: str) -> str:
    """Send a line to the control socket; its answer, `ok` or `error: ...`."""
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as wire:
            wire.settimeout(PATIENCE_S)
            wire.connect(str(path))
            wire.sendall(line.encode() + b"\n")
            with wire.makefile("r", encoding="utf-8") as answers:
                return answers.readline(LONGEST_BODY).strip() or "error: the loop has ended"
    except OSError:
        return "error: the loop does not answer; look at the events for what was stored"


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
        return f"sim friction factor=1 from={value:g} minutes={WARM_MINUTES}"
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


class Server(ThreadingHTTPServer):
    """At most MOST_CONNECTIONS at a time; a further one is closed."""

    daemon_threads = True
    request_queue_size = 32

    def __init__(self, host: str, port: int, folder: Path, live: Path, control: Path, token: str):
        """token: that a browser must show; empty: none."""
        self.host, self.token, self.control = host, token, control
        self.folder, self.live = Folder(folder), Live(live)
        self.page = files("tauext.page").joinpath("live_page.html").read_bytes()
        script = self.page.partition(b"<script>")[2].partition(b"</script>")[0]
        kept = base64.b64encode(hashlib.sha256(script).digest()).decode()
        self.policy = (
            f"default-src 'none'; script-src 'sha256-{kept}'; style-src 'unsafe-inline'; connect-src 'self'; "
            "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
        self._free = threading.BoundedSemaphore(MOST_CONNECTIONS)
        if ":" in host:
            self.address_family = socket.AF_INET6
        super().__init__((host, port), Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A connection that breaks off is not reported."""


class Handler(BaseHTTPRequestHandler):
    """One request a connection."""

    server: Server
    server_version, sys_version = "tauext", ""
    timeout = PATIENCE_S

    def log_message(self, format: str, *arguments: Any) -> None:
        pass

    def do_GET(self) -> None:
        path, _, query = self.path.partition("?")
        if path == "/" and query and self._is_named():
            return self._let_in(query)
        if not self._is_allowed():
            return
        if path == "/":
            self._send(self.server.page, "text/html; charset=utf-8")
        elif path == "/state":
            self._json(self.server.folder.state())
        elif path == "/arm":
            self._json(self.server.folder.arm())
        elif path.startswith("/event/") and path[7:].isascii() and path[7:].isdigit() and len(path) < 25:
            found = self.server.folder.trace(int(path[7:]))
            self._json(found, HTTPStatus.OK if found else HTTPStatus.NOT_FOUND)
        elif path == "/live":
            self._stream()
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "there is no such page")

    def do_POST(self) -> None:
        if not self._is_allowed():
            return
        called = self.headers.get("Host", "")
        if self.headers.get("Origin", "") != f"http://{called}":
            return self._refuse(HTTPStatus.FORBIDDEN, "only its own page may send to this server")
        if self.headers.get("Content-Type", "").partition(";")[0].strip().lower() != "application/json":
            return self._refuse(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "only JSON is accepted")
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit()) or int(length) > LONGEST_BODY:
            return self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"at most {LONGEST_BODY} bytes are accepted")
        try:
            body = json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError):
            body = None
        line = line_of(self.path, body) if isinstance(body, dict) else None
        if line is None:
            return self._refuse(HTTPStatus.BAD_REQUEST, "the request is malformed")
        answer = ask(self.server.control, line)
        self._json({"answer": answer}, HTTPStatus.OK if answer == "ok" else HTTPStatus.CONFLICT)

    def _is_named(self) -> bool:
        """Whether the browser calls the server by a name that no other machine can take; else it is refused."""
        names = self.headers.get_all("Host") or [""]
        called = urlsplit(f"//{names[0]}")
        if len(names) == 1 and not called.path and is_own_name(called.hostname or "", self.server.host):
            return True
        self._refuse(HTTPStatus.FORBIDDEN, "this server has another name")
        return False

    def _is_allowed(self) -> bool:
        """Whether name and token are right; else the request is refused."""
        if not self._is_named():
            return False
        shown = ""
        with suppress(CookieError):
            cookie = SimpleCookie(self.headers.get("Cookie", "")).get(COOKIE)
            shown = cookie.value if cookie else ""
        if not self.server.token or self._is_token(shown):
            return True
        self._refuse(HTTPStatus.FORBIDDEN, "open the address with the token that `tauext commission` printed")
        return False

    def _is_token(self, shown: str) -> bool:
        return hmac.compare_digest(shown.encode(), self.server.token.encode())

    def _let_in(self, query: str) -> None:
        """Exchange the address with the token for a cookie, so that the token stays in no history."""
        shown = parse_qs(query).get("token", [""])[0]
        if self.server.token and not self._is_token(shown):
            words = "this token is not valid: each start makes a new one; open the address that was printed last"
            return self._refuse(HTTPStatus.FORBIDDEN, words)
        self.send_response(HTTPStatus.SEE_OTHER)
        self.send_header("Location", "/")
        if self.server.token:
            self.send_header("Set-Cookie", f"{COOKIE}={shown}; HttpOnly; SameSite=Strict; Path=/")
        self.send_header("Content-Length", "0")
        self.end_headers()

    def _json(self, content: Any, status: HTTPStatus = HTTPStatus.OK) -> None:
        self._send(json.dumps(content).encode(), "application/json", status)

    def _refuse(self, status: HTTPStatus, why: str) -> None:
        self._send(f"{why}\n".encode(), "text/plain; charset=utf-8", status)

    def _send(self, content: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        self.send_response(status)
        self._head(kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def _head(self, kind: str) -> None:
        self.send_header("Content-Type", kind)
        self.send_header("Content-Security-Policy", self.server.policy)
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("Cache-Control", "no-store")

    def _stream(self) -> None:
        """Server-sent events: the newest line each time; one that a slow browser has not taken is skipped."""
        self.send_response(HTTPStatus.OK)
        self._head("text/event-stream")
        self.end_headers()
        number = 0
        while True:
            was = number
            number, line = self.server.live.next(was, PATIENCE_S / 2)
            self.wfile.write(b": no news\n\n" if number == was else b"data: " + line + b"\n\n")


def serve(
    pipe: Connection, folder: Path, live: Path, control: Path, host: str, port: int, token: str
) -> None:  # pragma: no cover - a process of its own
    """Serve until the pipe to the parent closes."""
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    server = Server(host, port, folder, live, control, token)
    threading.Thread(target=server.serve_forever, name="page", daemon=True).start()
    with suppress(EOFError, OSError):
        pipe.send("serving")
        while True:
            pipe.recv()
    sys.exit(0)
