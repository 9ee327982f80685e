"""`tauext run`: recordings through the monitor, as a control loop would run it."""

from __future__ import annotations

import sys
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tauext.cli.arguments import BundleArg, RecordingsArg
from tauext.config import require
from tauext.errors import ConfigError, TauextError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tauext._core import Bundle
    from tauext.cli.json_lines import Output
    from tauext.data.recording import Recording
    from tauext.monitor.flight_files import FlightCount, FlightSettings
    from tauext.monitor.loads import TimedLoad
    from tauext.monitor.mcap_log import McapLog
    from tauext.monitor.phases import Phases
    from tauext.monitor.replay import Tally


@dataclass(frozen=True)
class RunSettings:
    """How recordings are replayed."""

    speed: float | None
    own_rate: bool
    acknowledge_after_s: float | None
    flights: FlightSettings | None
    loads: tuple[TimedLoad, ...]
    wrench: str | None
    """Frame at which the force of a touch is reported, too."""
    phases: Phases | None = None
    mcap: Path | None = None
    """File for viewers."""


def run(
    bundle: BundleArg,
    recordings: RecordingsArg,
    real_time: bool = False,
    speed: float | None = None,
    own_rate: bool = False,
    acknowledge_after_s: float | None = None,
    flights: Path | None = None,
    before_s: float = 5.0,
    after_s: float = 1.0,
    contacts: bool = False,
    load: str | None = None,
    loads: Path | None = None,
    phases: Path | None = None,
    wrench: str | None = None,
    mcap: Path | None = None,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
    status_hz: float = 0.0,
) -> None:
    """Replay recordings through the monitor: alarms, health and their causes as a control loop would see them.

    A control loop runs the same core, so replay and loop give the same estimates, sample by sample, at any speed of the
    replay. Each recording starts a new monitor, which warms up for 0.1 to 1 s. A terminal shows a live view. Elsewhere
    the command prints a line an event and a summary.

    Args:
        bundle: bundle (*.tauext) to run.
        recordings: recordings (*.parquet) of the bundle's robot, rate and torque timing.
        real_time: replay at the recorded speed, by the time stamps: the same as --speed 1.
        speed: factor on the recorded speed. None: as fast as possible.
        own_rate: run the network at its own rate (usually 100 Hz) and hold its value in between, for slow processors.
        acknowledge_after_s: seconds after which a collision is acknowledged. None: never. The first collision of a
            recording then stays and hides later ones.
        flights: folder for flights: recording, estimates and a written explanation around every collision and fault.
            Existing files are never overwritten. None: no flights.
        before_s: seconds before the event that a flight keeps.
        after_s: seconds after the event that a flight keeps.
        contacts: also write flights of contacts.
        load: constant payload in the bundle's load frame, such as "mass=2.8 com=0,0,0.05"; optional
            inertia=XX,YY,ZZ,XY,XZ,YZ and error=SHARE. Units: kg, m, kg m^2.
        loads: TOML file of payloads with the times at which they change; docs/loads.md.
        phases: TOML file of contacts that the task means, with their times in the recording; docs/contacts.md.
        wrench: frame of the bundle (a link of the robot file or a joint's frame) at which the force of every touch is
            also reported, with uncertainty and direction. An unknown name prints the available frames.
        mcap: file (*.mcap) for samples, estimates, forces and events, which Foxglove, Rerun and PlotJuggler open.
            None: none is written.
        as_json: print JSON lines, an object an event: start, health, alarm, flight, status, end, summary.
        status_hz: how often --json also prints the estimates, per second of the recording; 0: events only.
    """
    require(speed is None or 1e-6 <= speed <= 1e6, "speed", speed, "> 0: 1e-6 to 1e6")
    require(not real_time or speed is None, "speed", speed, "left out with --real-time, which is speed 1")
    after = acknowledge_after_s
    require(after is None or 0 < after <= 1e6, "acknowledge_after_s", after, "> 0, at most 1e6; left out: never")
    require(0 <= status_hz <= 1e6, "status_hz", status_hz, "0 to 1e6")
    require(status_hz == 0 or as_json, "status_hz", status_hz, "left out unless --json is given")
    require(mcap is None or len(recordings) == 1, "mcap", mcap, "left out, or given with one recording")
    from tauext.monitor.flight_files import FlightSettings
    from tauext.monitor.phases import phases_of
    from tauext.monitor.touch_place import PlaceFinder

    loaded = fitting_bundle(bundle, recordings)
    if mcap is not None:
        from tauext.monitor.mcap_log import expect_log

        expect_log(mcap)
    kept = None if flights is None else FlightSettings(flights, before_s, after_s, contacts)
    carried = timed_loads(loaded, load, loads)
    expected, unmonitored = phases_of(phases, loaded)
    settings = RunSettings(1.0 if real_time else speed, own_rate, after, kept, carried, wrench, expected, mcap)
    PlaceFinder(loaded, wrench)  # refuses an unknown frame before anything is replayed
    if kept is not None:
        kept.recorder(loaded)
    with open_output(as_json, status_hz, flights, after is not None) as output:
        for words in unmonitored:
            print(f"tauext: {words}", file=sys.stderr)
        replay_all(loaded, recordings, settings, output)


def timed_loads(bundle: Bundle, load: str | None, loads: Path | None) -> tuple[TimedLoad, ...]:
    """Loads of the arm, with the times from which on it carries them.

    Raises:
        ConfigError: it cannot be read, or the bundle takes no such load.
    """
    from tauext.monitor.loads import TimedLoad, expect_load, load_of_text, read_loads

    require(load is None or loads is None, "load", load, "left out where --loads gives a file of them")
    listed = (
        [TimedLoad(0.0, load_of_text(load))] if load is not None else read_loads(loads) if loads is not None else []
    )
    for one in listed:
        expect_load(bundle.load_settings, one.load)
    return tuple(listed)


def open_output(as_json: bool, status_hz: float, flights: Path | None, acknowledges: bool) -> Output:
    """JSON lines if as_json, a live view on a terminal, else lines of text."""
    if as_json:
        from tauext.cli.json_lines import JsonLines

        return JsonLines(status_hz)
    if sys.stdout.isatty():
        from tauext.cli.live_view import LiveView

        return LiveView(flights, acknowledges)
    from tauext.cli.text_lines import TextLines

    return TextLines(flights, acknowledges)


def fitting_bundle(path: Path, recordings: tuple[Path, ...]) -> Bundle:
    """Load the bundle, and check by the head of every recording that it fits.

    Raises:
        ConfigError: no recording.
        BundleError: no such bundle; joints, rate or torque timing of a recording are not the bundle's.
    """
    from tauext.bundle.bundle_file import load_bundle
    from tauext.bundle.match import expect_fit
    from tauext.data.recording_file import describe

    if not recordings:
        raise ConfigError("there is nothing to replay: give one or more recordings (*.parquet) after the bundle")
    bundle = load_bundle(path)
    for recording in recordings:
        expect_fit(bundle, describe(recording))
    return bundle


def replay_all(bundle: Bundle, recordings: tuple[Path, ...], settings: RunSettings, output: Output) -> None:
    """One recording after the other; after an interruption or a damaged one, still the summary of what was done.

    Raises:
        ConfigError: some flights could not be written.
    """
    from tauext.data.recording_file import load_recording
    from tauext.monitor.flight_files import FlightCount
    from tauext.monitor.replay import Tally

    total = Tally(
        tuple(link.joint_name for link in bundle.links), bundle.observer.sample_period_ns, tuple(bundle.estimate_units)
    )
    flights, done, stopped = FlightCount(), 0, None
    try:
        for number, path in enumerate(recordings, 1):
            recording = load_recording(path)
            output.start(bundle, recording, number, len(recordings))
            replay_one(bundle, recording, settings, total, flights, output)
            done += 1
    except (KeyboardInterrupt, TauextError) as error:
        stopped = error
    output.total(total, flights, done, interrupted=stopped is not None)
    if isinstance(stopped, KeyboardInterrupt):
        raise KeyboardInterrupt("the summary covers the motion replayed until then; its flights are kept")
    if stopped is not None:
        raise stopped
    flights.expect_all_written()


def replay_one(
    bundle: Bundle, recording: Recording, settings: RunSettings, total: Tally, all_flights: FlightCount, output: Output
) -> None:
    """One recording through a new monitor, with a new flight recorder; counted in full even if it ends early."""
    from tauext import _core
    from tauext.monitor.flight_files import FlightCount, FlightSource, FlightWriter, write_flight
    from tauext.monitor.replay import CHUNK_S, PACED_CHUNK_S, Pace, Tally, replay
    from tauext.monitor.source import settings_of
    from tauext.monitor.touch_place import PlaceFinder
    from tauext.monitor.turns import Turns

    turns = Turns(settings_of(bundle), bundle)
    q, _ = turns.rows(recording.t_ns, recording.q)
    if q is not recording.q:
        recording = replace(recording, q=q)
    unused = [] if settings.phases is None else settings.phases.after_the_end(recording.duration_s, recording.name)
    for text in (*turns.notes(), *unused):
        output.note(text)
    monitor = _core.Monitor(bundle, settings.own_rate)
    tally, flights = Tally(total.joints, total.sample_period_ns, total.units), FlightCount()
    recorder = writer = None
    chunk_s = CHUNK_S if settings.speed is None else PACED_CHUNK_S * settings.speed
    if (kept := settings.flights) is not None:
        recorder = kept.recorder(bundle)
        source = FlightSource.of(bundle, recording)
        writer = FlightWriter(recorder, partial(write_flight, folder=kept.folder, source=source))
        chunk_s = min(chunk_s, max(kept.after_s, PACED_CHUNK_S))

    def print_flights() -> None:
        for news in writer.news() if writer is not None else ():
            flights.add(news)
            output.flight(news)

    pace, places = Pace(settings.speed), PlaceFinder(bundle, settings.wrench)
    after_s = settings.acknowledge_after_s
    try:
        with writer or nullcontext(), logged(bundle, recording, settings, output) as log:
            for chunk in replay(
                monitor, recording, pace, recorder, after_s, chunk_s, settings.loads, places, settings.phases
            ):
                tally.add(chunk, monitor)
                if log is not None:
                    rows = slice(chunk.first_row, chunk.first_row + len(chunk.t_ns))
                    samples = (recording.q[rows], recording.dq[rows], recording.tau[rows])
                    log.add(chunk.t_ns, *samples, chunk.estimates, chunk.changes)
                if writer is not None:
                    writer.catch_up()
                output.chunk(chunk, tally)
                print_flights()
    finally:
        print_flights()
        if recorder is not None:
            flights.missed += recorder.missed
        total.merge(tally)
        all_flights.merge(flights)
        output.end(tally, flights, complete=tally.samples == recording.samples)


@contextmanager
def logged(bundle: Bundle, recording: Recording, settings: RunSettings, output: Output) -> Iterator[McapLog | None]:
    """The MCAP file of a replay, closed also after an interruption; None without one."""
    if settings.mcap is None:
        yield None
        return
    from tauext.monitor.mcap_log import McapLog

    log = McapLog(settings.mcap, bundle, recording.name, settings.wrench)
    if log.without:
        output.note(f"{settings.mcap.name}: {log.without}")
    try:
        yield log
    finally:
        log.close()
        output.note(f"{settings.mcap}: {log.samples:,} samples")
