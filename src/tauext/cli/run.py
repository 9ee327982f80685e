"""`tauext run`: recordings through the monitor, as a control loop would run it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Annotated

import tyro

from tauext.cli.place_argument import PlaceArg
from tauext.cli.run_settings import RunSettings
from tauext.config import require
from tauext.errors import ConfigError, TauextError
from tauext.files.copies import added
from tauext.files.places import Place

if TYPE_CHECKING:
    from tauext._core import Bundle
    from tauext.cli.run_text import FlightCount, Output
    from tauext.data.recording import Recording
    from tauext.monitor.flight_files import FlightWriter
    from tauext.monitor.loads import TimedLoad
    from tauext.monitor.replay import Tally


def run(
    bundle: tyro.conf.Positional[PlaceArg],
    recordings: tyro.conf.Positional[tuple[PlaceArg, ...]],
    real_time: bool = False,
    speed: float | None = None,
    own_rate: bool = False,
    acknowledge_after_s: float | None = None,
    flights: PlaceArg | None = None,
    before_s: float = 5.0,
    after_s: float = 1.0,
    contacts: bool = False,
    load: str | None = None,
    loads: PlaceArg | None = None,
    wrench: str | None = None,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
    status_hz: float = 0.0,
) -> None:
    """Replay recordings through the monitor: alarms, health and their causes as a control loop would see them.

    The same core runs in the loop, so what is said here is said there, sample by sample, however fast the replay. Every
    recording begins with a monitor that knows nothing: it warms up for about a second. On a terminal a live view is
    shown; elsewhere a line an event, and a summary at the end.

    Args:
        bundle: bundle (*.tauext) to run.
        recordings: recordings (*.parquet) of the bundle's robot, rate and torque timing.
        real_time: replay as fast as was recorded, by the time stamps: the same as --speed 1.
        speed: factor on the speed of the replay, 1 as it was recorded. None: as fast as possible.
        own_rate: run the network at its own rate (usually 100 Hz) and hold its value in between, for slow processors.
        acknowledge_after_s: seconds after which a collision is acknowledged. None: never; then the first collision of
            a recording stays and hides those after it.
        flights: folder for flights: recording, estimates and an explanation in words around every collision and fault;
            files that are there are never overwritten. None: no flights.
        before_s: seconds that a flight keeps from before its event.
        after_s: seconds that a flight keeps from after its event.
        contacts: write flights of contacts, too.
        load: what the arm carries all the time, in the bundle's load frame: "mass=2.8, com=0 0 0.05", with
            inertia=XX YY ZZ XY XZ YZ and error=SHARE where they are known; in kg, m, kg m^2.
        loads: file (TOML) of what it carries from when on; docs/monitor.md.
        wrench: frame of the bundle at which the force of every touch is told, too, with how far it may be wrong and
            its direction: a link of the robot file or a joint's; a name that there is not prints those that there are.
        as_json: print JSON lines, an object an event: start, health, alarm, flight, status, end, summary.
        status_hz: with --json, how many times per second of the recording the estimates are printed, too; 0: events
            only.
    """
    require(speed is None or 1e-6 <= speed <= 1e6, "speed", speed, "> 0: 1e-6 to 1e6")
    require(not real_time or speed is None, "speed", speed, "left out with --real-time, which is speed 1")
    after = acknowledge_after_s
    require(after is None or 0 < after <= 1e6, "acknowledge_after_s", after, "> 0, at most 1e6; left out: never")
    require(0 <= status_hz <= 1e6, "status_hz", status_hz, "0 to 1e6")
    require(status_hz == 0 or as_json, "status_hz", status_hz, "left out unless --json is given")
    loaded = fitting_bundle(bundle, recordings)
    flights_here = nullcontext(None) if flights is None else added(flights)
    with flights_here as folder:
        settings = RunSettings(
            1.0 if real_time else speed,
            own_rate,
            acknowledge_after_s,
            flights,
            before_s,
            after_s,
            contacts,
            told_loads(loaded, load, loads),
            folder,
            wrench,
        )
        check_frame(loaded, wrench)
        check_flights(loaded, settings)
        with open_output(as_json, status_hz, settings) as output:
            replay_all(loaded, recordings, settings, output)


def told_loads(bundle: Bundle, load: str | None, loads: Place | None) -> tuple[TimedLoad, ...]:
    """What the arm carries, and from when on.

    Raises:
        ConfigError: it cannot be read, or the bundle takes no such load.
    """
    from tauext.monitor.loads import TimedLoad, expect_load, load_of_text, read_loads

    require(load is None or loads is None, "load", load, "left out where --loads gives a file of them")
    told = [TimedLoad(0.0, load_of_text(load))] if load is not None else read_loads(loads) if loads is not None else []
    for one in told:
        expect_load(bundle.load_settings, one.load)
    return tuple(told)


def open_output(as_json: bool, status_hz: float, settings: RunSettings) -> Output:
    """JSON lines where asked for, a live view on a terminal, else lines of text."""
    if as_json:
        from tauext.cli.run_json import JsonLines

        return JsonLines(status_hz)
    if sys.stdout.isatty():
        from tauext.cli.live_view import LiveView

        return LiveView(settings)
    from tauext.cli.run_text import TextLines

    return TextLines(settings)


def fitting_bundle(path: Place, recordings: tuple[Place, ...]) -> Bundle:
    """The bundle, after a look at the head of every recording: all of them fit it.

    Raises:
        ConfigError: no recording.
        BundleError: no such bundle; joints, rate or torque timing of a recording are not the bundle's.
    """
    from tauext.bundle.bundle_file import load_bundle
    from tauext.bundle.fit import expect_fit
    from tauext.data.recording_file import describe

    if not recordings:
        raise ConfigError("there is nothing to replay: give one or more recordings (*.parquet) behind the bundle")
    bundle = load_bundle(path)
    for recording in recordings:
        expect_fit(bundle, describe(recording))
    return bundle


def check_frame(bundle: Bundle, wrench: str | None) -> None:
    """Refuse a frame that there is not before anything is replayed."""
    from tauext.monitor.places import PlaceFinder

    PlaceFinder(bundle, wrench)


def check_flights(bundle: Bundle, settings: RunSettings) -> None:
    """Make the folder, and refuse what the recorder would refuse, before anything is replayed."""
    from tauext import _core

    if settings.folder is None:
        return
    try:
        settings.folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{settings.flights}: no folder for flights ({error.strerror or error})") from error
    _core.FlightRecorder(
        bundle.joints, bundle.observer.sample_period_ns, settings.before_s, settings.after_s, settings.contacts
    )


def replay_all(bundle: Bundle, recordings: tuple[Place, ...], settings: RunSettings, output: Output) -> None:
    """One recording after the other; after an interruption or a damaged one, still the summary of what was done.

    Raises:
        ConfigError: some flights could not be written.
    """
    from tauext.cli.run_text import FlightCount
    from tauext.data.recording_file import load_recording
    from tauext.monitor.replay import Tally

    total = Tally(
        tuple(link.joint_name for link in bundle.links), bundle.observer.sample_period_ns, tuple(bundle.estimate_units)
    )
    flights, done, stopped = FlightCount(), 0, None
    try:
        for number, path in enumerate(recordings, 1):
            recording = load_recording(path)
            output.start(bundle, recording, number, len(recordings))
            with counted(recording, total, flights, output) as (tally, own_flights):
                replay_one(bundle, recording, settings, tally, own_flights, output)
            done += 1
    except (KeyboardInterrupt, TauextError) as error:
        stopped = error
    output.total(total, flights, done, interrupted=stopped is not None)
    if isinstance(stopped, KeyboardInterrupt):
        raise KeyboardInterrupt("the summary is of what was replayed until then, and its flights are kept")
    if stopped is not None:
        raise stopped
    if flights.failed:
        raise ConfigError(f"{flights.failed} of {flights.failed + flights.written} flights are lost: {flights.error}")


@contextmanager
def counted(
    recording: Recording, total: Tally, flights: FlightCount, output: Output
) -> Iterator[tuple[Tally, FlightCount]]:
    """A tally and a count of flights for one recording; told and added to the total even if it ends early."""
    from tauext.cli.run_text import FlightCount
    from tauext.monitor.replay import Tally

    tally, own_flights = Tally(total.joints, total.sample_period_ns, total.units), FlightCount()
    try:
        yield tally, own_flights
    finally:
        total.merge(tally)
        flights.merge(own_flights)
        output.end(tally, own_flights, complete=tally.samples == recording.samples)


def replay_one(
    bundle: Bundle, recording: Recording, settings: RunSettings, tally: Tally, flights: FlightCount, output: Output
) -> None:
    """One recording through a new monitor, with a new flight recorder."""
    from tauext import _core
    from tauext.monitor.flight_files import FlightSource, FlightWriter, write_flight
    from tauext.monitor.places import PlaceFinder
    from tauext.monitor.replay import CHUNK_S, PACED_CHUNK_S, Pace, replay

    monitor = _core.Monitor(bundle, settings.own_rate)
    recorder = writer = None
    chunk_s = CHUNK_S if settings.speed is None else PACED_CHUNK_S * settings.speed
    if settings.folder is not None:
        period_ns = monitor.sample_period_ns
        recorder = _core.FlightRecorder(
            monitor.joints, period_ns, settings.before_s, settings.after_s, settings.contacts
        )
        source = FlightSource.of(bundle, recording)
        writer = FlightWriter(recorder, partial(write_flight, folder=settings.folder, source=source))
        chunk_s = min(chunk_s, max(settings.after_s, PACED_CHUNK_S))
    try:
        with writer or nullcontext():
            for chunk in replay(
                monitor,
                recording,
                Pace(settings.speed),
                recorder,
                settings.acknowledge_after_s,
                chunk_s,
                settings.loads,
                PlaceFinder(bundle, settings.wrench),
            ):
                tally.add(chunk, monitor)
                if writer is not None:
                    writer.catch_up()
                output.chunk(chunk, tally)
                tell_flights(writer, flights, output, settings)
    finally:
        tell_flights(writer, flights, output, settings)
        if recorder is not None:
            flights.missed += recorder.missed


def tell_flights(writer: FlightWriter | None, flights: FlightCount, output: Output, settings: RunSettings) -> None:
    """Pass on what became of flights since the last time."""
    for news in writer.news() if writer is not None else ():
        flights.add(news)
        if settings.flights is not None and news.path is not None:  # not where it waits to be sent
            news = replace(news, path=settings.flights / news.path.name)
        output.flight(news)
