"""`tauext run`: recordings through the monitor, as a control loop would run it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from tauext.cli.arguments import BundleArg, RecordingsArg
from tauext.cli.loop_options import (
    FlightArg,
    FlightOptions,
    PrintArg,
    PrintOptions,
    SinkArg,
    SinkOptions,
    chosen_sinks,
    opened_sinks,
)
from tauext.config import require
from tauext.errors import ConfigError, TauextError
from tauext.monitor.sink_kind import Watched

if TYPE_CHECKING:
    from tauext._core import Bundle
    from tauext.cli.json_lines import Output
    from tauext.data.recording import Recording
    from tauext.monitor.event_stream import Tally
    from tauext.monitor.flight_files import FlightCount, FlightSettings
    from tauext.monitor.loads import TimedLoad
    from tauext.monitor.phases import Phases
    from tauext.monitor.sink import AddedSink


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
    sinks: Sequence[AddedSink] = ()
    """Further sinks, of the only recording."""


def run(
    bundle: BundleArg,
    recordings: RecordingsArg,
    real_time: bool = False,
    speed: float | None = None,
    own_rate: bool = False,
    acknowledge_after_s: float | None = None,
    flights: FlightArg = FlightOptions(),  # noqa: B008
    load: str | None = None,
    loads: Path | None = None,
    cell: Path | None = None,
    wrench: str | None = None,
    sinks: SinkArg = SinkOptions(),  # noqa: B008
    shown: PrintArg = PrintOptions(),  # noqa: B008
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
        load: constant payload in the bundle's load frame, such as "mass=2.8 com=0,0,0.05"; optional
            inertia=XX,YY,ZZ,XY,XZ,YZ and error=SHARE. Units: kg, m, kg m^2.
        loads: TOML file of payloads with the times at which they change; docs/loads.md.
        cell: TOML file of the cell with phases, contacts that the task means, and their times in the recording;
            docs/contacts.md.
        wrench: frame of the bundle (a link of the robot file or a joint's frame) at which the force of every touch is
            also reported, with uncertainty and direction. An unknown name prints the available frames.
    """
    require(speed is None or 1e-6 <= speed <= 1e6, "speed", speed, "> 0: 1e-6 to 1e6")
    require(not real_time or speed is None, "speed", speed, "left out with --real-time, which is speed 1")
    after = acknowledge_after_s
    require(after is None or 0 < after <= 1e6, "acknowledge_after_s", after, "> 0, at most 1e6; left out: never")
    for name, value in (chosen := chosen_sinks(sinks)).items():
        require(len(recordings) == 1, name, value, "left out, or given with one recording")
    output = shown.output(flights.flights, after is not None)
    loaded = fitting_bundle(bundle, recordings)
    kept, carried = flights.settings, timed_loads(loaded, load, loads)
    phases, unmonitored = phases_of(cell, loaded)
    expect_frame(loaded, wrench)
    added = opened_sinks(chosen, Watched(loaded, recordings[0].stem, wrench, is_live=False))
    if kept is not None:
        kept.recorder(loaded)
    speed = 1.0 if real_time else speed
    with output:
        for words in unmonitored:
            print(f"tauext: {words}", file=sys.stderr)
        settings = RunSettings(speed, own_rate, after, kept, carried, wrench, phases, added)
        replay_all(loaded, recordings, settings, output)


def phases_of(cell: Path | None, bundle: Bundle) -> tuple[Phases | None, list[str]]:
    """Phases of the cell's file, and what is not monitored during each of them, in sentences."""
    from tauext.monitor.cell_file import Cell, load_cell

    its = Cell() if cell is None else load_cell(cell, [link.joint_name for link in bundle.links])
    return its.phases, its.unmonitored(bundle)


def expect_frame(bundle: Bundle, wrench: str | None) -> None:
    """Raise ConfigError for a frame that the bundle lacks, before anything is replayed."""
    from tauext.monitor.touch_place import PlaceFinder

    PlaceFinder(bundle, wrench)


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
    from tauext.monitor.event_stream import Tally
    from tauext.monitor.flight_files import FlightCount

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
        raise KeyboardInterrupt("the summary covers the motion replayed until then; its event logs are kept")
    if stopped is not None:
        raise stopped
    flights.expect_all_written()


def replay_one(
    bundle: Bundle, recording: Recording, settings: RunSettings, total: Tally, all_flights: FlightCount, output: Output
) -> None:
    """The loop on one recording, with a new monitor and flight recorder; counted in full even if it ends early.

    Raises:
        ConfigError: a sink lost samples.
    """
    from tauext.cli.monitor_output import CHUNK_S, OutputSink, expect_nothing_lost, output_thread
    from tauext.monitor.flight_files import FlightSource
    from tauext.monitor.loop import Loop, LoopSettings
    from tauext.monitor.reactions import Reactions
    from tauext.monitor.record_sink import FlightSink
    from tauext.monitor.source import settings_of
    from tauext.monitor.turns import Turns
    from tauext.sources.replay import ReplaySource

    turns = Turns(settings_of(bundle), bundle)
    q, _ = turns.rows(recording.t_ns, recording.q)
    if q is not recording.q:
        recording = replace(recording, q=q)
    block_s = chunk_s = 1.0 if settings.speed is None else CHUNK_S * settings.speed
    flights = recorder = None
    if (kept := settings.flights) is not None:
        recorder = kept.recorder(bundle)
        flights = FlightSink(kept.folder, bundle, recorder, FlightSource.of(bundle, recording))
        block_s = min(block_s, max(kept.after_s, CHUNK_S))
    never_s = 1e6  # a gap is found by the stamp of the sample after it
    in_loop = LoopSettings(
        settings.own_rate, never_s, settings.acknowledge_after_s, wrench=settings.wrench, block_s=block_s
    )
    source, sinks = ReplaySource(recording, settings.speed, is_made=True), [*filter(None, [flights]), *settings.sinks]
    loop = Loop(bundle, source, sinks, None, None, recorder, in_loop, phases=settings.phases, loads=settings.loads)
    with output_thread(lambda: loop.stop("an output that cannot be written"), patient=True) as worker:
        shown = OutputSink(output, worker, loop, Reactions(), flights, chunk_s=chunk_s, is_live=False)
        loop.sinks.append(shown)
        loop.note = shown.note
        for text in turns.notes():
            shown.note(text)
        try:
            loop.run()
        finally:
            shown.print_news()
            for sink in settings.sinks:
                shown.note(sink.summary())
            if recorder is not None:
                shown.flights.missed += recorder.missed
            total.merge(shown.tally)
            all_flights.merge(shown.flights)
            is_complete = shown.tally.samples == recording.samples
            worker.put(partial(output.end, shown.tally, shown.flights, is_complete))
    expect_nothing_lost(settings.sinks)
