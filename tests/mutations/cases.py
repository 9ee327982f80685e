"""The list of mutations, joints and recordings drawn by seed, and the dataset that each of them leaves."""

from __future__ import annotations

import itertools
import math
import os
import shutil
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from mutations.changes import (
    Change,
    Facts,
    Spans,
    broken_flags,
    broken_intervals,
    changed,
    cut_to,
    facts_of,
    imported,
    with_load,
)
from mutations.good import GoodSet
from tauext.data.dataset import load_dataset
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording, save_recording
from tauext.robot.read import load_tree

DEGREES, RPM = 180 / math.pi, 30 / math.pi
SPIKE_SIZES = {"tau": (2.0, 20.0, 1e4), "dq": (2.0, 20.0, 1e4), "q": (0.05, 1.0, 100.0)}
"""Of the largest torque and speed; [rad]."""
SEVERAL = 3
DRAWS = {"spikes": 1, "mixed files": 3}
"""Of a setting that leaves joint, recording or place to chance; of other kinds 2."""


@dataclass(frozen=True)
class Setting:
    """A mutation before joints and recordings are drawn."""

    kind: str
    name: str
    change: Change
    joints: int = 0  # number of joints to draw; 0: all
    files: int = 0  # number of training recordings to draw; 0: all recordings, also those that the bundle is judged on


@dataclass(frozen=True)
class Case:
    """One mutation of one dataset."""

    id: str
    dataset: str
    kind: str
    change: Change
    files: tuple[str, ...]
    """Names of the recordings that are changed; none: all."""
    seed: int


def cases_of(good: GoodSet, seed: int) -> list[Case]:
    """Those of one dataset, in an order drawn by seed, so that the first of them are a fair sample."""
    settings = [s for s in _settings(good) if s.kind in good.kinds]
    draws = [DRAWS.get(s.kind, 2) if s.joints or s.files else 1 for s in settings]
    cases = [_drawn(good, s, draw, seed) for s, count in zip(settings, draws, strict=True) for draw in range(count)]
    order = np.random.default_rng([seed, zlib.crc32(good.name.encode())]).permutation(len(cases))
    unique = {case.id: case for case in (cases[k] for k in order)}
    return list(unique.values())


def _drawn(good: GoodSet, setting: Setting, draw: int, seed: int) -> Case:
    key = zlib.crc32(f"{good.name}/{setting.kind}/{setting.name}/{draw}".encode())
    rng = np.random.default_rng([seed, key])
    joints = tuple(int(j) for j in rng.choice(good.joints, min(setting.joints, good.joints), replace=False))
    long_files = good.long_files
    files = tuple(sorted(rng.choice(long_files, min(setting.files, len(long_files)), replace=False).tolist()))
    parts = [good.name, setting.kind, setting.name]
    parts += ["-".join(f"joint{j + 1}" for j in joints)] if joints else []
    parts += ["+".join(files)] if files else []
    parts += [f"at{draw}"] if setting.kind in ("spikes", "stuck", "labels", "mixed") else []
    return Case("/".join(parts), good.name, setting.kind, replace(setting.change, joints=joints), files, key)


def _settings(good: GoodSet) -> Iterator[Setting]:
    sizes = {"q-degrees": DEGREES, "q-dq-degrees": DEGREES, "dq-degrees": DEGREES, "dq-rpm": RPM, "tau-mNm": 1000.0}
    for name, size in (sizes | {"tau-kNm": 0.001}).items():
        yield from _scopes("units", name, Change("factor", tuple(name.split("-")[:-1]), size=size))
    yield from _scopes("units", "tau-amperes", Change("amperes", ("tau",)))
    for signals in (("q",), ("dq",), ("tau",), ("q", "dq")):
        yield from _scopes("signs", "-".join(signals), Change("factor", signals, size=-1.0))
    for signals, files in itertools.product((("q", "dq", "tau"), ("q",), ("dq",), ("tau",)), (1, 0)):
        where = "one-file" if files else "all-files"
        yield Setting("order", f"{'-'.join(signals)}-{where}", Change("exchange", signals), 2, files)
    for signal, sizes_of in SPIKE_SIZES.items():
        for size, samples, files in itertools.product(sizes_of, (1, 3, 10), (1, SEVERAL)):
            name = f"{signal}-{size:g}-{samples}-samples-{files}-file{'s' * (files > 1)}"
            yield Setting("spikes", name, Change("spike", (signal,), size=size, length=samples), 1, files)
    for signal, seconds, files in itertools.product(("tau", "q", "dq"), (0.5, 3.0, math.inf), (1, SEVERAL)):
        name = f"{signal}-{seconds:g}-s-{files}-file{'s' * (files > 1)}"
        yield Setting("stuck", name, Change("stuck", (signal,), length=seconds), 1, files)
    for signal, late_s in itertools.product(("tau", "dq"), (0.005, 0.02, 0.1)):
        yield from _scopes("delays", f"{signal}-{1e3 * late_s:g}-ms", Change("delay", (signal,), size=late_s), (0,))
    for name, size in {"ms-as-s": 1e3, "s-as-ms": 1e-3, "us-as-s": 1e6, "min-as-s": 60.0, "s-as-min": 1 / 60}.items():
        yield from _scopes("time unit", name, Change("time-unit", size=size), (0,))
    for name, size in {"0.1": 0.1, "0.5": 0.5, "turn": 2 * math.pi}.items():
        yield from _scopes("zeros", f"{name}-rad", Change("zero", ("q",), size=size), (1,))
    # `files` of 1 draws the recording whose labels are wrong, or that is another
    for name, size in {"shifted": 0.5, "shifted-2": 2.0, "shifted-early": -2.0, "dropped-one": 0.0}.items():
        for again in ("", "-again"):
            yield Setting("labels", f"{name}{again}", Change(f"label-{name.split('-')[0]}", size=size), 0, 1)
    for name in ("all-dropped", "other-file", *(("beyond", "milliseconds", "misspelt") if good.arm_toml else ())):
        yield Setting("labels", name, Change(f"label-{name}"), 0, 1)
    for share in (0.1, 0.3):
        yield Setting("mixed files", f"load-{share:.0%}", Change("load", ("tau",), size=share), 0, 1)
    for name in good.donors:
        yield Setting("mixed files", f"other-{name}", Change(f"donor-{name}"), 0, 1)
    yield Setting("mixed files", "half-rate", Change("thinned", size=2.0), 0, 1)


def _scopes(kind: str, name: str, change: Change, joints: Sequence[int] = (1, 0)) -> Iterator[Setting]:
    """One joint or all, in one recording or in all."""
    for count, files in itertools.product(joints, (1, 0)):
        where = f"{'one' if count else 'all'}-joint{'s' * (not count)}-{'one-file' if files else 'all-files'}"
        yield Setting(kind, f"{name}-{where}", change, count, files)


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
