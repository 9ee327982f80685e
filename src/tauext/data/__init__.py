"""Recordings, their file, and which recording serves for training, validation and test."""

from tauext.data.first_seconds import first_seconds, total_s
from tauext.data.recording import Recording
from tauext.data.recording_file import Description, describe, load, save
from tauext.data.split import Split, load_split, save_split, split_recordings

__all__ = [
    "Description",
    "Recording",
    "Split",
    "describe",
    "first_seconds",
    "load",
    "load_split",
    "save",
    "save_split",
    "split_recordings",
    "total_s",
]
