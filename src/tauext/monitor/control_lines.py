"""Control of the loop by lines of text from stdin or a socket in the file system."""

from __future__ import annotations

import math
import os
import socket
import stat
import struct
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TextIO

from tauext.errors import AwayError, ConfigError, TauextError
from tauext.files.plain_file import number_of
from tauext.monitor.loads import expected_of_text, load_and_ago_of_text
from tauext.monitor.phases import announced_of_text
from tauext.monitor.sink import USUAL_REACH_M, Control
from tauext.progress import in_plain_letters

LONGEST = 1000
MOST_CONNECTIONS = 8
"""Largest number of connections; beyond it the one that was silent longest is closed."""
UNHEARD_S = 5.0
"""Additional silence of a connection without any line yet, so that it is closed before active ones."""
RETRY_S = 0.1
CONTROL = "control socket"
"""Origin of a line from the control socket, for the log."""
USAGE = (
    "`profile NAME`, `acknowledge`, `resume`, `load mass=KG com=X,Y,Z`, `load none`, `expect seconds=S at_most=KG`, "
    "`contact PHASE seconds=S`, `contact none`, `contact frame=NAME axis=X,Y,Z half_angle_deg=A at_most_n=N "
    "seconds=S`, `weigh [report|stop]`, `touched [ALARM]`, `nothing [ALARM]`, `learn yes|no`, `sim COMMAND` or `stop`"
)


def obey(line: str, control: Control, by: str) -> str:
    """Execute one line and return `ok` or `error: ...`, without characters that act on a terminal."""
    try:
        _execute(line.strip(), control, by)
    except TauextError as error:
        return f"error: {' '.join(in_plain_letters(str(error)).split())}"
    except ReferenceError:
        return "error: the monitor has ended"
    return "ok"


def _execute(line: str, control: Control, by: str) -> None:
    """Execute one line; ConfigError where it is no command, or the command is refused."""
    if not line.replace("\t", " ").isprintable():
        raise ConfigError(f"{line[:60]!r} must be printable text")
    what, _, name = line.partition(" ")
    if what == "profile" and name.strip():
        control.use_profile(name.strip(), by)
    elif what == "acknowledge" and not name:
        control.acknowledge(by)
    elif what == "resume" and not name:
        control.resume(by)
    elif what == "load" and name.strip():
        load, ago_s = load_and_ago_of_text(name)
        control.set_load(load, by, ago_s)
    elif what == "expect" and name.strip():
        control.expect_load(expected_of_text(name), by)
    elif what == "contact" and name.strip():
        control.declare(announced_of_text(name), by)
    elif what == "weigh" and name.strip() in ("report", "stop"):
        control.weigh(name.strip(), by)
    elif what == "weigh":
        control.weigh("start", by, reach_of_text(name.strip()))
    elif what in ("touched", "nothing"):
        control.answer("touched" if what == "touched" else "nothing", by, alarm_of_text(name.strip()))
    elif what == "learn" and name.strip() in ("yes", "no"):
        control.answer("learn" if name.strip() == "yes" else "leave", by)
    elif what == "sim" and name.strip():
        control.command(name.strip(), by)
    elif what == "stop" and not name:
        control.stop(by)
    else:
        raise ConfigError(f"{line[:60]!r} must be {USAGE}")


def reach_of_text(text: str) -> float:
    """Parse `reach=0.4`, [m]; empty text gives the default."""
    if not text:
        return USUAL_REACH_M
    name, _, number = text.partition("=")
    with suppress(ValueError):
        if name == "reach":
            return number_of(number)
    raise ConfigError(f"weigh: {text[:60]!r} must be `reach=METRES`, `report`, `stop` or nothing")


def alarm_of_text(text: str) -> int | None:
    """Parse the number of an alarm; empty text gives None."""
    if text and not (text.isascii() and text.isdecimal() and len(text) < 19 and int(text)):
        words = "must be the number of an alarm; without one, the newest alarm without an answer is meant"
        raise ConfigError(f"{text[:60]!r} {words}")
    return int(text) if text else None


def obey_lines(lines: TextIO, control: Control, by: str = "stdin", answers: TextIO | None = None) -> threading.Thread:
    """Execute line after line in a thread until the input ends; errors go to answers, stderr by default."""

    def work() -> None:
        for line in lines:
            answer = obey(line, control, by) if line.strip() else "ok"
            if answer != "ok":
                print(f"tauext: {answer}", file=answers or sys.stderr, flush=True)

    thread = threading.Thread(target=work, name="control lines", daemon=True)
    thread.start()
    return thread


def listen_at(path: Path) -> socket.socket:
    """A listening socket at this path that only its owner may connect to; OSError if there is none."""
    made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    before = os.umask(0o177)
    try:
        made.bind(str(path))
        made.listen(socket.SOMAXCONN)  # by default 128 callers at once fill the queue, and further ones are refused
    except OSError:
        made.close()
        raise
    finally:
        os.umask(before)
    return made


class ControlSocket:
    """A socket at this path; every received line is executed and answered by a line. Only its owner may connect."""

    unread_s = 5
    """Time in which a connection must take an answer, [s]; a whole number."""

    def __init__(self, path: Path, control: Control, origin: Callable[[int], str] = lambda process: CONTROL):
        """Raises ConfigError if no socket can be made, or another monitor listens there.

        origin: origin of the lines that come from a process, given its number, -1 where the system states none.
        """
        self._path, self._control, self._origin = path, control, origin
        self._spoke: dict[socket.socket, float] = {}
        """Time of each connection's last line, by time.monotonic(); UNHEARD_S before it came if it sent none, infinite
        while a line is executed."""
        self._changing = threading.Lock()
        self._closed = False
        try:
            if path.exists() and stat.S_ISSOCK(path.stat().st_mode) and not listened_to(path):
                path.unlink()  # left by a killed monitor
            self._socket = listen_at(path)
        except OSError as error:
            raise ConfigError(f"{path}: no control socket ({error.strerror or error})") from error
        self._thread = threading.Thread(target=self._work, name="control socket", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Close the socket and free its path."""
        self._closed = True
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self._thread.join(2 * RETRY_S)
        self._path.unlink(missing_ok=True)

    def _work(self) -> None:
        while True:
            try:
                connection, _ = self._socket.accept()
            except OSError:
                if self._closed:
                    return
                time.sleep(RETRY_S)  # no free descriptor: wait for other connections to end
                continue
            self._make_room()
            with self._changing:
                self._spoke[connection] = time.monotonic() - UNHEARD_S
            try:
                threading.Thread(target=self._serve, args=(connection,), name="control", daemon=True).start()
            except RuntimeError:  # no further thread can be started
                with self._changing:
                    del self._spoke[connection]
                connection.close()

    def _make_room(self) -> None:
        """Close the connection that was silent longest if there are too many, so that new ones are accepted."""
        with self._changing:
            while len(self._spoke) >= MOST_CONNECTIONS:
                silent = min(self._spoke, key=self._spoke.__getitem__)
                del self._spoke[silent]
                with suppress(OSError):
                    silent.shutdown(socket.SHUT_RDWR)

    def _serve(self, connection: socket.socket) -> None:
        try:
            self._converse(connection)
        finally:
            with self._changing:
                self._spoke.pop(connection, None)

    def _speaks(self, connection: socket.socket, at_s: float) -> None:
        with self._changing:
            if connection in self._spoke:
                self._spoke[connection] = at_s

    def _converse(self, connection: socket.socket) -> None:
        # Two files: writing to a file that is also read drops read-ahead data.
        with (
            suppress(OSError, UnicodeDecodeError),
            connection,
            connection.makefile("r", encoding="utf-8", newline="\n") as lines,
            connection.makefile("w", encoding="utf-8") as answers,
        ):
            by = self._origin(peer_of(connection))
            # Only writing has a limit: a caller may be silent for hours.
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("ll", self.unread_s, 0))
            while line := lines.readline(LONGEST):
                self._speaks(connection, math.inf)
                answer = obey(line, self._control, by)
                self._speaks(connection, time.monotonic())
                answers.write(answer + "\n")
                answers.flush()


def peer_of(connection: socket.socket) -> int:
    """Number of the process at the other end; -1 where the system states none."""
    with suppress(OSError, AttributeError, struct.error):
        size = struct.calcsize("3i")
        return int(struct.unpack("3i", connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size))[0])
    return -1


def listened_to(path: Path) -> bool:
    """Whether a process listens at this socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as trial:
        try:
            trial.connect(str(path))
        except OSError:
            return False
        return True


def send_line(path: Path, line: str, patience_s: float) -> str:
    """Send a line to a control socket; returns its answer, `ok` or `error: ...`.

    Args:
        patience_s: time for the answer, [s].

    Raises:
        ConfigError: the line is too long, or holds characters that are no printable text.
        AwayError: nobody listens at the socket, or no answer comes in time.
    """
    if not line.isprintable() or len(line) >= LONGEST:
        raise ConfigError(f"{line[:60]!r} must be one line of at most {LONGEST - 1} printable characters")
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as caller:
            caller.settimeout(patience_s)
            caller.connect(os.fsencode(path))
            caller.sendall(f"{line}\n".encode())
            with caller.makefile("r", encoding="utf-8", errors="replace", newline="\n") as answers:
                answer = answers.readline(10_000).strip()
    except TimeoutError:
        raise AwayError(f"{path}: no answer within {patience_s:g} s; the monitor may still execute the line") from None
    except OSError as error:
        raise AwayError(f"{path}: no monitor listens at this socket ({error.strerror or error})") from error
    if not answer:
        raise AwayError(f"{path}: the connection ended without an answer; the monitor has ended, or is no monitor")
    return in_plain_letters(answer)
