"""The main process of `tauext commission`: connects the arm, runs the loop, and tends the page and the training.

Loop, page and training are separate processes. The training and the loop exchange files of the folder; the page reads
the same files and the loop's socket, and sends lines to the control socket.
"""

from __future__ import annotations

import json
import math
import os
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

from tauext import _core
from tauext.config import AlarmConfig
from tauext.errors import AwayError, ConfigError, TauextError
from tauext.files.atomic_write import atomic_write
from tauext.monitor.cell_file import Cell
from tauext.monitor.control_lines import CONTROL, ControlSocket
from tauext.monitor.latency import how_to_hold_the_rate
from tauext.monitor.loop import Loop, LoopSettings
from tauext.monitor.monitored_time import MINUTE_S, MonitoredNews
from tauext.monitor.reactions import expect_actions, start_reactions
from tauext.monitor.record_sink import FlightSink
from tauext.monitor.sink import Sink
from tauext.monitor.source import Describes, Source, SourceFacts
from tauext.monitor.stop_signals import stopped_by_signals
from tauext.robot.read import movable_joints
from tauext.robot.write import is_placeholder
from tauext.sources.open import open_source, robot_file_of
from tauext_commission.answers import ASKING_S, AlarmJournal, CurrentLoop, age_s
from tauext_commission.connect import (
    ARM_FILES,
    another_arm,
    as_data,
    as_entries,
    connect,
    free_arm,
    known_arm,
    restore_arm,
    sentence_of,
    write_arm,
)
from tauext_commission.exchange import BundleExchange, Exchanged
from tauext_commission.folder import CommissionFolder, is_bundle
from tauext_commission.history_file import is_commissioned, lost_words, read_question, unusable_words
from tauext_commission.journal import is_journal
from tauext_commission.journal_lines import is_bundle_name
from tauext_commission.lasting import DESCRIBE_S, LONGEST_RETRY_S, RETRY_S, LastingSource
from tauext_commission.live import LiveSink
from tauext_commission.motion_recorder import MotionRecorder, repaired
from tauext_commission.processes import Child
from tauext_commission.synced_file import set_aside, write_reserved, write_synced
from tauext_commission.trainer import run_trainer

Echo = Callable[[str], None]

BEFORE_S, AFTER_S = 5.0, 2.0
"""Length of a flight around its event."""
CARRIED_S = 10.0
"""Time between two copies of what the next process continues from: drift, factors, load and the alarm that stands."""
SETTLED_S = 3.5
TEND_S = 1.0
AGAIN_S = 600.0
"""Time after which a bundle that could not take over is tried again, [s]."""
HOW_TO_ANSWER = " y or `learn yes`: train again from this change on; x or `learn no`: keep the bundle."
CARRIED = "carried.bin"
NOT_KEPT = (
    "nothing is recorded, trained or stored, answers neither; the newest whole bundle monitors; writing is tried again "
    "each second"
)
"""What a folder that cannot be written means."""
LONGEST_SOCKET = 100
"""Longest path of a socket, [bytes]; systems allow 103 to 107."""


@dataclass(frozen=True)
class Options:
    """Options of the command beside source and folder."""

    robot: Path | None = None
    source: Mapping[str, Any] = field(default_factory=dict)
    """Options of the source that were given, by name."""
    cell: Callable[[tuple[str, ...]], Cell] = lambda joints: Cell()
    """Reads the cell's file for these joints; empty: they are not known yet."""
    page: Callable[..., None] | None = None
    """Target of the page's process; None: no page."""
    address: str = ""
    """Line about the page's address, printed when source and folder are accepted."""
    host: str = "127.0.0.1"
    listening: socket.socket | None = None
    """Where the page's process accepts connections."""
    token: str = ""
    disk_bytes: float = 5e9
    core: int | None = None
    priority: int | None = None
    alarm: AlarmConfig | None = None
    """Budget of false alarms; None: the folder's."""


def run(
    path: Path,
    text: str,
    options: Options,
    echo: Echo,
    listen: Callable[[CurrentLoop], None] = lambda current_loop: None,
) -> None:
    """Commission the arm of this source until Ctrl-C, SIGTERM or the line `stop`; the folder continues where it was.

    Args:
        echo: prints a line.
        listen: called once with the control, for keys of a terminal.

    Raises:
        ConfigError: the folder, an option or the source's text is invalid, another process uses the folder, or the arm
            does not fit a file or an option.
        RobotError: the robot file cannot be read, or lacks a joint of the arm.
    """
    cell = options.cell(())
    first, publishers = open_source(text, options.source, cell=cell)  # refused before a folder is made
    try:
        expect_actions(cell.reactions, first, publishers)
        if text.startswith("replay:") and isinstance(first, Describes):
            first.describe(DESCRIBE_S, options.robot)
    finally:
        first.close()
    if options.robot is not None:
        movable_joints(options.robot)
    folder = CommissionFolder.open(path, create=True)
    if (known := known_arm(folder)) is not None:
        options.cell(known.settings.joints)
    with folder.locked(), ExitStack() as stack:
        stack.callback(folder.close)
        if options.alarm is not None and not folder.unwritable:
            folder.choose(options.alarm, "command")
        commission = Commission(folder, text, options, echo, stack)
        listen(commission.current_loop)
        commission.run()


def repaired_folder(path: Path) -> list[str]:
    """Mend the folder of an arm and accept that lines of its journal are lost; what was done and what is lost.

    Raises:
        ConfigError: it is no such folder, cannot be written, or another process uses it.
    """
    if not is_commissioned(path) and not is_journal(path) and not CommissionFolder(path).is_lost():
        raise ConfigError(f"{path}: is no folder of `tauext commission`, so nothing can be repaired")
    folder = CommissionFolder.open(path, create=True)
    with folder.locked():
        if "arm" in folder.facts:
            restore_arm(folder)
        folder.put_split(repaired(folder))
        folder.fall_back()
        if folder.lost():
            folder.keep_files(*ARM_FILES)
        return [*folder.repair(), f"{path}: the journal is whole; it holds {len(folder.labels())} labels"]


# --- Sockets beside the folder's files.


def socket_folder(folder: Path, stack: ExitStack) -> Path:
    """Where the sockets lie: the folder itself, or a temporary one if its path is too long or it takes no sockets."""
    at = folder.resolve()
    if len(os.fsencode(at / "control.sock")) <= LONGEST_SOCKET:
        trial = at / ".trial.sock"
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as one:
            trial.unlink(missing_ok=True)
            one.bind(str(trial))
            trial.unlink()
            return at
    return Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tauext-")))


def free_sockets(at: Path, folder: CommissionFolder) -> None:
    """Free the places of the sockets from what is no socket."""
    for name in ("live.sock", "control.sock"):
        if os.path.lexists(at / name) and not (at / name).is_socket():
            folder.set_aside(at / name, "it is no socket")


# --- The main process.


class Commission:
    """One run of the command."""

    _noted_lost, _lost_line_s = False, -math.inf
    """Whether the newest line about the source reports its silence, and when such a line was printed: one a minute."""

    def __init__(self, folder: CommissionFolder, text: str, options: Options, echo: Echo, stack: ExitStack):
        self._folder, self._text, self._options, self._echo, self._stack = folder, text, options, echo, stack
        self._asked_to_stop, self._stopping = threading.Event(), threading.Event()
        self._by = ""
        self._record: MotionRecorder | None = None
        self._flights: FlightSink | None = None
        self._source: Source | None = None
        self._loop: Loop | None = None
        at = socket_folder(folder.path, stack)
        free_sockets(at, folder)
        self._live = LiveSink(at / "live.sock")
        stack.callback(self._live.end)
        self._alarm_journal = AlarmJournal(folder, lambda: self._record.epoch if self._record else 0, self._note)
        stack.callback(self._alarm_journal.end)
        self._alarm_journal.learn = self._learn
        self._live.alarm = self._alarm_journal.event
        self.current_loop = CurrentLoop(self._alarm_journal, self.stop)
        self._children: list[Child] = []
        control = ControlSocket(at / "control.sock", self.current_loop, self._origin)
        stack.callback(control.close)
        self._own: dict[str, Any] = {"source": text, "control": str(at / "control.sock"), "live": str(at / "live.sock")}
        self._own["process"] = os.getpid()
        self._save_own()
        if options.page is not None:
            arguments = (
                folder.path,
                at / "live.sock",
                at / "control.sock",
                options.host,
                options.listening,
                options.token,
            )
            self._children.append(Child("page", options.page, arguments))
        self._trainer = Child("training process", run_trainer, (folder.path,), is_low=True)
        self._shown = folder.shown
        self._active = 0
        """Number of the activation whose bundle the loop took."""
        self._exchanged: Exchanged | None = None
        """The newest exchange of the bundle until the history has it; another one comes 10 s later at the earliest."""
        self._why_refused, self._again_s = ("", ""), math.inf
        """The newest bundle that did not take over and why, and the monotonic time at which it is tried again."""
        self._again = False
        self._has_ended = False
        """The source has ended for good."""
        self._failed, self._lost = "", ""
        """The last failure of what is done beside the loop."""
        self._arm: Any = None
        """The description with which the loop runs."""
        self._bundle_stamp: tuple[str, int, int] = ("", 0, 0)
        """Name, size and time of change of the file of the bundle that monitors."""
        self._bundle_file = b""
        """Its content."""
        self._carried_s, self._carried_alarm, self._alarm_s = 0.0, 0, -SETTLED_S
        self._live.remedy = how_to_hold_the_rate(options.core, options.priority)
        self._watched, self._lost_s = MonitoredNews(self._live.remedy), -math.inf

    def _save_own(self) -> None:
        """Write what other programs need of this run; a folder that takes nothing is tried again by _open_folder()."""
        try:
            if not self._folder.unwritable:
                return self._folder.save(**self._own)
        except OSError as error:  # full since it was opened
            self._folder.unwritable = f"{self._folder.path}: cannot be written ({error.strerror or error})"
        self._echo(f"{self._folder.unwritable}: {NOT_KEPT}")
        self._echo(f"control lines go to {self._own['control']}")

    def _origin(self, process: int) -> str:
        """Origin of a control line from this process, for the log."""
        return next((one.name for one in self._children if one.pid == process), CONTROL)

    def run(self) -> None:
        if self._options.address:
            self._echo(self._options.address)
        self._echo(f"{self._text}: connecting; NOTHING IS MONITORED")
        if self._folder.facts.get("arm") and self._options.robot is not None and self._robot() == self._options.robot:
            self._note("--robot is not used: this folder began without a robot file; use a new --out to have one")
        self._show_lost()
        if "arm" in self._folder.facts:
            restore_arm(self._folder)
        self._show_news()
        self._live.message = "connecting: the stream is checked for 3 s before anything is recorded"
        with stopped_by_signals(self.stop):
            tending = threading.Thread(target=self._tend_for_ever, name="commission", daemon=True)
            tending.start()
            try:
                while (connected := self._connect()) and self._monitor(*connected):
                    self._note("the arm's description has changed: connecting again")
            finally:
                self._stopping.set()
                tending.join()

    # Connect.

    def _connect(self) -> tuple[Source, SourceFacts, tuple[Sink, ...]] | None:
        """The source, not open yet, what it delivers and its publishers; None if the run ends before the arm answers.

        A new arm is checked for some seconds, and its description written. An arm that does not answer is tried again
        until it does; lasting errors are raised. An arm that the folder describes need not answer at once: the
        loop waits for it.
        """
        known = known_arm(self._folder)
        source, publishers = self._open()  # refuses a wrong option at once
        try:
            facts = self._described() if known is None else known
            if facts is None:
                source.close()
                return None
            now: SourceFacts | None = facts
            if known is not None and isinstance(source, Describes):
                now = None
                with suppress(TauextError):  # away: the lasting source checks the arm when it is back
                    now = source.describe(DESCRIBE_S, self._robot())
                if now is not None and (other := another_arm(facts, now)) is not None:
                    raise ConfigError(f"{self._folder.path}: {other.words}; {other.remedy}")
        except BaseException:
            source.close()
            raise
        if not self._text.startswith("replay:"):
            lasting = LastingSource(source, self._open_again, facts, self._robot(), is_described=now is not None)
            source = cast(Source, lasting)
        return source, facts, publishers

    def _described(self) -> SourceFacts | None:
        """Describe a new arm in the folder; None if the run ends before the arm answers."""
        free_arm(self._folder)
        wait_s = RETRY_S
        while True:
            try:
                found = connect(self._open_again, self._robot(), check=self._expect_cell, remedy=self._live.remedy)
                break
            except AwayError as error:
                if str(error) != self._live.message:
                    self._live.message = str(error)
                    self._note(f"{error}; it is tried again")
            if self._asked_to_stop.wait(wait_s):
                return None
            wait_s = min(2 * wait_s, LONGEST_RETRY_S)
        write_arm(found.facts, self._robot(), self._folder.path)
        write_synced(self._folder.findings_file, json.dumps({"findings": as_entries(found.lives)}) + "\n")
        for live in found.lives:
            if live.severity in ("fault", "warning"):
                self._note(sentence_of(live))
        self._folder.keep_files(*ARM_FILES)
        self._folder.save(arm=as_data(found.facts))
        return found.facts

    def _expect_cell(self, facts: SourceFacts) -> None:
        """Refuse a cell's file that names other joints."""
        self._options.cell(facts.settings.joints)

    def _open(self) -> tuple[Source, tuple[Sink, ...]]:
        return open_source(self._text, self._options.source, cell=self._options.cell(()))

    def _open_again(self) -> Source:
        return self._open()[0]

    def _robot(self) -> Path | None:
        """The robot file: the folder's once it has one, else the given one, or that of a simulated arm."""
        for name in ("robot.urdf", "robot.xml"):
            if (path := self._folder.path / name).is_file() and not is_placeholder(path):
                return path
        if self._options.robot is not None:
            return self._options.robot
        return robot_file_of(self._text, Path(self._stack.enter_context(tempfile.TemporaryDirectory())))

    # Monitor.

    def _monitor(self, source: Source, facts: SourceFacts, publishers: tuple[Sink, ...]) -> bool:
        """Run the loop to its end; whether the arm is to be connected again."""
        folder, options, live = self._folder, self._options, self._live
        settings, self._arm = facts.settings, json.loads(json.dumps(as_data(facts)))
        bundle = self._first_bundle()
        record = MotionRecorder(folder, settings, source.name, options.disk_bytes, lambda: live.bundle or "")
        recorder = _core.FlightRecorder(len(settings.joints), settings.period_ns, BEFORE_S, AFTER_S, True)
        flights = FlightSink(folder.flights, bundle, recorder, source.name)
        reactions = start_reactions(options.cell(settings.joints).reactions, source, publishers)
        chosen = LoopSettings(acknowledge_after_s=ASKING_S, core=options.core, priority=options.priority)
        sinks = [*publishers, flights, record, self._alarm_journal, live]
        loop = Loop(bundle, source, sinks, reactions, None, recorder, chosen, arm=settings)
        newest = max([self._alarm_journal.newest, *(one.id for one in folder.labels())])  # an event's line may be lost
        loop.note, loop.monitor.alarms = self._note, newest
        self._exchange = BundleExchange(loop, settings, self._keep_exchanged)
        live.describe(settings.joints, settings.torque_units)
        if bundle is not None and isinstance(loop.monitor, _core.Monitor):
            for sink in (live, self._alarm_journal):
                sink.follow(bundle, loop.monitor)
            with suppress(OSError):
                carried = (folder.path / CARRIED).read_bytes()
                is_answered = bool((self._alarm_journal.event(newest) or {}).get("answer"))
                if reason := loop.start_from(carried, newest, is_answered):
                    self._note(f"adaptive bias and alarm of the last run are not continued: {reason}")
        self._source, self._record, self._flights, self._loop = source, record, flights, loop
        self.current_loop.loop = loop
        if self._by:  # stopped meanwhile
            loop.stop(self._by)
        loop.run()
        self._news_of_flights()
        if self._again:
            self._loop = self._source = self.current_loop.loop = None
            self._again = False
            return True
        if not self._by:
            self._has_ended, self.current_loop.loop = True, None  # an ended loop takes no answer
            self._note(f"{source.name} has ended; training continues with what was recorded until Ctrl-C")
            self._asked_to_stop.wait()
        return False

    def _first_bundle(self) -> _core.Bundle | None:
        """The bundle that ran last: the one in charge may still wait for its turn, and is then exchanged again."""
        active = self._folder.fall_back()
        running = self._folder.facts.get("running")
        name = running if is_bundle_name(running) else active.stem if active else None
        for path in (self._folder.bundles / f"{name}.tauext", active):
            if path is not None and name is not None:
                with suppress(TauextError):
                    bundle = _core.Bundle.load(str(path))
                    self._active = self._folder.activation if path == active else 0
                    return bundle
        if self._folder.activation:
            self._note("no bundle of this arm is whole; the arm is not monitored until another one is trained")
        return None

    # Once a second, beside the loop.

    def _tend_for_ever(self) -> None:
        """Linux ends a child with the thread that started it: this one lives until the children are ended."""
        try:
            while not self._stopping.wait(TEND_S):
                failed = ""
                try:
                    self._tend()
                except OSError as error:  # a full disk, for example
                    failed = error.strerror or str(error)
                except Exception as error:
                    failed = f"{type(error).__name__}: {error}"
                if failed not in ("", self._failed):
                    self._note(f"a task beside the monitor failed and is tried again each second: {failed}")
                self._failed = failed
        finally:
            for child in (*self._children, self._trainer):
                child.end()

    def _tend(self) -> None:
        """Each task once, whatever another one raises; then the first error."""
        tasks = (self._tend_children, self._keep_folder, self._show_news, self._show_state, self._tend_loop)
        failed: list[Exception] = []
        for task in tasks:
            try:
                task()
            except Exception as error:
                failed.append(error)
        if failed:
            raise failed[0]

    def _tend_children(self) -> None:
        is_training = self._loop is not None and not self._folder.unwritable
        for child in (*self._children, *([self._trainer] if is_training else [])):
            if text := child.tend():
                self._note(text)

    def _keep_folder(self) -> None:
        """Mend the journal where another program changed it; try again to write a folder that could not be written."""
        if not self._folder.unwritable:
            return self._folder.sync()
        with suppress(OSError):
            self._folder.try_again()
        if self._folder.unwritable:
            return
        self._folder.save(**self._own | {"state": self._live.state})
        self._note(f"{self._folder.path}: can be written again; recording, answers and training go on")

    def _tend_loop(self) -> None:
        self._show_monitored(bool(self._live.lost), time.monotonic())
        if (loop := self._loop) is None:
            return
        self._news_of_flights()
        self._watch_bundle()
        if self._live.bundle is None and not self._again and self._folder.facts.get("arm") != self._arm:
            self._again = True  # the training found that the torque has another unit
            return loop.stop("the training: the torque has another unit")
        self._bring_bundle(self._exchange, time.monotonic())
        self._keep_carried(self._exchange.carried, time.monotonic())

    def _watch_bundle(self) -> None:
        """Write the bundle that monitors again if another program has removed or changed its file."""
        name = self._live.bundle
        if name is None or not is_bundle_name(name):
            return
        path = self._folder.bundles / f"{name}.tauext"
        with suppress(OSError):
            status = path.stat()
            if (stamp := (name, status.st_size, status.st_mtime_ns)) == self._bundle_stamp:
                return
            if is_bundle(path) and (self._bundle_stamp[0] != name or path.read_bytes() == self._bundle_file):
                self._bundle_stamp, self._bundle_file = stamp, path.read_bytes()
                return
        if self._bundle_stamp[0] == name:
            if os.path.lexists(path):
                set_aside(path)
            write_bytes(path, self._bundle_file)
            self._folder.report(f"{path.name} was missing or damaged, and is written again as it monitors")

    def _bring_bundle(self, exchange: BundleExchange, now_s: float) -> None:
        """Bring the bundle in charge into the loop, again if it could not take over; write what took over."""
        path, is_new = self._folder.active(), (now := self._folder.activation) != self._active
        if path is not None and (is_new or (now_s > self._again_s and path.stem != self._live.bundle)):
            self._active, self._again_s = now, math.inf
            exchange.bring(path, lambda why: self._refused(path.stem, why))
        if (done := self._exchanged) is not None:
            self._note_exchange(done)
            self._exchanged = None if self._exchanged is done else self._exchanged  # a full disk leaves it

    def _keep_carried(self, carried: bytes, now_s: float) -> None:
        """Write what the next process continues from now and then, and each second after an alarm rose or fell."""
        if self._live.alarm_number != self._carried_alarm:
            self._carried_alarm, self._alarm_s = self._live.alarm_number, now_s
        is_due = now_s > self._carried_s + CARRIED_S or now_s < self._alarm_s + SETTLED_S
        if is_due and not self._folder.unwritable and carried:
            self._carried_s = now_s
            write_bytes(self._folder.path / CARRIED, carried)

    def _refused(self, bundle: str, why: str) -> None:
        if why and not self._by:
            if (bundle, why) != self._why_refused:
                self._note(f"{bundle} does not take over: {why}")
            self._why_refused, active = (bundle, why), self._folder.active()
            if active is not None and active.stem == bundle:  # else a newer one has its turn
                self._again_s = time.monotonic() + AGAIN_S

    def _keep_exchanged(self, done: Exchanged) -> None:
        """Called in the loop's thread, which must not wait for the disk."""
        self._exchanged = done

    def _note_exchange(self, done: Exchanged) -> None:
        self._folder.save(running=done.bundle)
        replayed_s = done.replayed * self._arm["period_ns"] * 1e-9
        words = f"{done.bundle} monitors the arm now, after a replay of {replayed_s:.0f} s"
        facts = {"bundle": done.bundle, "replaces": done.replaced, "replayed_s": round(replayed_s, 3)}
        self._folder.note("exchange", self._folder.seconds(), words, took_us=round(done.took_us), **facts)

    def _news_of_flights(self) -> None:
        for news in self._flights.news() if self._flights is not None else ():
            self._alarm_journal.flown(news)
            if news.error:
                self._note(f"event log of the {news.what} lost: {news.error}")

    def _show_news(self) -> None:
        """Print what trainings have added to the history."""
        history = self._folder.history()
        for line in history[self._shown :]:
            is_question = line["kind"] == "step" and "learned" not in line
            self._echo(f"{line.get('words')}{HOW_TO_ANSWER if is_question else ''}")
        self._shown = len(history)

    def _show_state(self) -> None:
        live, loop, source = self._live, self._loop, self._source
        lost = "the source has ended" if self._has_ended else getattr(source, "away", "")
        if bool(lost) != self._noted_lost and (not lost or time.monotonic() > self._lost_line_s + MINUTE_S):
            self._note(f"NOTHING IS MONITORED: {lost}" if lost else "samples come again")
            self._noted_lost = bool(lost)
            self._lost_line_s = time.monotonic() if lost else self._lost_line_s
        live.lost = lost
        asks = self._alarm_journal.unanswered
        if loop is None or not loop.samples:
            state = "connecting"
        elif self._question() or (asks is not None and age_s(asks.get("wall")) < ASKING_S):
            state = "asking"
        else:
            state = "learning" if live.bundle is None else "monitoring"
        if state == "learning":
            needs_s = self._folder.coverage().get("needs_s")
            live.message = f"learning: {needs_s:.0f} s more motion until the next training" if needs_s else "learning"
        elif loop is not None:
            live.message = "waiting for the first sample" if state == "connecting" else ""
        if lost := self._show_lost():
            live.message = lost
        if (record := self._record) is not None and record.is_losing:
            live.message = f"RECORDING LOSES SAMPLES: {record.count.error.replace(f'{self._folder.path}/', '')}"
        if self._folder.unwritable:
            live.message = f"{self._folder.unwritable}: {NOT_KEPT}"
        if state != live.state:
            before, live.state = live.state, state
            self._folder.log(f"state: {state}")
            if state in ("learning", "connecting"):
                self._echo(f"{state}: NOTHING IS MONITORED")
            elif before == "connecting":
                self._echo(f"{live.bundle} monitors the arm" if live.bundle else "NOTHING IS MONITORED")
            if not self._folder.unwritable:
                self._folder.save(state=state)

    def _show_lost(self) -> str:
        """Report lines of the journal that are lost; returns the words for the page."""
        lost, path = self._folder.lost(), self._folder.path
        words = f"{lost_words(lost, unusable_words(path))}; " if lost else ""
        words += f"nothing is trained before `tauext commission --out {path} --repair`" if lost else ""
        if words != self._lost:
            self._lost = words
            self._note(words or "journal: the loss is accepted")
        return words

    def _show_monitored(self, is_lost: bool, now_s: float) -> None:
        """Report a loss of monitored time; a source that is away has its own line, and counts in the minute after."""
        self._lost_s = now_s if is_lost else self._lost_s
        if self._loop is not None and now_s > self._lost_s + MINUTE_S:
            if line := self._watched.line(now_s, self._loop.monitored):
                self._note(line)

    # Answers and messages.

    def _question(self) -> dict[str, Any]:
        """The named change that waits for an answer."""
        question = read_question(self._folder.path)
        return {} if question.get("answer") else question

    def _learn(self, yes: bool, by: str) -> None:
        if not self._question():
            raise ConfigError(f"{'learn' if yes else 'leave'}: no change of the arm waits for an answer")
        self._folder.append_reply("learn" if yes else "leave", by)

    def _note(self, text: str) -> None:
        self._folder.log(text)
        self._echo(text)

    def stop(self, by: str) -> None:
        """End the run cleanly; any thread."""
        self._by = by
        self._asked_to_stop.set()
        if self._loop is not None:
            self._loop.stop(by)


def write_bytes(path: Path, content: bytes) -> None:
    """Replace a small file at once; without waiting for the disk, since an older one serves as well."""

    def write() -> None:
        with atomic_write(path) as part:
            part.write_bytes(content)

    write_reserved(path.parent, write)
