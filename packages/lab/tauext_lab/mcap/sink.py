"""The MCAP file of a loop, written by a thread."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.errors import ConfigError
from tauext.monitor.background import BackgroundWorker
from tauext.monitor.sink import Control, LoopReport, Verdict
from tauext_lab.mcap.log import COLUMNS, McapLog, expect_log

BATCH_S = 0.5
"""Length of a chunk of the file, in the time of the samples: a killed process loses about twice as much."""
MOST_WAITING = 20
"""Most batches in memory, ten seconds; further ones are lost and counted."""


class McapSink:
    """Keeps verdicts and hands them over in batches; a thread writes. A file without a sample is removed."""

    def __init__(self, path: Path, bundle: _core.Bundle, source: str, frame: str | None = None, patient: bool = False):
        """See McapLog. Raises ConfigError where there can be no such file; it is made by open().

        Args:
            patient: whether the loop waits for the disk instead of losing samples, as a replay may.
        """
        expect_log(path)
        self.path, self.lost, self.error = path, 0, ""
        """lost: samples that are not in the file; error: why."""
        self._made = (path, bundle, source, frame)
        self._log: McapLog | None = None
        self._most = max(1, round(BATCH_S * 1e9 / bundle.observer.sample_period_ns))
        self._verdicts: list[Verdict] = []
        self._rows = self._reported = 0
        self.worker = BackgroundWorker("mcap", MOST_WAITING)
        self.worker.patient = patient

    @property
    def samples(self) -> int:
        """Samples in the file."""
        return 0 if self._log is None else self._log.samples

    def open(self, joints: tuple[str, ...], control: Control) -> None:
        self._control, self._log = control, McapLog(*self._made)
        if self._log.without:
            control.note(f"{self.path.name}: {self._log.without}")
        self.worker.start()

    def verdict(self, verdict: Verdict) -> None:
        self._verdicts.append(verdict)
        self._rows += len(verdict.t_ns)
        if self._rows >= self._most:
            self._hand_over()

    def every_second(self, report: LoopReport) -> None:
        self._hand_over()
        if self.lost > self._reported:
            self._reported = self.lost
            self._control.note(f"MCAP FILE LOSES SAMPLES: {self.lost:,} so far ({self.error})")

    def summary(self) -> str:
        return f"{self.path}: {self.samples:,} samples"

    def loss(self) -> str:
        of = self.lost + self.samples
        return f"{self.lost} of {of} samples of the MCAP file are lost: {self.error}" if self.error else ""

    def close(self) -> None:
        """Write what is left, and wait for the disk."""
        self._hand_over(last=True)
        self.worker.end()
        try:
            if self._log is not None:
                self._log.close()
        except ConfigError as error:
            self.error = self.error or str(error)

    def _hand_over(self, last: bool = False) -> None:
        verdicts, self._verdicts, self._rows = self._verdicts, [], 0
        if verdicts and not self.worker.put(partial(self._write, verdicts), must=last):
            self._lose(verdicts, "the disk was too slow")

    def _write(self, verdicts: list[Verdict]) -> None:
        try:
            self._add(verdicts)
        except Exception as error:  # continue with the next batch
            self._lose(verdicts, str(error))

    def _add(self, verdicts: list[Verdict]) -> None:
        assert self._log is not None  # open() made it
        came, changes = [one for one in verdicts if one.block is not None], [c for one in verdicts for c in one.changes]
        t_ns, q, dq, tau = (
            np.concatenate([getattr(one.block, name) for one in came]) if came else np.zeros(0, np.int64)
            for name in ("t_ns", "q", "dq", "tau")
        )
        estimates = {name: np.concatenate([one.estimates[name] for one in came]) for name in COLUMNS if came}
        self._log.add(t_ns, q, dq, tau, estimates, changes)

    def _lose(self, verdicts: list[Verdict], why: str) -> None:
        self.lost += sum(len(one.block) for one in verdicts if one.block is not None)
        self.error = self.error or why
