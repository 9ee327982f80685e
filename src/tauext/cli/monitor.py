"""`tauext monitor`: a bundle on a live arm."""

from __future__ import annotations

import time
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from tauext.cli.place_argument import LocalArg, PlaceArg
from tauext.cli.source_options import SOURCES, SourceOptions, SourceOptionsArg, given
from tauext.config import require
from tauext.errors import AwayError, ConfigError
from tauext.files.places import Place
from tauext.sources.open import open_source

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tauext.cli.json_lines import Output
    from tauext.monitor.flight_files import FlightSettings
    from tauext.monitor.loop import Loop, LoopSettings

STDIN = Path("-")
MOST_CORES = 1024
"""Largest number of processors to which Linux pins threads."""


@dataclass(frozen=True)
class Extras:
    """Files, folders and settings of everything that runs beside the loop."""

    reactions: Place | None
    profiles: Place | None
    flights: FlightSettings | None
    record: Path | None
    segment_s: float
    control: Path | None
    phases: Place | None = None
    mcap: Path | None = None


def monitor(
    bundle: Annotated[PlaceArg | None, tyro.conf.Positional] = None,
    source: Annotated[str | None, tyro.conf.arg(help=f"source of the samples: {SOURCES}.")] = None,
    options: SourceOptionsArg = SourceOptions(),  # noqa: B008
    reactions: PlaceArg | None = None,
    profiles: PlaceArg | None = None,
    phases: PlaceArg | None = None,
    control: Path | None = None,
    own_rate: bool = False,
    missing_after_ms: float | None = None,
    acknowledge_after_s: float | None = None,
    duration_s: float | None = None,
    flights: LocalArg | None = None,
    before_s: float = 5.0,
    after_s: float = 1.0,
    contacts: bool = False,
    record: LocalArg | None = None,
    segment_s: float = 25.0,
    core: int | None = None,
    priority: int | None = None,
    wrench: str | None = None,
    mcap: LocalArg | None = None,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
    status_hz: float = 0.0,
) -> None:
    """Monitor a live arm: external torque, contacts, collisions, and the reactions to them.

    Ctrl-C ends the monitor with a summary. Guide: docs/running.md.

    Args:
        bundle: bundle (*.tauext) to run.
        options: options of some sources.
        reactions: TOML file of reactions to a collision, contact or fault, and to its end.
        profiles: TOML file of named factors on the limits, switched while the monitor runs.
        phases: TOML file of contacts that the task means: on while announced, in a box, or always; docs/contacts.md.
        control: socket that accepts lines such as `profile NAME`, `contact PHASE seconds=20`, `acknowledge`, `resume`
            and `stop`; `-`: stdin.
        own_rate: run the network at its own rate (usually 100 Hz) and hold its value in between, for slow processors.
        missing_after_ms: time after the last sample when the next one counts as missing, [ms]. None: two periods, or
            a period and 2 ms if that is longer.
        acknowledge_after_s: seconds after which a collision is acknowledged. None: only on request.
        duration_s: time after which the monitor ends, [s]. None: with the source, or on request.
        flights: folder for flights: recording, estimates and a written explanation around every collision and fault.
            Existing files are never overwritten. None: no flights.
        before_s: seconds before the event that a flight keeps.
        after_s: seconds after the event that a flight keeps.
        contacts: also write flights of contacts.
        record: folder for recordings of all received samples, for a later training.
        segment_s: length of each recording, [s]; a killed process loses at most this much.
        core: processor core of the loop and the receiver of samples. None: any.
        priority: real-time priority (SCHED_FIFO, 1 to 99) of the loop and the receiver of samples. None: normal
            scheduling.
        wrench: frame of the bundle (a link of the robot file or a joint's frame) at which the force of every touch is
            also reported, with uncertainty and direction. An unknown name prints the available frames.
        mcap: file (*.mcap) for samples, estimates, forces and events, which Foxglove, Rerun and PlotJuggler open.
            A killed process leaves a file that they can recover. None: none is written.
        as_json: print JSON lines, an object an event.
        status_hz: how often --json also prints the estimates, per second; 0: events only.
    """
    if bundle is None or source is None:
        missing = "--source" if bundle is not None else "the bundle"
        raise ConfigError(f"{missing} is missing: tauext monitor ARM.tauext --source replay:FILE")
    require_positive(missing_after_ms=missing_after_ms, acknowledge_after_s=acknowledge_after_s, duration_s=duration_s)
    require(1 <= segment_s <= 3600, "segment_s", segment_s, "1 to 3600")
    require(priority is None or 1 <= priority <= 99, "priority", priority, "1 to 99")
    require(0 <= status_hz <= 1e6, "status_hz", status_hz, "0 to 1e6")
    require(core is None or 0 <= core < MOST_CORES, "core", core, f"0 to {MOST_CORES - 1}")
    require(status_hz == 0 or as_json, "status_hz", status_hz, "left out unless --json is given")

    from tauext.cli.run import open_output
    from tauext.monitor.flight_files import FlightSettings
    from tauext.monitor.loop import LoopSettings

    missing_s = None if missing_after_ms is None else missing_after_ms * 1e-3
    settings = LoopSettings(own_rate, missing_s, acknowledge_after_s, duration_s, core, priority, wrench)
    kept = None if flights is None else FlightSettings(flights, before_s, after_s, contacts, flights)
    extras = Extras(reactions, profiles, kept, record, segment_s, control, phases, mcap)
    output = open_output(as_json, status_hz, flights, acknowledge_after_s is not None)
    watch(bundle, source, given(options), settings, extras, output)


def require_positive(**values: float | None) -> None:
    """Raise ConfigError where an option is given that is no number of a usable size."""
    for name, value in values.items():
        require(value is None or 1e-6 <= value <= 1e9, name, value, "> 0: 1e-6 to 1e9")


def watch(
    path: Place, text: str, options: dict[str, Any], settings: LoopSettings, extras: Extras, output: Output
) -> None:
    """Connect everything, run the loop, print the summary.

    Raises:
        ConfigError: something does not fit, before the first sample; or, at the end, samples or flights are lost.
        AwayError: the source or the duration ended without a sample.
    """
    from tauext.bundle.bundle_file import load_bundle
    from tauext.cli.monitor_output import OutputSink, output_thread
    from tauext.cli.text_lines import Outcome
    from tauext.monitor.latency import how_to_hold_the_rate
    from tauext.monitor.loop import Loop
    from tauext.monitor.phases import phases_of
    from tauext.monitor.profiles import load_profiles
    from tauext.monitor.reaction_file import load_reactions
    from tauext.monitor.reactions import start_reactions
    from tauext.monitor.record_sink import FlightSink, RecordSink
    from tauext.monitor.source import settings_of

    bundle = load_bundle(path)
    joints = tuple(link.joint_name for link in bundle.links)
    source, publishers = open_source(text, options, bundle)
    phases, unmonitored = phases_of(extras.phases, bundle)
    profiles = None if extras.profiles is None else load_profiles(extras.profiles, joints)
    rules = [] if extras.reactions is None else load_reactions(extras.reactions, joints)
    flights = None
    if (kept := extras.flights) is not None:
        flights = FlightSink(kept.folder, bundle, kept.recorder(bundle), source.name)
    record = None
    if extras.record is not None:
        record = RecordSink(extras.record, settings_of(bundle), source.name, extras.segment_s, lambda: bundle.name)
    mcap = None
    if extras.mcap is not None:
        from tauext.monitor.mcap_sink import McapSink

        mcap = McapSink(extras.mcap, bundle, source.name, settings.wrench)
    sinks = [*publishers, *(sink for sink in (flights, record, mcap) if sink is not None)]
    reactions = start_reactions(rules, source, publishers)
    recorder = flights.recorder if flights else None
    with ExitStack() as stack:
        stack.callback(reactions.end)
        loop = Loop(bundle, source, sinks, reactions, profiles, recorder, settings, phases=phases)
        stack.enter_context(output)
        worker = stack.enter_context(output_thread(lambda: loop.stop("an output that cannot be written")))
        remedy = how_to_hold_the_rate(settings.core, settings.priority)
        shown = OutputSink(output, worker, loop, reactions, flights, remedy)
        loop.sinks.append(shown)
        for sink in (record, mcap):
            if sink is not None:
                sink.note = shown.note
        loop.note, loop.switched = shown.note, shown.switched
        stack.enter_context(controlled(extras.control, loop))
        worker.put(partial(output.start_live, source.name, bundle), must=True)
        for words in unmonitored:
            loop.note(words)
        began_s = time.monotonic()
        loop.run()
        ran_s = time.monotonic() - began_s
        shown.print_news()
        if mcap is not None:
            shown.note(f"{mcap.path}: {mcap.samples:,} samples")
        if recorder is not None:
            shown.flights.missed = recorder.missed
        shown.flights.repeated = flights.repeated if flights else 0
        outcome = Outcome(shown.tally, loop.tick, loop.missing, source.counts, shown.flights)
        outcome.monitored = loop.monitored
        outcome.reactions = {thread.reaction.name: thread.count for thread in reactions.threads}
        outcome.recorded = record.count if record else None
        worker.put(partial(output.finish, outcome), must=True)
    if not loop.samples and not loop.stopped:
        refused = source.counts.refused
        came = f"none of {refused} samples could be used" if refused else "no sample came"
        raise AwayError(
            f"{source.name}: {came} in {ran_s:.1f} s; check that the robot sends, and the options of --source"
        )
    recorded = outcome.recorded
    if recorded is not None and recorded.lost:
        of = recorded.lost + recorded.samples
        raise ConfigError(f"{recorded.lost} of {of} samples of the recording are lost: {recorded.error}")
    if mcap is not None and mcap.error:
        raise ConfigError(f"{mcap.lost} of {mcap.lost + mcap.samples} samples of the MCAP file are lost: {mcap.error}")
    shown.flights.expect_all_written()


@contextmanager
def controlled(path: Path | None, loop: Loop) -> Iterator[None]:
    """Signals end the loop, a second one breaks it off; lines from stdin or a socket steer it."""
    import sys
    import weakref

    from tauext.monitor.control_lines import ControlSocket, obey_lines
    from tauext.monitor.stop_signals import stopped_by_signals

    steered = weakref.proxy(loop)  # a thread that waits for a line for ever must not keep it alive
    with stopped_by_signals(loop.stop):
        if path == STDIN:
            obey_lines(sys.stdin, steered)
            yield
        elif path is not None:
            with closing(ControlSocket(path, steered)):
                yield
        else:
            yield
