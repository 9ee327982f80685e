"""The monitor on recordings: replay through the core, what changed and when, and the flights around it."""

from tauext.monitor.changes import (
    ALARMS,
    HEALTHS,
    TOUCHES,
    AlarmChange,
    Change,
    DriftChange,
    FoundLoad,
    HealthChange,
    LoadChange,
    TouchChange,
    WeighChange,
    with_article,
)
from tauext.monitor.flight_files import FlightSource, write_flight
from tauext.monitor.flight_writer import FlightNews, FlightWriter
from tauext.monitor.hidden import HiddenCollision, HiddenFinder
from tauext.monitor.loads import (
    TimedLoad,
    expect_load,
    load_and_ago_of_text,
    load_facts,
    load_of_table,
    load_of_text,
    load_words,
    read_loads,
)
from tauext.monitor.pace import Pace
from tauext.monitor.places import PlaceChange, PlaceFinder, place_facts, place_words
from tauext.monitor.replay import Chunk, Samples, replay
from tauext.monitor.status import StatusClock, status
from tauext.monitor.tally import Tally
from tauext.monitor.unfamiliar import WORTH_TELLING, unseen_words

__all__ = [
    "ALARMS",
    "HEALTHS",
    "TOUCHES",
    "AlarmChange",
    "Change",
    "Chunk",
    "DriftChange",
    "FoundLoad",
    "FlightNews",
    "FlightSource",
    "FlightWriter",
    "HealthChange",
    "HiddenCollision",
    "HiddenFinder",
    "LoadChange",
    "Pace",
    "PlaceChange",
    "PlaceFinder",
    "Samples",
    "StatusClock",
    "Tally",
    "TimedLoad",
    "TouchChange",
    "WORTH_TELLING",
    "WeighChange",
    "expect_load",
    "load_and_ago_of_text",
    "load_facts",
    "load_of_table",
    "load_of_text",
    "load_words",
    "place_facts",
    "place_words",
    "read_loads",
    "replay",
    "status",
    "unseen_words",
    "with_article",
    "write_flight",
]
