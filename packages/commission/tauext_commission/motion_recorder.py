"""The recorder of a commissioned arm: recordings, labels and coverage within a bound of disk space."""

from __future__ import annotations

import json
import math
import os
import re
import stat
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tauext.data.importers.raw import short_list
from tauext.data.labels import Label
from tauext.data.recording_file import load_recording
from tauext.errors import TauextError
from tauext.files.plain_file import json_of, read_text
from tauext.monitor.flight_files import ENDINGS, PART
from tauext.monitor.monitored_time import Monitored
from tauext.monitor.record_sink import RecordSink
from tauext.monitor.sink import Control, LoopReport
from tauext.monitor.source import SourceSettings
from tauext_commission import journal
from tauext_commission.folder import NEAR_NS, CommissionFolder, Segment
from tauext_commission.history_file import BUNDLES, NOTED, monitored_of
from tauext_commission.synced_file import reserve, set_aside, write_synced

# --- Coverage: what each joint has done so far, and what is missing in words.


CELLS, CELL_RAD, CELL_M = 128, 2 * np.pi / 64, 0.01
"""Position cells of a joint, clipped at the ends: two turns, or 1.28 m of a sliding joint."""
SPEEDS_RAD_S = (0.02, 0.1, 0.3, 0.6, 1.0, 1.5, 2.2)
"""Edges of the speed cells, one set for each direction; below the first one a joint is at rest."""
OFTEN = 12
"""A cell that this many recordings have visited holds no new motion."""
NEWS = 0.05
"""Least share of a recording's samples in cells that are not known yet, so that it is new motion."""
LOOK_HZ = 50.0
SLOW_RAD_S, FAST_RAD_S = 0.1, 0.3
LEAST_REVERSALS, LEAST_REST_S, LEAST_SLOW_S, LEAST_SHARE = 10, 5.0, 5.0, 0.6


@dataclass
class Coverage:
    """Sums over all received motion, by joint."""

    joints: tuple[str, ...]
    width: np.ndarray
    """Width of a position cell of each joint, [rad or m]."""
    cells: np.ndarray
    """Number of kept recordings that visited each cell, (joints, CELLS, speeds), at most OFTEN."""
    visited: np.ndarray
    """Whether any recording visited a position, (joints, CELLS)."""
    rest_s: np.ndarray
    slow_s: np.ndarray
    fastest: np.ndarray
    reversals: np.ndarray
    """(joints, 2): from forward to backward, from backward to forward."""
    seconds: float = 0.0
    kept_s: float = 0.0
    """Training and test motion."""
    dropped_s: float = 0.0
    begin: int = 0
    """Number of the first recording since whose arm the cells are counted."""

    @classmethod
    def new(cls, arm: SourceSettings) -> Coverage:
        n = len(arm.joints)
        slides = np.array([unit == "N" for unit in arm.torque_units] or [False] * n)
        return cls(
            arm.joints,
            np.where(slides, CELL_M, CELL_RAD),
            np.zeros((n, CELLS, 1 + 2 * len(SPEEDS_RAD_S)), dtype=np.uint8),
            np.zeros((n, CELLS), dtype=bool),
            rest_s=np.zeros(n),
            slow_s=np.zeros(n),
            fastest=np.zeros(n),
            reversals=np.zeros((n, 2), dtype=np.int64),
        )

    @classmethod
    def load(cls, path: Path, arm: SourceSettings) -> Coverage:
        """Load what save() wrote; an unusable file gives new cells, with the times in coverage.json beside it."""
        made = cls.new(arm)
        with suppress(OSError, ValueError, LookupError, TypeError):
            times = json_of(read_text(path.with_suffix(".json")))
            made.seconds, made.kept_s, made.dropped_s = (float(times[name]) for name in TIMES)
        try:
            with np.load(path) as file:
                kept = {name: file[name] for name in ARRAYS}
                sums = file["sums"].tolist()
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
            return made
        if any(kept[name].shape != getattr(made, name).shape for name in ARRAYS) or len(sums) != 4:
            return made
        return replace(made, **kept, seconds=sums[0], kept_s=sums[1], dropped_s=sums[2], begin=int(sums[3]))

    def save(self, path: Path) -> None:
        part = path.with_name(path.name + ".part")
        with part.open("wb") as file:
            sums = np.array([self.seconds, self.kept_s, self.dropped_s, self.begin])
            np.savez(file, sums=sums, **{name: getattr(self, name) for name in ARRAYS})
            file.flush()
            os.fsync(file.fileno())
        if path.is_dir():
            set_aside(path)
        part.replace(path)

    def see(self, q: np.ndarray, dq: np.ndarray, period_s: float) -> tuple[np.ndarray, float]:
        """Add received motion (samples, joints); returns its cells and the share of it that is new."""
        stride = max(1, round(1 / (LOOK_HZ * period_s)))
        lasting = np.minimum(np.abs(dq[:-1]), np.abs(dq[1:])) if len(dq) > 1 else np.abs(dq)
        self.fastest = np.maximum(self.fastest, lasting.max(axis=0))
        q, dq = q[::stride], dq[::stride]
        step_s = stride * period_s
        position = np.clip(np.floor(q / self.width).astype(int) + CELLS // 2, 0, CELLS - 1)
        speed = np.searchsorted(SPEEDS_RAD_S, np.abs(dq), side="right")
        speed = np.where(dq < 0, speed + len(SPEEDS_RAD_S) * (speed > 0), speed)
        joint = np.arange(q.shape[1])
        self.visited[joint, position] = True
        still = np.abs(dq) < SPEEDS_RAD_S[0]
        self.rest_s += step_s * still.sum(axis=0)
        self.slow_s += step_s * (~still & (np.abs(dq) < SLOW_RAD_S)).sum(axis=0)
        for j in joint:
            ways = np.sign(dq[~still[:, j], j])
            turns = np.diff(ways)
            self.reversals[j] += [int((turns < 0).sum()), int((turns > 0).sum())]
        flat = np.ravel_multi_index((np.broadcast_to(joint, position.shape), position, speed), self.cells.shape)
        new = self.cells.ravel()[flat] < OFTEN
        return flat, float(new.any(axis=1).mean())

    def keep(self, flat: np.ndarray) -> None:
        """Count a kept recording's cells."""
        cells, at = self.cells.reshape(-1), np.unique(flat)
        cells[at] = np.minimum(cells[at] + 1, OFTEN)

    def facts(self, kept_bytes: int, bytes_most: int, needs_s: float | None) -> dict[str, Any]:
        """Content of coverage.json."""
        joints = []
        for j, name in enumerate(self.joints):
            at = np.flatnonzero(self.visited[j])
            share = len(at) / (at[-1] - at[0] + 1) if len(at) else 0.0
            joints.append(
                {
                    "joint": name,
                    "speed": round(float(self._speeds(j).mean()), 3),
                    "reversals": self.reversals[j].tolist(),
                    "positions": round(float(share), 3),
                    "rest_s": round(float(self.rest_s[j]), 1),
                    "fastest": round(float(self.fastest[j]), 4),
                    "missing": self.missing(j, share),
                }
            )
        return {
            **{name: round(getattr(self, name), 3) for name in TIMES},
            "bytes": kept_bytes,
            "bytes_most": bytes_most,
            "needs_s": needs_s,
            "joints": joints,
        }

    def _speeds(self, j: int) -> np.ndarray:
        """Which speed cells up to the fastest seen were visited, in each direction."""
        most = max(1, int(np.searchsorted(SPEEDS_RAD_S, self.fastest[j], side="right")))
        seen = self.cells[j].any(axis=0)[1:].reshape(2, -1)[:, :most]
        return seen.ravel()

    def missing(self, j: int, share: float) -> list[str]:
        """What training still lacks of a joint, in terms of what a person can do."""
        slides = self.width[j] == CELL_M
        unit, fastest = ("m/s", self.fastest[j]) if slides else ("rad/s", self.fastest[j])
        if fastest < SPEEDS_RAD_S[0]:
            return ["never moved; let it move through its working range"]
        words = []
        if not slides and fastest < FAST_RAD_S:
            words.append(f"never moved faster than {fastest:.2g} {unit}; let it make a long fast move")
        for count, way in zip(self.reversals[j].tolist(), ("forward to backward", "backward to forward"), strict=True):
            if count < LEAST_REVERSALS:
                times = f"only {count} times" if count else "never"
                words.append(f"{times} reversed from {way}; let it move to and fro ({LEAST_REVERSALS} reversals)")
        if self.slow_s[j] < LEAST_SLOW_S:
            words.append(f"hardly moved slowly (below {SLOW_RAD_S:g} {unit}); let it make a slow move")
        if self.rest_s[j] < LEAST_REST_S:
            words.append(f"stood still for only {self.rest_s[j]:.0f} s; let it pause for {LEAST_REST_S:g} s")
        if share < LEAST_SHARE:
            words.append(f"saw {share:.0%} of the positions between its extremes; let it stop or turn elsewhere, too")
        return words


ARRAYS = ("cells", "visited", "rest_s", "slow_s", "fastest", "reversals")
TIMES = ("seconds", "kept_s", "dropped_s")


# --- Which recordings are kept: sets, and what is dropped when the disk space is used up.


SEGMENT_S = 10.0
TRAIN_S = 64 * 60.0
"""Training motion that is enough; further motion is for the limits."""
SCHEDULE_MIN = (1, 2, 4, 8, 16, 32, 64)
"""Kept motion, [min], after which a training begins."""
EVERY, TEST = 5, 4
"""A recording whose number divided by EVERY has this remainder is for tests, and never trained on."""
TEST_SHARE = 0.2
"""Largest share of the recordings' space that test motion after the training takes."""
FRESH_S = 600.0
"""Newest motion, which is never dropped, [s]: answers may still come."""
RECORDINGS_SHARE, FLIGHTS_SHARE, DAMAGED_SHARE = 0.8, 0.15, 0.05
LOWERED = 0.98
"""Share of the bound to which recordings are dropped, so that this is seldom."""


LEARN_FROM = "learn_from"
"""Entry of commission.json: number of the first recording after a change of the arm that may be learned."""


def learns_from(folder: CommissionFolder) -> int:
    """Number of the first recording of the arm as it is: since the last change that may be learned."""
    return int(folder.facts.get(LEARN_FROM) or 0)


def segments_of_arm(folder: CommissionFolder) -> list[Segment]:
    """Recordings of the arm as it is."""
    begin = learns_from(folder)
    return [one for one in folder.segments() if one.number >= begin]


def motion_s(folder: CommissionFolder, segments: Sequence[Segment], sets: Collection[str] = ("train",)) -> float:
    """Motion of the arm as it is in these sets, [s]."""
    begin = learns_from(folder)
    return sum(one.seconds for one in segments if one.set in sets and one.number >= begin)


def set_of(number: int, is_news: bool, train_s: float) -> str:
    """Set of a kept recording; it never changes."""
    if number % EVERY == TEST:
        return "test"
    return "train" if is_news and train_s < TRAIN_S else "calibration"


def to_drop(
    segments: Sequence[Segment], labels: Iterable[Label], most_bytes: int, learned: int, first_test: int
) -> list[Segment]:
    """Recordings to drop so that the others fit: oldest first within each group.

    The groups in order: test motion beyond its share; calibration whose peaks are kept; other calibration; training
    motion; motion near labels. The newest FRESH_S are never dropped.

    Args:
        segments: in order of their numbers.
        learned: number of the last recording whose peaks are kept.
        first_test: number of recordings from which on test motion may be dropped.
    """
    total = sum(one.bytes for one in segments)
    if total <= most_bytes:
        return []
    fresh, seconds = set(), 0.0
    for one in reversed(segments):
        if seconds < FRESH_S:
            fresh.add(one.number)
        seconds += one.seconds
    labelled = {(one.epoch, one.from_ns - NEAR_NS, one.to_ns + NEAR_NS) for one in labels if one.answer != "suspect"}
    near = {
        epoch: np.array([span[1:] for span in labelled if span[0] == epoch]) for epoch in {span[0] for span in labelled}
    }
    test_bytes, spare = sum(one.bytes for one in segments if one.set == "test"), set()
    for one in segments:
        if one.set == "test" and one.number > first_test and test_bytes > TEST_SHARE * most_bytes:
            spare.add(one.number)
            test_bytes -= one.bytes

    def rank(one: Segment) -> int:
        if one.epoch in near and ((near[one.epoch][:, 0] <= one.to_ns) & (near[one.epoch][:, 1] >= one.from_ns)).any():
            return 4
        if one.set == "calibration":
            return 1 if one.number <= learned else 2
        return 0 if one.number in spare else 3

    dropped = []
    for one in sorted((one for one in segments if one.number not in fresh), key=lambda one: (rank(one), one.number)):
        if total <= LOWERED * most_bytes:
            break
        dropped.append(one)
        total -= one.bytes
    return dropped


# --- The sink.


class MotionRecorder(RecordSink):
    """Keeps recordings without contact column, coverage, and the bound of disk space.

    Every run, and every restart of the source's clock, is another epoch.
    """

    def __init__(
        self,
        folder: CommissionFolder,
        arm: SourceSettings,
        source: str,
        budget_bytes: float,
        bundle_name: Callable[[], str] = lambda: "",
    ):
        super().__init__(folder.path, arm, source, SEGMENT_S, bundle_name, is_expected=False)
        self._kept = folder
        self._budget = budget_bytes
        self.epoch = 0
        self._begun = 0
        """Number of the first recording of this run while the folder does not hold it yet; 0: it does."""
        self._monitored: dict[str, list[float]] = {}
        """Seconds that each bundle monitored, and seconds that were counted."""
        self._report = Monitored()

    def open(self, joints: tuple[str, ...], control: Control) -> None:
        folder = self._kept
        self._segments = repaired(folder)
        known = [int(folder.facts.get("epoch") or 0), *(one.epoch for one in self._segments)]  # lines may be lost
        self.epoch = self._writing = max(known) + 1
        self._number = folder.next_number() - 1
        self._begun = self._number + 1
        with suppress(OSError):  # the arm is monitored all the same
            self._begin_epoch()
        self._coverage = Coverage.load(folder.path / "coverage.npz", self._arm)
        is_lost = not self._coverage.visited.any() and bool(self._segments)
        if is_lost:
            self._coverage.seconds = max(folder.seconds(), sum(one.seconds for one in self._segments))
            self._coverage.kept_s = motion_s(folder, self._segments, ("train", "test"))
        self._monitored = {one: [a, b] for one, (a, b) in monitored_of(folder.coverage()).items()}
        with suppress(OSError):  # a full disk loses recordings; the arm is monitored all the same
            self._tidy()
        if is_lost:
            self.worker.put(self._see_again, must=True)
        super().open(joints, control)

    def _begin_epoch(self) -> None:
        """Keep the epoch and the number of the first recording, before there is one."""
        if self._begun:
            self._kept.save(epoch=self._writing, first=self._begun)
            self._begun = 0

    # The loop's thread.

    def every_second(self, report: LoopReport) -> None:
        super().every_second(report)
        was, self._report = self._report, report.monitored
        sums = self._monitored.setdefault(self._bundle_name(), [0.0, 0.0])
        sums[0] += self._report.seconds - was.seconds
        sums[1] += self._report.of_seconds - was.of_seconds

    def _clock_restarted(self) -> None:
        self.epoch += 1
        self.worker.put(partial(self._try, self._set_epoch, self.epoch), must=True)

    # The recorder's thread.

    def _try(self, do: Callable[..., None], *arguments: Any) -> None:
        try:
            do(*arguments)
        except Exception as error:  # a full disk, for example: the next recording is tried again
            self.count.error = self.count.error or f"{type(error).__name__}: {error}"

    def _set_epoch(self, epoch: int) -> None:
        self._writing = epoch
        self._kept.save(epoch=epoch)

    def _see_again(self) -> None:
        """Rebuild the coverage from the recordings; its file is missing or damaged."""
        self._kept.report("coverage.npz was missing or damaged, and is made again from the recordings")
        coverage = self._coverage
        coverage.begin = learns_from(self._kept)
        for one in [one for one in self._segments if one.number >= coverage.begin][-MOST_SEEN:]:
            with suppress(TauextError):
                motion = load_recording(self._kept.path / one.name, ("q", "dq"))
                coverage.keep(coverage.see(motion.q, motion.dq, 1 / motion.rate_hz)[0])
        with suppress(OSError):
            self._tidy()

    def _write(self, segment: dict[str, np.ndarray]) -> None:
        self._try(self._keep_news, segment)

    def _keep_news(self, segment: dict[str, np.ndarray]) -> None:
        if (begin := learns_from(self._kept)) != self._coverage.begin:  # no motion of the changed arm is recorded yet
            self._coverage.begin = begin
            self._coverage.cells[:] = 0
        t_ns, period_s = segment["t_ns"], 1e-9 * self._arm.period_ns
        seconds = len(t_ns) * period_s
        flat, news = self._coverage.see(segment["q"], segment["dq"], period_s)
        self._coverage.seconds += seconds
        is_news = news >= NEWS
        stands = bool((np.abs(segment["dq"]) < SPEEDS_RAD_S[0]).mean() > 0.99)
        if stands and not is_news and not self._is_near_label(t_ns):
            self._coverage.dropped_s += seconds
        else:
            self._keep(segment, seconds, is_news, flat)
        self._tidy()

    def _keep(self, segment: dict[str, np.ndarray], seconds: float, is_news: bool, flat: np.ndarray) -> None:
        self._number += 1
        path = self._folder / f"seg-{self._number:06d}.parquet"
        of_set = set_of(self._number, is_news, motion_s(self._kept, self._segments))
        facts = {"command": "tauext commission", "epoch": self._writing, "seq": self._number, "set": of_set}
        columns = {name: values for name, values in segment.items() if name != "contact"}
        try:
            self._begin_epoch()
        except OSError as error:
            self._lose(columns, str(error.strerror or error))
        if self._begun or self._save(columns, path, facts) is None:
            self._number -= 1
            return
        self._coverage.keep(flat)
        if of_set != "calibration":
            self._coverage.kept_s += seconds

    def _is_near_label(self, t_ns: np.ndarray) -> bool:
        return any(
            one.epoch == self._writing and one.from_ns - NEAR_NS <= t_ns[-1] and one.to_ns + NEAR_NS >= t_ns[0]
            for one in self._kept.labels()
        )

    def _tidy(self) -> None:
        """Drop recordings and flights beyond the bound; write the split and the coverage."""
        folder, most = self._kept, int(RECORDINGS_SHARE * self._budget)
        before, self._segments = self._segments, folder.segments()
        gone = sorted({one.name for one in before} - {one.name for one in self._segments})
        gone = [one for one in gone if not any(folder.path.glob(f"{one}.damaged*"))]
        if gone:
            folder.report(f"recordings are missing or damaged, by another program: {short_list(gone, 4)}")
        first_test = next((one.number for one in self._segments if one.set == "calibration"), self._number)
        dropped = to_drop(self._segments, folder.labels(), most, learned_up_to(folder), first_test)
        names = {one.name for one in dropped}
        kept = [one for one in self._segments if one.name not in names]
        folder.put_split(kept)
        for one in dropped:
            (folder.path / one.name).unlink(missing_ok=True)
            self._coverage.dropped_s += one.seconds
        self._segments = kept
        trim_flights(folder.flights, int(FLIGHTS_SHARE * self._budget))
        if dropped_files := trim_damaged(folder.path, int(DAMAGED_SHARE * self._budget)):
            folder.log(f"damaged files beyond {DAMAGED_SHARE:.0%} of the disk space are removed: {dropped_files}")
        kept_s = motion_s(folder, self._segments, ("train", "test"))
        needs = next((60 * minutes - kept_s for minutes in SCHEDULE_MIN if 60 * minutes > kept_s), None)
        size = sum(one.bytes for one in self._segments)
        content = self._coverage.facts(size, int(self._budget), None if needs is None else round(needs, 1))
        content |= {"monitored": {one: [round(s, 1) for s in sums] for one, sums in [*self._monitored.items()] if one}}
        content[NOTED] = journal.read(folder.path).last
        if not math.isnan(hour := self._report.hour):
            content["monitored_hour"] = round(hour, 5)
        self._coverage.save(folder.path / "coverage.npz")
        write_synced(folder.coverage_file, json.dumps(content) + "\n")
        reserve(folder.path)


LEARNED = "learned.json"
"""Number of the last recording whose peaks the trainer has kept."""


def learned_up_to(folder: CommissionFolder) -> int:
    try:
        return int(json_of(read_text(folder.path / LEARNED))["number"])
    except (OSError, ValueError, KeyError, TypeError):
        return 0


MOST_SEEN = 600
"""Newest recordings from which a lost coverage is made again."""
CHECKED = 6
"""Newest recordings that are read at the start: a power failure may have damaged them."""


def repaired(folder: CommissionFolder) -> list[Segment]:
    """The recordings of a folder whose last process was killed or lost its power; damaged ones are set aside."""
    segments = folder.segments()
    whole = {one.name for one in segments[:-CHECKED]}
    for one in segments[-CHECKED:]:
        with suppress(TauextError):
            load_recording(folder.path / one.name)
            whole.add(one.name)
    for path in sorted(folder.path.glob("seg-*.parquet")):
        if path.name not in whole and not folder.unwritable:
            folder.set_aside(path, "it cannot be read")
    good = [one for one in segments if one.name in whole]
    with suppress(OSError):  # a full disk: what was there before serves as well
        folder.put_split(good)
    return good


FLIGHT_KIND = re.compile(r"-(fault|contact|collision)(-\d+)?$")
"""End of a flight's name: kind of its event, and a number where the name was taken."""
DROPPED_FIRST = ("fault", "contact", "collision")
"""Kinds of flights in the order in which they are dropped."""


def trim_flights(folder: Path, most_bytes: int) -> None:
    """Remove flights beyond the bound: first those of faults, then of contacts, then of collisions; the oldest first.

    The newest flight of all stays. The files of one flight go together.
    """
    flights: dict[str, list[Path]] = {}
    for path in folder.glob("*"):
        if path.is_file():
            ending = next((one for one in (PART, *ENDINGS) if path.name.endswith(one)), path.suffix)
            flights.setdefault(path.name.removesuffix(ending), []).append(path)
    if not flights:
        return
    sizes = {name: sum(path.stat().st_size for path in files) for name, files in flights.items()}
    times = {name: max(path.stat().st_mtime for path in files) for name, files in flights.items()}
    total, newest = sum(sizes.values()), max(times, key=lambda name: times[name])

    def rank(name: str) -> tuple[int, float]:
        kind = FLIGHT_KIND.search(name)
        return DROPPED_FIRST.index(kind[1]) if kind else 0, times[name]

    for name in sorted(flights.keys() - {newest}, key=rank):
        if total <= most_bytes:
            return
        for path in flights[name]:
            path.unlink(missing_ok=True)
        total -= sizes[name]


DAMAGED = re.compile(r"(?P<name>.+)\.damaged(-\d+)?$")
"""Name of a file that was set aside."""


def trim_damaged(folder: Path, most_bytes: int) -> str:
    """Remove files that were set aside beyond the bound, in the folder and that of its bundles; their names.

    First recordings, then other files, at last those of the journal; the oldest first. The newest stays.
    """
    found = {path: path.lstat() for at in (folder, folder / BUNDLES) for path in at.glob("*.damaged*")}
    found = {
        path: status for path, status in found.items() if DAMAGED.match(path.name) and stat.S_ISREG(status.st_mode)
    }
    total = sum(status.st_size for status in found.values())
    if total <= most_bytes:
        return ""

    def rank(path: Path) -> tuple[int, float]:
        kind = 0 if path.name.startswith("seg-") else 2 if path.name.startswith("journal") else 1
        return kind, found[path].st_mtime

    removed, newest = [], max(found, key=lambda path: found[path].st_mtime)
    for path in sorted(found.keys() - {newest}, key=rank):
        if total <= most_bytes:
            break
        path.unlink(missing_ok=True)
        total -= found[path].st_size
        removed.append(path.name)
    return ", ".join(removed)
