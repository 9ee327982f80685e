"""`tauext monitor`: a bundle on a live arm."""

from __future__ import annotations

import time
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

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
from tauext.cli.source_options import SOURCES, SourceOptions, SourceOptionsArg, given
from tauext.config import require
from tauext.errors import AwayError, ConfigError
from tauext.monitor.sink_kind import Watched
from tauext.sources.open import open_source

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tauext._core import Bundle
    from tauext.cli.json_lines import Output
    from tauext.monitor.flight_files import FlightSettings
    from tauext.monitor.loop import Loop, LoopSettings
    from tauext.monitor.record_sink import FlightSink, RecordSink
    from tauext.monitor.source import Source


@dataclass(frozen=True)
class Extras:
    """Files, folders and settings of everything that runs beside the loop."""

    flights: FlightSettings | None
    record: Path | None
    segment_s: float
    control: Path | None
    sinks: dict[str, Any] = field(default_factory=dict)
    """Values of the options of further sinks, by name."""


def monitor(
    bundle: Annotated[Path | None, tyro.conf.Positional] = None,
    source: Annotated[str | None, tyro.conf.arg(help=f"source of the samples: {SOURCES}.")] = None,
    options: SourceOptionsArg = SourceOptions(),  # noqa: B008
    cell: Path | None = None,
    control: Path | None = None,
    own_rate: bool = False,
    missing_after_ms: float | None = None,
    acknowledge_after_s: float | None = None,
    duration_s: float | None = None,
    flights: FlightArg = FlightOptions(),  # noqa: B008
    record: Path | None = None,
    segment_s: float = 25.0,
    core: int | None = None,
    priority: int | None = None,
    wrench: str | None = None,
    sinks: SinkArg = SinkOptions(),  # noqa: B008
    shown: PrintArg = PrintOptions(),  # noqa: B008
) -> None:
    """Monitor a live arm: external torque, contacts, collisions, and the reactions to them.

    Ctrl-C ends the monitor with a summary. Guide: docs/running.md.

    Args:
        bundle: bundle (*.tauext) to run.
        options: options of some sources.
        cell: TOML file of the cell: reactions to a collision, contact or fault; profiles, named factors on the
            thresholds; phases, contacts that the task means; bus, the joints of servos.
        control: socket that accepts lines such as `profile NAME`, `contact PHASE seconds=20`, `acknowledge`, `resume`
            and `stop`; `-`: stdin.
        own_rate: run the network at its own rate (usually 100 Hz) and hold its value in between, for slow processors.
        missing_after_ms: time after the last sample when the next one counts as missing, [ms]. None: two periods, or
            a period and 2 ms if that is longer.
        acknowledge_after_s: seconds after which a collision is acknowledged. None: only on request.
        duration_s: time after which the monitor ends, [s]. None: with the source, or on request.
        record: folder for recordings of all received samples, for a later training.
        segment_s: length of each recording, [s]; a killed process loses at most this much.
        core: processor core of the loop and the receiver of samples. None: any.
        priority: real-time priority (SCHED_FIFO, 1 to 99) of the loop and the receiver of samples. None: normal
            scheduling.
        wrench: frame of the bundle (a link of the robot file or a joint's frame) at which the force of every touch is
            also reported, with uncertainty and direction. An unknown name prints the available frames.
    """
    if bundle is None or source is None:
        missing = "--source" if bundle is not None else "the bundle"
        raise ConfigError(f"{missing} is missing: tauext monitor ARM.tauext --source replay:FILE")
    require_positive(missing_after_ms=missing_after_ms, acknowledge_after_s=acknowledge_after_s, duration_s=duration_s)
    require(1 <= segment_s <= 3600, "segment_s", segment_s, "1 to 3600")
    require(priority is None or 1 <= priority <= 99, "priority", priority, "1 to 99")
    require(core is None or 0 <= core < 1024, "core", core, "0 to 1023")  # processors to which Linux pins threads
    from tauext.monitor.loop import LoopSettings

    missing_s = None if missing_after_ms is None else missing_after_ms * 1e-3
    settings = LoopSettings(own_rate, missing_s, acknowledge_after_s, duration_s, core, priority, wrench)
    extras = Extras(flights.settings, record, segment_s, control, chosen_sinks(sinks))
    output = shown.output(flights.flights, acknowledge_after_s is not None)
    watch(bundle, source, given(options), cell, settings, extras, output)


def require_positive(**values: float | None) -> None:
    """Raise ConfigError where an option is given that is no number of a usable size."""
    for name, value in values.items():
        require(value is None or 1e-6 <= value <= 1e9, name, value, "> 0: 1e-6 to 1e9")


def watch(
    path: Path,
    text: str,
    options: dict[str, Any],
    of_cell: Path | None,
    settings: LoopSettings,
    extras: Extras,
    output: Output,
) -> None:
    """Connect everything, run the loop, print the summary.

    Raises:
        ConfigError: something does not fit, before the first sample; or, at the end, samples or flights are lost.
        AwayError: the source or the duration ended without a sample.
    """
    from tauext.bundle.bundle_file import load_bundle
    from tauext.cli.monitor_output import OutputSink, expect_nothing_lost, output_thread
    from tauext.monitor.cell_file import Cell, load_cell
    from tauext.monitor.latency import how_to_hold_the_rate
    from tauext.monitor.loop import Loop
    from tauext.monitor.reactions import start_reactions

    bundle = load_bundle(path)
    cell = Cell() if of_cell is None else load_cell(of_cell, [link.joint_name for link in bundle.links])
    source, publishers = open_source(text, options, bundle, cell)
    unmonitored = cell.unmonitored(bundle)
    flights, record = written(extras, bundle, source.name)
    added = opened_sinks(extras.sinks, Watched(bundle, source.name, settings.wrench))
    reactions = start_reactions(cell.reactions, source, publishers)
    with ExitStack() as stack:
        stack.callback(reactions.end)
        sinks = [*publishers, *(sink for sink in (flights, record) if sink is not None), *added]
        recorder = flights.recorder if flights else None
        loop = Loop(bundle, source, sinks, reactions, cell.profiles, recorder, settings, phases=cell.phases)
        stack.enter_context(output)
        worker = stack.enter_context(output_thread(lambda: loop.stop("an output that cannot be written")))
        remedy = how_to_hold_the_rate(settings.core, settings.priority)
        shown = OutputSink(output, worker, loop, reactions, flights, remedy)
        loop.sinks.append(shown)
        loop.note, loop.switched = shown.note, shown.switched
        stack.enter_context(controlled(extras.control, loop))
        worker.put(partial(output.start_live, source.name, bundle), must=True)
        for words in unmonitored:
            loop.note(words)
        began_s = time.monotonic()
        loop.run()
        ran_s = time.monotonic() - began_s
        shown.print_news()
        for sink in added:
            shown.note(sink.summary())
        outcome = shown.outcome(source.counts, record.count if record else None)
        worker.put(partial(output.finish, outcome), must=True)
    expect_samples(source, loop, ran_s)
    expect_nothing_lost([*filter(None, [record]), *added])
    shown.flights.expect_all_written()


def written(extras: Extras, bundle: Bundle, source: str) -> tuple[FlightSink | None, RecordSink | None]:
    """Sinks that write flights and recordings, as far as they are asked for."""
    from tauext.monitor.record_sink import FlightSink, RecordSink
    from tauext.monitor.source import settings_of

    flights = record = None
    if (kept := extras.flights) is not None:
        flights = FlightSink(kept.folder, bundle, kept.recorder(bundle), source)
    if extras.record is not None:
        record = RecordSink(extras.record, settings_of(bundle), source, extras.segment_s, lambda: bundle.name)
    return flights, record


def expect_samples(source: Source, loop: Loop, ran_s: float) -> None:
    """Raise AwayError where the source gave none."""
    if not loop.samples and not loop.stopped:
        refused = source.counts.refused
        came = f"none of {refused} samples could be used" if refused else "no sample came"
        raise AwayError(
            f"{source.name}: {came} in {ran_s:.1f} s; check that the robot sends, and the options of --source"
        )


@contextmanager
def controlled(path: Path | None, loop: Loop) -> Iterator[None]:
    """Signals end the loop, a second one breaks it off; lines from stdin or a socket steer it."""
    import sys
    import weakref

    from tauext.monitor.control_lines import ControlSocket, obey_lines
    from tauext.monitor.stop_signals import stopped_by_signals

    steered = weakref.proxy(loop)  # a thread that waits for a line for ever must not keep it alive
    with stopped_by_signals(loop.stop):
        if path == Path("-"):
            obey_lines(sys.stdin, steered)
            yield
        elif path is not None:
            with closing(ControlSocket(path, steered)):
                yield
        else:
            yield
