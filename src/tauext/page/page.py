"""The page: its server, who may connect to it, and one simulated arm at a time."""

from __future__ import annotations

import asyncio
import contextlib
import http
import importlib
import io
import logging
import signal
import threading
import time
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tauext.commission.processes import start_worker
from tauext.errors import ConfigError, TauextError
from tauext.page.bundles import LESSONS, Lesson, Report, bundle_folder, find_bundles
from tauext.page.door import free_port, is_own_name
from tauext.page.simulation import Stretch, Weigher
from tauext.page.snapshot import Event, Snapshot
from tauext.page.workers import RECENT, SNAPSHOT, run_simulation, run_training
from tauext.sim.arms import ARMS

if TYPE_CHECKING:
    import viser

# --- Who may connect to the page's server: browsers that show this page, and no requests from other pages.


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
    """Servers started within this context check every connection, and drop those that send invalid requests.

    viser has no place for a check of its own; it starts its server by the function that is replaced here meanwhile.
    """
    library: Any = importlib.import_module("websockets.asyncio.server")

    serve: Callable[..., Any] = library.serve

    def serve_guarded(handler: Callable[..., Any], *arguments: Any, process_request: Any, **options: Any) -> Any:
        def checked(connection: Any, request: Any) -> Any:
            try:
                reason = why_not(request.headers, host, protocol)
            except LookupError:  # a repeated header
                reason = "a header is repeated"
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
    """The handler of a connection, which closes the connection after an invalid request."""

    async def careful(connection: Any) -> None:
        asyncio.get_running_loop().set_exception_handler(lambda loop, context: None)
        try:
            await handler(connection)
        except Exception:
            await connection.close(1007, "not understood")

    return careful


def silent_logger() -> logging.Logger:
    """Discards the library's messages about connections that break off."""
    logger = logging.getLogger("tauext.page.page")
    logger.propagate = False
    logger.handlers = [logging.NullHandler()]
    return logger


# --- The page: a server, one arm at a time, and the messages between browser, simulation and training.


FRAME_S = 1 / 30
"""Shortest time between updates of the browsers; viser drops updates that a slow browser has not received."""


def open_server(host: str, port: int) -> viser.ViserServer:
    """viser on this port, quiet, and without its way to share the page over other hosts.

    Raises:
        ConfigError: viser is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise ConfigError(
            "the demo's page needs viser: pip install 'tauext[live]' (--headless-seconds does not)"
        ) from error
    with contextlib.redirect_stdout(io.StringIO()), guarded(host, f"viser-v{viser.__version__}"):
        server = viser.ViserServer(host=host, port=port, verbose=False)
    server.request_share_url = lambda verbose=True: None
    return server


class Session:
    """One arm on the page, from its first sample until another one is chosen or stop() is called."""

    def __init__(
        self,
        server: viser.ViserServer,
        arm_name: str,
        seed: int,
        cache: Path,
        lesson: Lesson | None = None,
        report: Report = lambda share, what: None,
        ended: threading.Event | None = None,
    ):
        """ended: ends run() when it is set, as stop() does."""
        from tauext.page.drawing import Drawing
        from tauext.page.panel import Panel

        self.arm = ARMS[arm_name]()
        self.error = "exact"
        self.events: list[Event] = []
        self.snapshot: Snapshot | None = None
        self._server, self._seed, self._cache = server, seed, cache
        self._lesson, self._report = lesson or LESSONS[arm_name], report
        self._next_arm: str | None = None
        self._ended, self._watch_next = ended or threading.Event(), False
        self._trainer: Any = None
        self._method = "tauext"
        self._bundles: dict[str, Path] = {}
        self._weigher = Weigher(self.arm)
        self._sending = threading.Lock()
        self._process, self._pipe = start_worker(run_simulation, arm_name, seed)
        server.scene.reset()
        server.gui.reset()
        self._drawing = Drawing(server, self.arm, self._drag)
        self._panel = Panel(
            server, self.arm, self.error, self.send, self._choose_arm, self._choose_error, self._drawing.simplify
        )

    def send(self, name: str, *arguments: object) -> None:
        """A command for the simulation, from any thread."""
        if name == "set_method":
            self._method = str(arguments[0])
        with self._sending, contextlib.suppress(OSError):
            self._pipe.send((name, *arguments))

    def stop(self) -> None:
        """End run()."""
        self._ended.set()

    def run(self) -> str | None:
        """Show the arm until another one is chosen, which is returned, or None after stop().

        Raises:
            TauextError: the simulation or a training ended by itself.
        """
        try:
            self._watch()
            due = time.monotonic()
            while not self._ended.is_set() and self._next_arm is None:
                self.send(SNAPSHOT)
                due = max(due + FRAME_S, time.monotonic())
                while (left := due - time.monotonic()) > 0:
                    if self._pipe.poll(left):
                        self._receive(self._pipe.recv())
                self._listen_to_trainer()
            return self._next_arm
        except (EOFError, OSError) as error:
            raise TauextError("the simulation ended by itself; its output is above") from error
        finally:
            self.close()

    def close(self) -> None:
        """End both processes at once; a training that is cut off leaves nothing behind."""
        self._end_training()
        self._pipe.close()
        self._process.terminate()
        self._process.join(1.0)

    def _receive(self, message: Snapshot | Stretch) -> None:
        if isinstance(message, Snapshot):
            self._show(message)
        elif self._method in self._bundles:
            self._weigher.start(self._bundles[self._method], message)

    def _show(self, snapshot: Snapshot) -> None:
        self.snapshot = snapshot
        self.events += snapshot.events
        with self._server.atomic():
            self._drawing.show(snapshot)
            self._panel.show(snapshot, len(self._server.get_clients()), self._weigher.words)
        if snapshot.events:
            self._server.flush()
        if self._bundles and self._weigher.wants(snapshot):
            self.send(RECENT)

    def _drag(self, phase: str, who: object, joint: int, where: tuple[float, float, float]) -> None:
        if phase == "start":
            self.send("grab", who, joint, where)
        elif phase == "update":
            self.send("pull", who, where)
        else:
            self.send("release", who)

    def _choose_arm(self, name: str) -> None:
        if name != self.arm.name:
            self._next_arm = name

    def _choose_error(self, error: str) -> None:
        self.error = error
        self._bundles = {}
        self.send("watch_nothing")
        self._watch_next = True

    def _watch(self) -> None:
        """Watch with the bundles of the chosen model error; train them where they are not there yet."""
        self._watch_next = False
        self._end_training()
        folder = bundle_folder(self.arm, self.error, self._lesson, self._seed, self._cache)
        bundles = find_bundles(folder, self._lesson)
        if bundles is None:
            arguments = (self.arm.name, self.error, self._lesson, self._seed, self._cache)
            self._trainer = start_worker(run_training, *arguments)
            self._show_progress(0.0, "practising free motion")
        else:
            self._use(bundles)

    def _use(self, bundles: dict[str, Path]) -> None:
        self._show_progress(1.0, "")
        self._bundles = bundles
        self.send("watch_with", {method: str(path) for method, path in bundles.items()}, self._method)

    def _listen_to_trainer(self) -> None:
        if self._watch_next:
            self._watch()
        while self._trainer is not None and self._trainer[1].poll():
            try:
                message = self._trainer[1].recv()
            except EOFError:
                raise TauextError("the training ended by itself; its output is above") from None
            if isinstance(message, str):
                raise TauextError(f"the bundles of the demo cannot be trained: {message}")
            if isinstance(message, dict):
                self._end_training()
                self._use(message)
            else:
                self._show_progress(*message)

    def _show_progress(self, share: float, what: str) -> None:
        self._panel.show_training(share, f"First use: {what} ({share:.0%})" if what else "")
        self._report(share, what)

    def _end_training(self) -> None:
        if self._trainer is not None:
            process, pipe = self._trainer
            self._trainer = None
            process.terminate()
            process.join(2.0)
            pipe.close()


@contextlib.contextmanager
def until_ctrl_c() -> Iterator[threading.Event]:
    """An event that the first Ctrl-C sets; a second one interrupts.

    An exception in the middle of whatever runs would not do: some libraries swallow it while they are imported.
    """
    ended = threading.Event()

    def end(*_: object) -> None:
        if ended.is_set():
            raise KeyboardInterrupt
        ended.set()

    before = signal.signal(signal.SIGINT, end)
    try:
        yield ended
    finally:
        signal.signal(signal.SIGINT, before)


def run_page(
    arm_name: str,
    host: str,
    port: int,
    seed: int,
    cache: Path,
    open_browser: bool,
    report: Report,
    echo: Callable[[str], None],
) -> None:
    """Serve the demo until Ctrl-C ends it.

    Args:
        report: called with the share of a training that is done and what is being done; "" at its end.
        echo: prints a line.

    Raises:
        ConfigError: no free port, no such host, or viser is missing.
    """
    with until_ctrl_c() as ended:  # set before the line that mentions Ctrl-C is printed
        found = free_port(host, port)
        server = open_server(host, found)
        try:
            url = f"http://{'localhost' if host in ('0.0.0.0', '127.0.0.1') else host}:{found}"
            if found != port:
                echo(f"port {port} is in use; this one is {found}")
            reach = (
                "this machine alone can open it"
                if host in ("127.0.0.1", "localhost", "::1")
                else "ANYONE who reaches it can push"
            )
            echo(f"{url}  ({host}: {reach}; Ctrl-C ends it)")
            following: str | None = arm_name
            while following is not None:
                session = Session(server, following, seed, cache, report=report, ended=ended)
                if open_browser and not ended.is_set():
                    webbrowser.open(url)
                    open_browser = False
                following = session.run()
        finally:
            with contextlib.redirect_stdout(io.StringIO()):
                server.stop()
