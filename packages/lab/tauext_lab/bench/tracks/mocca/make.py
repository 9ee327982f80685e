"""The recording of the paper's arm as a dataset: one recording a segment, all in the training set."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from tauext_lab.bench.mocca_recording import nominal_tree, read_segments, recording

from tauext.data.dataset import Split, save_split
from tauext.data.recording_file import save_recording

CONTACT_S = 0.6


def make(files: dict[str, Path], out: Path) -> None:
    """Contact is 1 for CONTACT_S from each onset, -1 (unknown) in the rest of the file's near_contact."""
    tree, names = nominal_tree(out / "robot.xml"), []
    for segment in read_segments(files["collisions.csv"].parent):
        contact = np.where(segment.near_contact, -1, 0).astype(np.int8)
        for onset_s in segment.onsets_s:
            contact[(segment.time_s >= onset_s) & (segment.time_s <= onset_s + CONTACT_S)] = 1
        made = replace(recording(segment, tree), contact=contact)
        save_recording(made, out / f"{made.name}.parquet")
        names.append(f"{made.name}.parquet")
    save_split(Split(tuple(names)), out)
