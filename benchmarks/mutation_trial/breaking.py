"""A dataset with one mutation: what it does not change are links to the clean files."""

from __future__ import annotations

import os
import shutil
from functools import cache
from pathlib import Path

import numpy as np

from mutation_trial.cases import Case
from mutation_trial.changes import Facts, changed, facts_of
from mutation_trial.donors import cut_to, with_load
from mutation_trial.good_sets import GoodSet
from mutation_trial.labels import Spans, broken_flags, broken_intervals, imported
from tauext.data.dataset import load_dataset
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording, save_recording
from tauext.robot.load import load_tree

_facts: dict[str, Facts] = {}


def broken_dataset(case: Case, good: GoodSet, folder: Path) -> None:
    """Write the dataset with the mutation into a folder.

    Raises:
        TauextError: no recording or dataset may be so.
    """
    shutil.rmtree(folder, ignore_errors=True)
    if case.change.what.startswith("label-") and good.arm_toml is not None:
        imported(good.arm_toml, lambda spans, sources: _intervals(case, spans), folder)
        return
    shutil.copytree(good.folder, folder, copy_function=os.link)
    split = load_dataset(good.folder).split
    for name in (*split.train, *split.validation, *split.calibration):
        if case.files and Path(name).stem not in case.files:
            continue
        new = _broken(case, good, load_recording(good.folder / name))
        (folder / name).unlink()  # a link to the clean file
        save_recording(new, folder / name)


def judged_recording(case: Case, good: GoodSet, path: Path) -> Recording:
    """A recording that bundles are judged on, with the mutation where all recordings have it."""
    recording = load_recording(path)
    return recording if case.files else _broken(case, good, recording)


def _broken(case: Case, good: GoodSet, recording: Recording) -> Recording:
    change, rng = case.change, np.random.default_rng([case.seed, *recording.name.encode()])
    if change.what == "load":
        return with_load(recording, _tree(good.folder, recording.joints), change.size)
    if change.what.startswith("donor-"):
        return cut_to(_donor(good.donor_folder / f"{change.what.removeprefix('donor-')}.parquet"), recording)
    if change.what.startswith("label-"):
        other = next(r for r in good.training if r.contact is not None and r.name in good.long_files
                     and r.name != recording.name)  # fmt: skip
        return broken_flags(recording, other, change.what, change.size, rng)
    if good.name not in _facts:
        _facts[good.name] = facts_of(good.training, good.nm_per_ampere)
    return changed(recording, change, _facts[good.name], rng)


def _intervals(case: Case, spans: Spans) -> Spans:
    rng = np.random.default_rng(case.seed)
    file = next(name for name in spans if Path(name).stem == case.files[0])
    return broken_intervals(spans, file, case.change.what, case.change.size, rng)


@cache
def _tree(folder: Path, joints: tuple[str, ...]):
    return load_tree(load_dataset(folder).robot_file(None), joints=joints)


@cache
def _donor(path: Path) -> Recording:
    return load_recording(path)
