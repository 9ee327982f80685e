"""Recordings, their file, and which recording serves for training, validation and test."""

from tauext.bundles.bundle_file import load_bundle, write_bundle
from tauext.data.amperes import from_amperes, in_amperes
from tauext.data.bundle_fit import expect_fit
from tauext.data.dataset import Dataset, load_dataset
from tauext.data.first_seconds import first_seconds, total_s
from tauext.data.free_motion import free_pieces, free_samples, split_by_time
from tauext.data.impossible import LeftOut, SignalBounds, possible_parts
from tauext.data.recording import Recording
from tauext.data.recording_file import Description, describe, fingerprint, load_recording, save_recording
from tauext.data.split import Split, load_split, save_split, split_recordings
from tauext.data.standing import standing_joints

__all__ = [
    "Dataset",
    "Description",
    "LeftOut",
    "Recording",
    "SignalBounds",
    "Split",
    "describe",
    "expect_fit",
    "fingerprint",
    "first_seconds",
    "free_pieces",
    "free_samples",
    "load_recording",
    "load_bundle",
    "load_dataset",
    "load_split",
    "save_recording",
    "from_amperes",
    "in_amperes",
    "possible_parts",
    "save_split",
    "split_by_time",
    "split_recordings",
    "standing_joints",
    "total_s",
    "write_bundle",
]
