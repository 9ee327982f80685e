"""What the arm says that it carries, by the last seconds of its samples: `tauext load`, on the page."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.data.recording import Recording
from tauext.errors import TauextError
from tauext.monitor.frame import load_frame
from tauext.monitor.identify import LoadEstimate, identify
from tauext.monitor.rows import see
from tauext.monitor.weighable import expect_weighable
from tauext.monitor.windows import between
from tauext.monitor.words import load_sentences
from tauext.page.snapshot import Snapshot
from tauext.sim.arms import DemoArm
from tauext.sim.plant import Sample

WEIGHED_S = 4.0
"""What is weighed at most: the latest."""
LEAD_S = 3.0
"""Before it: until the prior knows where the joints stand in their stiction."""
SETTLED = 5.0
"""Times 1/K0, after which the observer has followed what was put in to less than 1 %."""
EVERY_S = 1.0
LEAST_S = 1.0
"""Less motion than that is not weighed: no joint has gone far."""


@dataclass(frozen=True)
class Stretch:
    """Samples one after the other, and when what is weighed was put in."""

    t_ns: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    tau: np.ndarray
    since_ns: int


class Recent:
    """The last seconds of samples, in memory of a fixed size."""

    def __init__(self, arm: DemoArm):
        self._size = round((WEIGHED_S + LEAD_S) * arm.rate_hz)
        self._t_ns = np.zeros(self._size, np.int64)
        self._signals = np.zeros((3, self._size, len(arm.joints)))
        self._count = 0

    def add(self, sample: Sample) -> None:
        row = self._count % self._size
        self._t_ns[row] = sample.t_ns
        self._signals[0, row], self._signals[1, row], self._signals[2, row] = sample.q, sample.dq, sample.tau
        self._count += 1

    def stretch(self, since_ns: int) -> Stretch:
        """A copy of them, oldest first."""
        rows = np.arange(max(0, self._count - self._size), self._count) % self._size
        q, dq, tau = self._signals[:, rows]
        return Stretch(self._t_ns[rows], q, dq, tau, since_ns)


def weigh(bundle: _core.Bundle, arm: DemoArm, stretch: Stretch) -> LoadEstimate | None:
    """The load in the hand since it was put in, at most over WEIGHED_S; None: too little of it yet.

    Raises:
        TauextError: this bundle can weigh nothing.
    """
    expect_weighable(bundle)
    recording = Recording(
        name="the last seconds",
        joints=arm.joints,
        t_ns=stretch.t_ns,
        q=stretch.q,
        dq=stretch.dq,
        tau=stretch.tau,
        rate_hz=float(arm.rate_hz),
        torque_timing="held",
        source=arm.title,
        robot_sha256="",
    )
    end_s = 1e-9 * (stretch.t_ns[-1] - stretch.t_ns[0])
    known_s = 1e-9 * (stretch.since_ns - stretch.t_ns[0]) + SETTLED / bundle.observer.gain_per_s
    from_s = max(known_s, end_s - WEIGHED_S)
    if end_s - from_s < LEAST_S:
        return None
    return identify(bundle, load_frame(bundle), [between(see(bundle, recording, threads=1), from_s, None)])


SHORT = {
    "load": "A load, but its mass is not told apart from its lever in these poses.",
    "contact": "This does not turn as gravity would: something touches the arm.",
    "unclear": "Neither a load nor one constant push explains it.",
}
"""By verdict, for a narrow page; `tauext load` says more."""


def weighed_words(found: LoadEstimate | None) -> str:
    """What was found, in a sentence or two."""
    if found is None:
        return "Weighing ..."
    if found.verdict == "load" and found.mass_seen:
        return f"Fits a load of {found.mass_kg:.2f} ± {found.mass_error_kg:.2f} kg."
    if found.verdict in SHORT:
        return SHORT[found.verdict]
    words = load_sentences(found, "the hand", "N m")[0]
    return f"{words[0].upper()}{words[1:]}."


class Weigher:
    """Weighs in a thread of its own, again and again while a weight is held and the arm moves."""

    def __init__(self, arm: DemoArm):
        self.words = ""
        self._arm = arm
        self._thread: threading.Thread | None = None
        self._bundles: dict[Path, _core.Bundle] = {}
        self._since_s = self._moved_s = self._asked_s = -np.inf

    def wants(self, snapshot: Snapshot) -> bool:
        """Whether samples should be sent to start(); not of an arm that has stood so long that they tell less again."""
        if snapshot.held is None:
            self.words, self._since_s = "", -np.inf
            return False
        if snapshot.held.since_s != self._since_s:
            self.words, self._since_s = weighed_words(None), snapshot.held.since_s
            self._moved_s = max(self._moved_s, self._since_s)
        if snapshot.doing == "moving":
            self._moved_s = snapshot.time_s
        busy = self._thread is not None and self._thread.is_alive()
        stands = snapshot.time_s - self._moved_s > WEIGHED_S - LEAST_S
        if busy or stands or snapshot.time_s - self._asked_s < EVERY_S:
            return False
        self._asked_s = snapshot.time_s
        return True

    def start(self, path: Path, stretch: Stretch) -> None:
        """Weigh by this bundle; `words` says the answer as soon as it is there."""
        self._thread = threading.Thread(target=self._weigh, args=(path, stretch, self._since_s), daemon=True)
        self._thread.start()

    def _weigh(self, path: Path, stretch: Stretch, since_s: float) -> None:
        try:
            if path not in self._bundles:
                self._bundles[path] = load_bundle(path)
            words = weighed_words(weigh(self._bundles[path], self._arm, stretch))
        except TauextError as refused:
            words = str(refused)
        if since_s == self._since_s:
            self.words = words
