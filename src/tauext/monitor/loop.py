"""The live loop: passes samples to the monitor and its verdicts to sinks and reactions."""

from __future__ import annotations

import gc
import math
import queue
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, cast

import numpy as np

from tauext import _core
from tauext.bundle.estimates import OK
from tauext.config import require
from tauext.errors import ConfigError, TauextError
from tauext.monitor.cell_file import Profile, Profiles
from tauext.monitor.changes import WeighChange
from tauext.monitor.episode import Acknowledgement, EpisodeFinder
from tauext.monitor.event_stream import Chunk, EventStream
from tauext.monitor.latency import Latencies, ask_for_real_time
from tauext.monitor.loads import Expected, TimedLoad
from tauext.monitor.monitored_time import LATE_S, Monitored, MonitoredTime
from tauext.monitor.no_monitor import NO_BUNDLE, AnyMonitor, NoMonitor
from tauext.monitor.phases import Announced, Phases, bounds_words
from tauext.monitor.reactions import Reactions
from tauext.monitor.sink import (
    USUAL_REACH_M,
    AnswerKind,
    EventFinder,
    Follows,
    LoopReport,
    Sink,
    Verdict,
)
from tauext.monitor.source import (
    Block,
    Commanded,
    CountedTime,
    Recorded,
    Source,
    SourceSettings,
    blocks_of,
    servo_stage,
    settings_of,
)
from tauext.monitor.touch_place import PlaceFinder
from tauext.monitor.turns import Turns

# --- Verdicts as chunks, for output and statistics.


def chunk_of(verdicts: Sequence[Verdict]) -> Chunk:
    """Combine successive verdicts, at least one; the speed of a missing sample is NaN."""
    first = verdicts[0]
    if len(verdicts) == 1 and first.block is not None:
        return Chunk(first.row, first.t_ns, first.block.dq, dict(first.estimates), list(first.changes), first.core_s)
    estimates = {key: np.concatenate([one.estimates[key] for one in verdicts]) for key in first.estimates}
    unknown = np.full((1, estimates["tau_ext"].shape[1]), np.nan)
    dq = np.concatenate([unknown if one.block is None else one.block.dq for one in verdicts])
    changes = [change for one in verdicts for change in one.changes]
    core_s = sum(one.core_s for one in verdicts)
    return Chunk(first.row, np.concatenate([one.t_ns for one in verdicts]), dq, estimates, changes, core_s)


# --- The loop. Sinks and reactions of a live arm never delay the monitor.


IDLE_S = 0.1
"""Interval of checks for requests while no sample comes."""


@dataclass(frozen=True)
class LoopSettings:
    """Settings of the loop: time, alarms, real-time priority."""

    own_rate: bool = False
    """Whether to run the network at its own rate, for slow processors."""
    missing_after_s: float | None = None
    """Time after a sample when the next one counts as missing, [s]; None: two periods, or a period and 2 ms if
    longer."""
    acknowledge_after_s: float | None = None
    """Time of its samples after which a collision is acknowledged, [s]; None: only on request."""
    duration_s: float | None = None
    """Duration of the loop, [s]; None: until the source ends, or on request."""
    core: int | None = None
    """Core of the loop and of threads and processes that the source starts."""
    priority: int | None = None
    """Real-time priority of these threads and processes."""
    wrench: str | None = None
    """Frame at which the force of a touch is also estimated; None: none."""
    block_s: float = 0.1
    """Longest time of the samples that are judged at once, [s]: requests are executed between two blocks. 0: a sample
    at a time."""


@dataclass(frozen=True)
class ProfileSwitch:
    """A change to another profile, from the next sample on."""

    t_ns: int | None
    """Stamp of the sample before it, by the source's clock, [ns]; None: no sample yet."""
    by: str
    old: str
    new: str


class BundleSupply(Protocol):
    """Brings other bundles into a running loop, by Loop.take_over(); the loop's thread calls all of this."""

    def start(self) -> None:
        """Begin; threads that start here get no real-time core and priority."""

    def end(self) -> None:
        """The loop has ended."""

    def judged(self, block: Block, estimates: dict[str, np.ndarray]) -> None:
        """The loop's monitor has judged these samples."""

    def missed(self, t_ns: int) -> None:
        """A sample did not come."""

    def load_set(self, load: _core.Load, since_ns: int | None) -> None:
        """The loop has set a load in its monitor."""

    def resumed(self) -> None:
        """The loop has resumed its monitor."""


class Loop:
    """Runs a bundle's monitor on a source until that ends, or until a stop request or Ctrl-C.

    The control of the loop (use_profile, acknowledge, resume, set_load, weigh, stop) may be called by any thread.
    """

    supply: BundleSupply | None = None
    """What brings other bundles; set it before run()."""
    missing = samples = 0
    monitored = Monitored()
    """Share of the time in which the arm was monitored, once a second."""
    profile: Profile | None = None
    """The active profile."""
    stopped = False
    """Whether a request ended the loop, not its source or its duration."""
    last_t_ns: int | None = None
    """Stamp of the last sample, [ns]; None: none came yet."""
    _received_ns = 0
    """Its reception, by time.monotonic_ns()."""

    def __init__(
        self,
        bundle: _core.Bundle | None,
        source: Source,
        sinks: Sequence[Sink] = (),
        reactions: Reactions | None = None,
        profiles: Profiles | None = None,
        recorder: _core.FlightRecorder | None = None,
        settings: LoopSettings = LoopSettings(),
        arm: SourceSettings | None = None,
        phases: Phases | None = None,
        loads: Sequence[TimedLoad] = (),
    ):
        """Raises ConfigError where the parts do not fit each other.

        Args:
            bundle: None with an arm: nothing is monitored until take_over() brings one.
            recorder: receives every sample, and NaN for a missing one; the caller takes its flights.
            arm: what the source delivers, whatever the bundle; None: what the bundle expects.
            phases: contacts that the task means.
            loads: of the arm in a recording, with the times from which on it carries them.
        """
        if bundle is None and arm is None:
            raise ConfigError("a loop needs a bundle, or an arm that waits for one")
        self._arm = arm or settings_of(cast(_core.Bundle, bundle))
        self.joints, self.bundle, self.settings = self._arm.joints, bundle, settings
        self.monitor: AnyMonitor = NoMonitor(self._arm) if bundle is None else _core.Monitor(bundle, settings.own_rate)
        self.sinks = list(sinks)
        """Sinks in the order in which they receive verdicts; add before run()."""
        self.note: Callable[[str], None] = lambda text: None
        """Called in the loop's thread with messages for the user; set it and `switched` before run()."""
        self.switched: Callable[[ProfileSwitch], None] = lambda switch: None
        """Called in the loop's thread with every new profile."""
        self._source, self._recorded, self._loads = source, source if isinstance(source, Recorded) else None, loads
        self._turns, self._servo = Turns(self._arm, bundle), servo_stage(self._arm, self._recorded)
        self._profiles, self._recorder = profiles, recorder
        self._reactions, self._reacts = reactions or Reactions(), reactions is not None
        self._requests: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        """Requests that the loop's thread executes before the next sample."""
        places = None if bundle is None else PlaceFinder(bundle, settings.wrench)
        if reason := self.why_refused(self.monitor, places):
            raise ConfigError(reason)
        self._changes = EventStream(self.monitor, places, phases)
        self._facts = {"bundle": "" if bundle is None else bundle.name, "source": source.name}
        self._events, self._episodes = EventFinder(self.joints, self._facts), EpisodeFinder(self._facts["bundle"])
        self._acknowledgement = Acknowledgement(settings.acknowledge_after_s)
        self._time, self._jumps = CountedTime(self._arm.period_ns), 0
        self._timed = set[str]()
        """What was requested for a time since the last jump of the stamps, for the note at the next one."""
        period_s = self.monitor.sample_period_ns * 1e-9
        self._most_rows = max(1, round(settings.block_s / period_s))
        self._missing_after_s = settings.missing_after_s or period_s + max(period_s, 0.002)
        self.tick, self._second = Latencies(), Latencies()
        """Time from a sample's reception until every sink has received its verdict, from the start and in a second."""
        self._watched = MonitoredTime(self._missing_after_s)

    # Control: any thread; see Control.

    def use_profile(self, name: str, by: str) -> None:
        if self._profiles is None:
            raise ConfigError(f"profile {name!r}: no profiles are loaded; `tauext monitor --cell FILE` reads some")
        self._profiles.named(name)
        self._requests.put(lambda: self._switch(name, by))

    def acknowledge(self, by: str) -> None:
        self._requests.put(lambda: self._end_alarm(self.monitor.acknowledge, f"acknowledged by {by}"))

    def resume(self, by: str) -> None:
        self._requests.put(lambda: self._resume(by))

    def set_load(self, load: _core.Load, by: str, ago_s: float | None = None) -> None:
        if reason := self.monitor.why_no_load(load, None if ago_s is None else 0):
            raise ConfigError(reason)
        self._requests.put(lambda: self._carry(load, ago_s, by))

    def expect_load(self, expected: Expected, by: str) -> None:
        if reason := self.monitor.why_not_expected(expected.seconds, expected.at_most):
            raise ConfigError(reason)
        self._requests.put(lambda: self._expect(expected, by))

    def declare(self, announced: Announced, by: str) -> None:
        if self.supply is not None:
            raise ConfigError("contact: an arm that is being commissioned learns from its motion; use `tauext monitor`")
        named = self._changes.phases.named(announced.name) if announced.name else None
        contact = announced.contact if named is None else named.contact
        if contact is not None and (reason := self._real.why_no_contact(contact, announced.seconds)):
            raise ConfigError(reason)
        self._requests.put(lambda: self._declare(announced, contact, by))

    def why_refused(self, monitor: AnyMonitor, places: PlaceFinder | None) -> str:
        """Reason why profiles or reactions do not work with this monitor; empty: they do."""
        for profile in self._profiles.by_name.values() if self._profiles else ():
            load, expect = profile.load, profile.expect
            reason = "" if load is None else monitor.why_no_load(load)
            if expect is not None:
                reason = reason or monitor.why_not_expected(expect.seconds, expect.at_most)
            if reason:
                return f"profile {profile.name}: {reason}"
        if places is not None and places.refused:
            for rule in (thread.reaction for thread in self._reactions.threads):
                if rule.links is not None or rule.newtons_over is not None:
                    return f"reaction {rule.name!r}: the place of a touch cannot be estimated: {places.refused}"
        return ""

    def weigh(self, what: str, by: str, reach_m: float = USUAL_REACH_M) -> None:
        if reason := self.monitor.why_no_weighing():
            raise ConfigError(reason)
        require(
            1e-3 <= reach_m <= 100, "reach", reach_m, "0.001 to 100 m, how far away a payload's centre of mass may be"
        )
        self._requests.put(lambda: self._weigh(what, reach_m, by))

    def answer(self, what: AnswerKind, by: str, alarm: int | None = None) -> None:
        raise ConfigError(f"{what}: answers are kept by `tauext commission` only")

    def settle(self, alarm: int, answer: str) -> None:
        """Acknowledge this alarm, which a person has answered, if it stands: once its touch is over, so that the touch
        raises no second alarm.

        Args:
            answer: what was answered, and its origin, for the log.
        """
        self._requests.put(lambda: self._settle(alarm, answer))

    def command(self, text: str, by: str) -> None:
        if not isinstance(self._source, Commanded):
            raise ConfigError(f"{text[:60]!r}: source {self._source.name} takes no commands; sim:ARM does")
        self._source.command(text)

    def stop(self, by: str) -> None:
        self._requests.put(lambda: self._stop(by))

    def request(self, act: Callable[[], None]) -> None:
        """Have the loop's thread do this before the next sample; any thread."""
        self._requests.put(act)

    def start_from(self, carried: bytes, alarms: int, is_answered: bool = False) -> str:
        """Before run(): continue what an earlier loop's `carried` holds; returns "" or the reason why it cannot.

        Args:
            alarms: number of the newest alarm, which is the one that stands if one does.
            is_answered: whether that alarm is answered, so that it ends with its touch.
        """
        self.monitor.alarms = alarms
        if not isinstance(self.monitor, _core.Monitor):
            return NO_BUNDLE
        try:
            self.monitor.carry(carried)
            self.monitor.carry_alarm(carried)
        except _core.CoreError as error:
            return str(error)
        last = self.monitor.last
        if last.alarm != _core.Alarm.none:
            self.monitor.alarms = number = max(alarms, 1)
            self._acknowledgement.answered = number if is_answered else 0
            self._changes.stand(last.alarm.value, number)
            self._episodes.stand(number, last.alarm.value, last.alarm_joint)
        return ""

    @property
    def alarms(self) -> int:
        """Number of alarms so far, which is the newest one's number."""
        return self.monitor.alarms

    # The loop: one thread.

    def run(self) -> None:
        """Open the source and all sinks, run, and close them in any case.

        Raises:
            KeyboardInterrupt: Ctrl-C, after everything was closed.
            ConfigError: the source cannot be opened.
        """
        opened: list[Sink] = []
        interval = sys.getswitchinterval()
        try:
            if self._profiles is not None:
                self._switch(self._profiles.start, "start")
            if isinstance(self.monitor, _core.Monitor):
                self._start_phases(self.monitor)
            for sink in self.sinks:
                sink.open(self.joints, self)
                opened.append(sink)
            self._sinks_follow()
            if self.supply is not None:  # before a core and a priority are taken, which threads inherit
                self.supply.start()
            for text in ask_for_real_time(self.settings.core, self.settings.priority):
                self.note(text)
            self._source.open(self._arm)
            sys.setswitchinterval(0.0005)  # of the interpreter's threads; Python's default of 5 ms is five samples
            gc.collect()
            gc.freeze()  # excludes present objects from collections during the loop
            self._run()
        finally:
            gc.unfreeze()
            if self.supply is not None:
                self.supply.end()
            sys.setswitchinterval(interval)
            self.monitored = self._watched.second()
            self._source.close()
            self._forward_notes()
            self._reactions.end()
            for sink in opened:
                try:
                    sink.close()
                except Exception as error:
                    self.note(f"{type(sink).__name__} failed at its end: {type(error).__name__}: {error}")

    def _start_phases(self, monitor: _core.Monitor) -> None:
        """Declare what is always on; the times of a recording begin with its first sample."""
        phases = self._changes.phases
        if self._recorded is not None:
            recording = self._recorded.recording
            notes = phases.after_the_end(recording.duration_s, recording.name)
        else:
            phases.start(monitor)
            notes = phases.without_recording()
        for text in notes:
            self.note(text)

    def _run(self) -> None:
        started = second = time.monotonic()
        due = math.inf
        before = 0
        while not self._source.ended:
            while not self._requests.empty():
                self._do(self._requests.get())
            if self.stopped:
                return
            now = time.monotonic()
            taken = self.samples
            for block, is_sized in self._take(max(0.0, min(due - now, second + 1 - now, IDLE_S))):
                self._block(block, is_sized)
            if self.samples > taken:
                due = self._received_ns * 1e-9 + self._missing_after_s
            else:
                now = time.monotonic()
                if now >= due and self.last_t_ns is not None and not self._source.ended:
                    due = now + self._missed(now)
            now = time.monotonic()
            if now >= second + 1:
                self._report((self.samples - before) / (now - second))
                second, before = now, self.samples
            if self.settings.duration_s is not None and now >= started + self.settings.duration_s:
                return

    def _do(self, request: Callable[[], None]) -> None:
        """A bundle that came after a request was accepted may refuse it."""
        try:
            request()
        except TauextError as error:
            self.note(str(error))

    def _take(self, timeout_s: float) -> Iterable[tuple[Block, bool]]:
        """The next sample, and after a late one those that have come since, as blocks_of() returns them; empty: none
        came within this time."""
        if self._recorded is not None:
            block = self._recorded.next_block(timeout_s, self._most_rows)
            return [] if block is None else [(block, True)]
        first = self._source.next_sample(timeout_s)
        if first is None:
            return []
        samples = [first]
        if time.monotonic_ns() - first.received_ns > self._arm.period_ns:
            while len(samples) < self._most_rows and (one := self._source.next_sample(0.0)) is not None:
                samples.append(one)
        return blocks_of(samples, len(self.joints))

    def _block(self, block: Block, is_sized: bool) -> None:
        """Judge successive samples, as many at once as nothing must be done between.

        Args:
            is_sized: whether they have one value for each joint; else they are faults, and sinks and the next bundle
                get NaN.
        """
        if is_sized:
            block = self._turns.made(block)
            if self._servo is not None:
                block = self._servo.made(block)
        times_ns = self._time.steps(block.t_ns)
        if self._recorded is not None and not self.samples:
            self._changes.schedule(int(block.t_ns[0]), self._loads)
        begin = 0
        while begin < len(block):
            self._acknowledge_when_due(int(times_ns[begin]))
            end = begin + self._rows_at_once(block.t_ns[begin:], times_ns[begin:], is_sized)
            self._judge(block[begin:end], times_ns[begin:end], is_sized)
            begin = end

    def _rows_at_once(self, t_ns: np.ndarray, times_ns: np.ndarray, is_sized: bool) -> int:
        """Do what is due before these samples; number of them, at least one, before any of which nothing is due."""
        next_ns = self._changes.act_when_due(self.samples, int(t_ns[0]))
        rows = self._acknowledgement.rows(times_ns) if is_sized else 1
        if rows > 1 and next_ns is not None:
            rows = min([rows, *(1 + np.flatnonzero(t_ns[1:rows] >= next_ns)[:1]).tolist()])
        return rows

    def _judge(self, block: Block, times_ns: np.ndarray, is_sized: bool) -> None:
        """Run the monitor on these samples, and publish what it finds.

        Args:
            times_ns: their counted times.
        """
        began_ns = time.monotonic_ns()
        if is_sized:
            signals = (block.t_ns, block.q, block.dq, block.tau)
            estimates = self.monitor.run(*signals, self._recorder, block.temperature)
        else:
            estimates = self.monitor.run_wrong_size(int(block.t_ns[0]), self._recorder)
        core_s = (time.monotonic_ns() - began_ns) * 1e-9
        self.last_t_ns, self._received_ns = int(block.t_ns[-1]), int(block.received_ns[-1])
        if self.monitor.clock_jumps != self._jumps:
            self._note_jump()
        if self.supply is not None:
            self.supply.judged(block, estimates)
        self._publish(block.t_ns, block, times_ns, estimates, core_s)
        self.samples += len(block)
        now_ns = time.monotonic_ns()
        ages_ns = now_ns - block.received_ns
        self.tick.add_all(ages_ns)
        self._second.add_all(ages_ns)
        valid = np.count_nonzero((estimates["health"] == OK) & (ages_ns <= LATE_S * 1e9))
        self._watched.add(now_ns, valid / len(block), int(np.bitwise_or.reduce(estimates["causes"])))

    def _missed(self, now: float) -> float:
        """Report a missing sample to the monitor; returns the time to wait, [s], which grows while none comes."""
        assert self.last_t_ns is not None  # silence counts from a sample
        self.missing += 1
        silent_s = now - self._received_ns * 1e-9
        t_ns = self.last_t_ns + round(silent_s * 1e9)
        time_ns = self._time.step(t_ns)
        self._acknowledge_when_due(time_ns)
        if self.supply is not None:
            self.supply.missed(t_ns)
        estimates = self.monitor.run_missing(t_ns, self._recorder)
        self._publish(np.array([t_ns]), None, np.array([time_ns]), estimates)
        self._watched.miss(time.monotonic_ns(), int(estimates["causes"][0]))
        return max(self.monitor.sample_period_ns * 1e-9, min(IDLE_S, silent_s / 10))

    def take_over(self, bundle: _core.Bundle, monitor: _core.Monitor, places: PlaceFinder) -> None:
        """Continue with this bundle's monitor, between two samples; in the loop's thread."""
        self._changes.exchange(monitor, places)
        self.monitor, self.bundle = monitor, bundle
        self._jumps = monitor.clock_jumps
        self._turns.follow(bundle)
        self._facts["bundle"] = self._episodes.bundle = bundle.name
        self._sinks_follow()

    def _publish(
        self,
        t_ns: np.ndarray,
        block: Block | None,
        times_ns: np.ndarray,
        estimates: dict[str, np.ndarray],
        core_s: float = 0.0,
    ) -> None:
        """Changes, then events to reactions, which must not wait, then the verdict to sinks."""
        q, dq = (None, None) if block is None else (block.q, block.dq)
        changes = self._changes.find(self.samples, t_ns, estimates, q, dq)
        news = self._episodes.find(self.samples, t_ns, estimates, changes, q)
        self._acknowledgement.follow(news, times_ns, estimates["alarm"])
        verdict = Verdict(self.samples, t_ns, block, estimates, tuple(changes), self._episodes.standing, news, core_s)
        if self._reacts:
            for event in self._events.find(verdict):
                self._reactions.put(event)
        self._each_sink(lambda sink: sink.verdict(verdict))

    def _report(self, rate_hz: float) -> None:
        """Send the report of the last second."""
        quantiles = (self._second.quantile_us(0.5), self._second.quantile_us(0.99))
        longest = self._second.max_ns * 1e-3 if self._second.count else math.nan
        name = self.profile.name if self.profile else ""
        counts = replace(self._source.counts)
        now_ns = time.monotonic_ns()
        times = (*quantiles, longest)
        self.monitored = self._watched.second()
        report = LoopReport(now_ns, self.samples, self.missing, rate_hz, counts, *times, name, self.monitored)
        self._second = Latencies()
        self._forward_notes()
        self._each_sink(lambda sink: sink.every_second(report))

    def _each_sink(self, call: Callable[[Sink], None]) -> None:
        """Call every sink; a sink that raises is not called again."""
        for sink in tuple(self.sinks):
            try:
                call(sink)
            except Exception as error:
                self.sinks.remove(sink)
                self.note(f"{type(sink).__name__} is left out from here on: {type(error).__name__}: {error}")

    def _sinks_follow(self) -> None:
        """Pass on the bundle that monitors from here on."""
        if (bundle := self.bundle) is not None:
            self._each_sink(lambda sink: sink.follow(bundle, self._real) if isinstance(sink, Follows) else None)

    def _forward_notes(self) -> None:
        for text in (*self._source.notes(), *self._turns.notes()):
            self.note(text)

    # Requests.

    def _stop(self, by: str) -> None:
        if not self.stopped:
            self.note(f"stopped by {by}")
        self.stopped = True

    def _settle(self, alarm: int, answer: str) -> None:
        if alarm != self._standing:
            return
        if self.monitor.last.touch_over:
            self._end_alarm(self.monitor.acknowledge, f"{answer}: acknowledged")
        else:  # the monitor would raise another alarm for the same touch
            self._acknowledgement.answered = alarm
            self.note(f"{answer}: acknowledged once the touch is over")

    def _switch(self, name: str, by: str) -> None:
        assert self._profiles is not None  # or use_profile() had refused it
        old, new = self.profile, self._profiles.named(name)
        self.profile = new
        self.monitor.set_limit_factors(new.collision, new.contact)
        if new.load is not None:
            self._carry(new.load, None, f"profile {name}")
        if new.expect is not None:
            self._expect(new.expect, f"profile {name}")
        self.switched(ProfileSwitch(self.last_t_ns, by, old.name if old else "", name))

    @property
    def _real(self) -> _core.Monitor:
        """The monitor of a bundle; without one, the request before had been refused."""
        if not isinstance(self.monitor, _core.Monitor):
            raise ConfigError(NO_BUNDLE)
        return self.monitor

    def _expect(self, expected: Expected, by: str) -> None:
        self._real.expect_load(expected.seconds, expected.at_most)
        self._timed.add("the expected load")
        self.note(f"a payload of at most {expected.at_most:g} kg is expected for {expected.seconds:g} s, by {by}")

    def _declare(self, announced: Announced, contact: _core.DeclaredContact | None, by: str) -> None:
        phases, name = self._changes.phases, announced.name
        if announced.ends or contact is None:
            ended = phases.end(self._real, name)
            self.note(f"{ended} expected contact{'s' * (ended != 1)} ended, by {by}")
            return
        phases.declare(self._real, name, contact, announced.seconds)
        if math.isfinite(announced.seconds):
            self._timed.add("the expected contact")
        for_s = f" for {announced.seconds:g} s" if math.isfinite(announced.seconds) else ""
        hidden = self._real.unmonitored(contact)
        self.note(f"a contact {bounds_words(contact)}{for_s} is expected, by {by}{f'; {hidden}' * bool(hidden)}")

    def _carry(self, load: _core.Load, ago_s: float | None, by: str) -> None:
        since_ns = None if ago_s is None else self._last_ns - round(ago_s * 1e9)
        self._changes.carry(load, self.samples, self._last_ns, by, since_ns)
        if self.supply is not None:
            self.supply.load_set(load, since_ns)

    @property
    def _last_ns(self) -> int:
        return self.last_t_ns or 0

    def _weigh(self, what: str, reach_m: float, by: str) -> None:
        if what == "start":
            self._real.start_weighing(reach_m)
            self._timed.add("weighing")
        elif what == "stop":
            self._real.stop_weighing()
            self._timed.discard("weighing")
        found = None if what == "start" else self._real.estimate_load()
        frame = self._real.load_settings.frame
        self._changes.note(WeighChange(self.samples, self._last_ns, what, by, frame, self.monitor.load, found))

    def _resume(self, by: str) -> None:
        self._end_alarm(self.monitor.resume, f"resumed by {by}")
        if self.supply is not None:
            self.supply.resumed()

    @property
    def _standing(self) -> int:
        """Number of the alarm that stands; 0: none."""
        return 0 if self._episodes.standing is None else self._episodes.standing.number

    def _note_jump(self) -> None:
        """What lasts for a time has ended in the core: a stamp of the old clock is no end of it."""
        self._jumps = self.monitor.clock_jumps
        if self._timed:
            what = " and ".join(sorted(self._timed))
            self.note(f"the time stamps jumped: {what} ended, if it had not before; ask for it again")
        self._timed.clear()

    def _acknowledge_when_due(self, now_ns: int) -> None:
        """now_ns: counted time of the next sample."""
        one = self._acknowledgement
        if one.is_due(now_ns, self._standing) or (one.answered and self.monitor.last.touch_over):
            self._end_alarm(self.monitor.acknowledge)

    def _end_alarm(self, end: Callable[[], None], note: str = "") -> None:
        if note:
            self.note(note)
        self._acknowledgement.end()
        self._changes.end_alarm(end, self.samples, self._last_ns)
