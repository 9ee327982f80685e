"""Files of every format as raw signals with times and names; nothing here knows a robot."""

from tauext.data.importers.open_source import FORMATS, open_source
from tauext.data.importers.raw import RawSignals, Source

__all__ = ["FORMATS", "RawSignals", "Source", "open_source"]
