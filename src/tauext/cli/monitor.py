"""`tauext monitor`: a bundle on a live arm."""

from __future__ import annotations

import time
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from tauext.cli.source_options import SOURCES, SourceOptions, SourceOptionsArg, given
from tauext.config import require
from tauext.errors import AwayError, ConfigError
from tauext.sources.open import open_source

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tauext._core import Bundle
    from tauext.cli.json_lines import Output
    from tauext.monitor.flight_files import FlightSettings
    from tauext.monitor.loop import Loop, LoopSettings
    from tauext.monitor.mcap_sink import McapSink
    from tauext.monitor.record_sink import FlightSink, RecordCount, RecordSink
    from tauext.monitor.source import Source

STDIN = Path("-")
MOST_CORES = 1024
"""Largest number of processors to which Linux pins threads."""


@dataclass(frozen=True)
class Extras:
    """Files, folders and settings of everything that runs beside the loop."""

    reactions: Path | None
    profiles: Path | None
    flights: FlightSettings | None
    record: Path | None
    segment_s: float
    control: Path | None
    phases: Path | None = None
    mcap: Path | None = None


def monitor(
    bundle: Annotated[Path | None, tyro.conf.Positional] = None,
    source: Annotated[str | None, tyro.conf.arg(help=f"source of the samples: {SOURCES}.")] = None,
    options: SourceOptionsArg = SourceOptions(),  # noqa: B008
    reactions: Path | None = None,
    profiles: Path | None = None,
    phases: Path | None = None,
    control: Path | None = None,
    own_rate: bool = False,
    missing_after_ms: float | None = None,
    acknowledge_after_s: float | None = None,
    duration_s: float | None = None,
    flights: Path | None = None,
    before_s: float = 5.0,
    after_s: float = 1.0,
    contacts: bool = False,
    record: Path | None = None,
    segment_s: float = 25.0,
    core: int | None = None,
    priority: int | None = None,
    wrench: str | None = None,
    mcap: Path | None = None,
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
    kept = None if flights is None else FlightSettings(flights, before_s, after_s, contacts)
    extras = Extras(reactions, profiles, kept, record, segment_s, control, phases, mcap)
    output = open_output(as_json, status_hz, flights, acknowledge_after_s is not None)
    watch(bundle, source, given(options), settings, extras, output)


def require_positive(**values: float | None) -> None:
    """Raise ConfigError where an option is given that is no number of a usable size."""
    for name, value in values.items():
        require(value is None or 1e-6 <= value <= 1e9, name, value, "> 0: 1e-6 to 1e9")


def watch(
    path: Path, text: str, options: dict[str, Any], settings: LoopSettings, extras: Extras, output: Output
) -> None:
    """Connect everything, run the loop, print the summary.

    Raises:
        ConfigError: something does not fit, before the first sample; or, at the end, samples or flights are lost.
        AwayError: the source or the duration ended without a sample.
    """
    from tauext.bundle.bundle_file import load_bundle
    from tauext.cli.monitor_output import Aside, OutputSink
    from tauext.cli.text_lines import Outcome
    from tauext.monitor.latency import how_to_hold_the_rate
    from tauext.monitor.loop import Loop
    from tauext.monitor.phases import phases_of
    from tauext.monitor.profiles import load_profiles
    from tauext.monitor.reaction_file import load_reactions
    from tauext.monitor.reactions import start_reactions

    bundle = load_bundle(path)
    joints = tuple(link.joint_name for link in bundle.links)
    source, publishers = open_source(text, options, bundle)
    phases, unmonitored = phases_of(extras.phases, bundle)
    profiles = None if extras.profiles is None else load_profiles(extras.profiles, joints)
    rules = [] if extras.reactions is None else load_reactions(extras.reactions, joints)
    flights, record, mcap = written(extras, bundle, source.name, settings.wrench)
    sinks = [*publishers, *(sink for sink in (flights, record, mcap) if sink is not None)]
    reactions = start_reactions(rules, source, publishers)
    with ExitStack() as stack:
        stack.callback(reactions.end)
        recorder = flights.recorder if flights else None
        loop = Loop(bundle, source, sinks, reactions, profiles, recorder, settings, phases=phases)
        stack.enter_context(output)
        aside = stack.enter_context(Aside(lambda: loop.stop("an output that cannot be written")))
        remedy = how_to_hold_the_rate(settings.core, settings.priority)
        loop.sinks.append(shown := OutputSink(output, aside, loop, reactions, flights, remedy))
        for sink in (record, mcap):
            if sink is not None:
                sink.note = shown.note
        loop.note, loop.switched = shown.note, shown.switched
        stack.enter_context(controlled(extras.control, loop))
        aside.do(partial(output.start_live, source.name, bundle))
        for words in unmonitored:
            loop.note(words)
        began_s = time.monotonic()
        loop.run()
        ran_s = time.monotonic() - began_s
        shown.print_news()
        if mcap is not None:
            shown.note(f"{mcap.path}: {mcap.samples:,} samples")
        if flights is not None:
            shown.flights.missed, shown.flights.repeated = flights.recorder.missed, flights.repeated
        outcome = Outcome(shown.tally, loop.tick, loop.missing, source.counts, shown.flights)
        outcome.monitored = loop.monitored
        outcome.reactions = {thread.reaction.name: thread.count for thread in reactions.threads}
        outcome.recorded = record.count if record else None
        aside.do(partial(output.finish, outcome))
    expect_samples(source, loop, ran_s)
    expect_nothing_lost(outcome.recorded, mcap)
    shown.flights.expect_all_written()


def written(
    extras: Extras, bundle: Bundle, source: str, wrench: str | None
) -> tuple[FlightSink | None, RecordSink | None, McapSink | None]:
    """Sinks that write flights, recordings and a file for viewers, as far as they are asked for."""
    from tauext.monitor.record_sink import FlightSink, RecordSink
    from tauext.monitor.source import settings_of

    flights = record = mcap = None
    if (kept := extras.flights) is not None:
        flights = FlightSink(kept.folder, bundle, kept.recorder(bundle), source)
    if extras.record is not None:
        record = RecordSink(extras.record, settings_of(bundle), source, extras.segment_s, lambda: bundle.name)
    if extras.mcap is not None:
        from tauext.monitor.mcap_sink import McapSink

        mcap = McapSink(extras.mcap, bundle, source, wrench)
    return flights, record, mcap


def expect_samples(source: Source, loop: Loop, ran_s: float) -> None:
    """Raise AwayError where the source gave none."""
    if not loop.samples and not loop.stopped:
        refused = source.counts.refused
        came = f"none of {refused} samples could be used" if refused else "no sample came"
        raise AwayError(
            f"{source.name}: {came} in {ran_s:.1f} s; check that the robot sends, and the options of --source"
        )


def expect_nothing_lost(recorded: RecordCount | None, mcap: McapSink | None) -> None:
    """Raise ConfigError where samples were not written."""
    if recorded is not None and recorded.lost:
        of = recorded.lost + recorded.samples
        raise ConfigError(f"{recorded.lost} of {of} samples of the recording are lost: {recorded.error}")
    if mcap is not None and mcap.error:
        raise ConfigError(f"{mcap.lost} of {mcap.lost + mcap.samples} samples of the MCAP file are lost: {mcap.error}")


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
