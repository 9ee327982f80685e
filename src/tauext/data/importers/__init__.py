"""Files of every format as raw signals with times and names; nothing here knows a robot."""

from tauext.data.importers.open_raw import FORMATS, open_raw
from tauext.data.importers.raw import RawRecording, RawSignals

__all__ = ["FORMATS", "RawSignals", "RawRecording", "open_raw"]
