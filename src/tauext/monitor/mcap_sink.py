"""The MCAP file of a live arm, written by a thread while the loop runs."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.errors import ConfigError
from tauext.monitor.mcap_log import COLUMNS, McapLog, expect_log
from tauext.monitor.sink import Control, LoopReport, Verdict

BATCH_S = 0.5
"""Length of a chunk of the file, in the time of the samples: a killed process loses about twice as much."""
MOST_WAITING = 20
"""Most batches in memory, ten seconds; further ones are lost and counted."""


class McapSink:
    """Keeps verdicts and hands them over in batches; a thread writes. A file without a sample is removed."""

    def __init__(self, path: Path, bundle: _core.Bundle, source: str, frame: str | None = None):
        """See McapLog. Raises ConfigError where there can be no such file; it is made by open()."""
        expect_log(path)
        self.note: Callable[[str], None] = lambda text: None
        """Called in the loop's thread; set it before open()."""
        self.patient = False
        """Whether the loop waits for the disk instead of losing samples: for a source faster than real time."""
        self.path, self.lost, self.error = path, 0, ""
        """lost: samples that are not in the file; error: why."""
        self._made = (path, bundle, source, frame)
        self._log: McapLog | None = None
        self._most = max(1, round(BATCH_S * 1e9 / bundle.observer.sample_period_ns))
        self._verdicts: list[Verdict] = []
        self._rows = self._reported = 0
        self._waiting: queue.SimpleQueue[list[Verdict] | None] = queue.SimpleQueue()

    @property
    def samples(self) -> int:
        """Samples in the file."""
        return 0 if self._log is None else self._log.samples

    def open(self, joints: tuple[str, ...], control: Control) -> None:
        self._log = log = McapLog(*self._made)
        if log.without:
            self.note(f"{self.path.name}: {log.without}")
        self._thread = threading.Thread(target=self._work, args=(log,), name="mcap", daemon=True)
        self._thread.start()

    def verdict(self, verdict: Verdict) -> None:
        self._verdicts.append(verdict)
        self._rows += len(verdict.t_ns)
        if self._rows >= self._most:
            self._hand_over()

    def every_second(self, report: LoopReport) -> None:
        self._hand_over()
        if self.lost > self._reported:
            self._reported = self.lost
            self.note(f"MCAP FILE LOSES SAMPLES: {self.lost:,} so far ({self.error})")

    def close(self) -> None:
        """Write what is left, and wait for the disk."""
        self._hand_over(last=True)
        self._waiting.put(None)
        self._thread.join()

    def _hand_over(self, last: bool = False) -> None:
        verdicts, self._verdicts, self._rows = self._verdicts, [], 0
        while self.patient and self._waiting.qsize() >= MOST_WAITING and self._thread.is_alive():
            time.sleep(1e-3)
        if self._waiting.qsize() >= MOST_WAITING and not last:
            self._lose(verdicts, "the disk was too slow")
        elif verdicts:
            self._waiting.put(verdicts)

    def _work(self, log: McapLog) -> None:
        while (verdicts := self._waiting.get()) is not None:
            try:
                self._add(log, verdicts)
            except Exception as error:  # continue with the next batch
                self._lose(verdicts, str(error))
        try:
            log.close()
        except ConfigError as error:
            self.error = self.error or str(error)

    def _add(self, log: McapLog, verdicts: list[Verdict]) -> None:
        came, changes = [one for one in verdicts if one.block is not None], [c for one in verdicts for c in one.changes]
        if not came:
            return log.add(np.zeros(0, np.int64), *[np.zeros((0, 0))] * 3, {}, changes)
        signals = (np.concatenate([getattr(one.block, name) for one in came]) for name in ("t_ns", "q", "dq", "tau"))
        estimates = {name: np.concatenate([one.estimates[name] for one in came]) for name in COLUMNS}
        log.add(*signals, estimates, changes)

    def _lose(self, verdicts: list[Verdict], why: str) -> None:
        self.lost += sum(len(one.block) for one in verdicts if one.block is not None)
        self.error = self.error or why
