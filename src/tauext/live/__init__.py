"""The monitor on a live arm: sources of samples, the loop, what follows from its verdicts."""

from tauext.live.sample_queue import SampleQueue
from tauext.live.sink import EVENT_KINDS, Control, Event, EventKind, LoopReport, Publisher, Sink, Verdict
from tauext.live.source import Sample, Source, SourceCounts, SourceSettings, Stoppable

__all__ = [
    "EVENT_KINDS",
    "Control",
    "Event",
    "EventKind",
    "LoopReport",
    "Publisher",
    "Sample",
    "SampleQueue",
    "Sink",
    "Source",
    "SourceCounts",
    "SourceSettings",
    "Stoppable",
    "Verdict",
]
