"""Peaks of all calibration motion, also of recordings that the disk no longer holds."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from tauext.bundle.bundle_file import load_bundle
from tauext.commission.folder import CommissionFolder, Segment
from tauext.commission.keep import LEARNED
from tauext.commission.suspects import Suspect
from tauext.config import AlarmConfig, FreeMotionConfig
from tauext.data.labels import MARGINS, Label
from tauext.files.append_file import write_synced
from tauext.files.checkpoint import Checkpoint
from tauext.train.calibrate import no_freeze
from tauext.train.held_peaks import collect_peaks

THREADS = 1
"""Training must not take cores from the loop."""


class Ledger:
    """Peaks and hours of the calibration motion under one model, and what of the labels they contain."""

    def __init__(self, folder: CommissionFolder, base: str):
        self._folder, self.base = folder, base
        self.collectors: list[Any] = []
        self.names: list[str] = []
        self.places: list[tuple[str, int, int, int]] = []
        """Name, epoch, first and last stamp of each recording in the peaks."""
        self.learned = 0
        self.limits_h = 0.0
        self.counted: set[int] = set()
        """Alarms answered `nothing` whose motion is in the peaks."""
        self.forgotten: dict[int, tuple[int, int]] = {}
        """Spans of labels whose peaks were left out."""
        self._checkpoint = Checkpoint(folder.path / "peaks.state", base)

    @classmethod
    def load(cls, folder: CommissionFolder, base: str) -> Ledger:
        made = cls(folder, base)
        if (state := made._checkpoint.load()) is not None:
            (made.collectors, made.names, made.places, made.learned) = state[:4]
            (made.limits_h, made.counted, made.forgotten) = state[4:]
            made.names = made.names[: len(made.places)]
        return made

    def put(self) -> None:
        """Keep the state, then allow the recorder to drop what was learned."""
        state = [self.collectors, self.names, self.places, self.learned, self.limits_h, self.counted, self.forgotten]
        self._checkpoint.put(state)
        write_synced(self._folder.path / LEARNED, json.dumps({"number": self.learned}) + "\n")

    @property
    def hours(self) -> float:
        return float(self.collectors[0].peaks().hours) if self.collectors else 0.0

    def offer(self, collectors: list[Any], names: Sequence[str]) -> None:
        """Part of KeptPeaks: the collectors after one more recording."""
        self.collectors = collectors

    def news(self, labels: Sequence[Label]) -> bool:
        """Whether answers are not in the peaks yet."""
        return any(one.answer == "nothing" and one.id not in self.counted for one in labels)

    def learn(self, fresh: Sequence[Segment], segments: Sequence[Segment]) -> None:
        """Add calibration motion; then leave out what labels called a touch since, and add answered alarms."""
        labels = self._folder.labels()
        learned = max([self.learned, *(one.number for one in fresh)])
        again = [one for one in labels if one.answer == "nothing" and one.id not in self.counted]
        false = [one for one in segments if any(meets(one, label) for label in again)]
        false = [one for one in false if one.set != "calibration" or one.number <= self.learned]
        bundle = load_bundle(self._folder.bundles / f"{self.base}.tauext")
        recordings = [*self._folder.load(fresh), *self._folder.load(false)]
        if recordings:
            places = [(r.name, int(r.provenance["epoch"]), int(r.t_ns[0]), int(r.t_ns[-1])) for r in recordings]
            with no_freeze(bundle):
                collect_peaks(bundle, recordings, AlarmConfig().holds_s, THREADS, margins=FreeMotionConfig(), kept=self)
            self.places += places
            self.names += [one.name for one in recordings]
        self.learned = learned
        self.counted = {one.id for one in labels if one.answer == "nothing"}
        self.forgotten = {id: span for id, span in self.forgotten.items() if id not in self.counted}
        self._forget(labels)
        self.put()

    def _forget(self, labels: Sequence[Label]) -> None:
        before, after = round(MARGINS.before_s * 1e9), round(MARGINS.after_s * 1e9)
        for label in labels:
            span = (label.from_ns - before, label.to_ns + after)
            if label.answer == "nothing" or self.forgotten.get(label.id) == span:
                continue
            for k, (_, epoch, from_ns, to_ns) in enumerate(self.places):
                if epoch == label.epoch and from_ns <= span[1] and to_ns >= span[0]:
                    for collector in self.collectors:
                        collector.forget(k, span[0] - from_ns, span[1] - from_ns)
            self.forgotten[label.id] = span


def meets(one: Segment | Suspect, label: Label) -> bool:
    return one.epoch == label.epoch and one.from_ns <= label.to_ns and one.to_ns >= label.from_ns
