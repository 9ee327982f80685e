"""The verdict on a mutation: what is found before training, and what the bundle is worth after it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tauext_lab.evaluate.config import EventsConfig
from tauext_lab.evaluate.events import EventMeasures, Labels, event_time

from tauext.config import PAPER_CASES, ObserverConfig, PriorConfig, TrainConfig
from tauext.data.dataset import load_dataset
from tauext.data.recording import Recording
from tauext.monitor.estimate import estimate_recording
from tauext.progress import SILENT
from tauext.robot.model_case import chosen_case
from tauext.train.data_check import check_results
from tauext.train.preparation import TrainingInput
from tauext.train.stage import train_bundle

VELOCITY = ("velocity-unit", "velocity-mismatch", "velocity-sign", "velocity-delay")
EFFORT = ("effort-scale", "effort-motor-side", "beyond-limit", "effort-compensated")
LOAD = ("payload", "effort-scale")
ONE_OF_MANY = ("odd-recording",)

FITTING: dict[tuple[str, str], tuple[str, ...]] = {
    ("factor", "q"): ("degrees", "beyond-limit", "joint-axis", "velocity-sign", "velocity-unit", "velocity-mismatch"),
    ("factor", "q-dq"): ("degrees", "beyond-limit", "joint-axis"),
    ("factor", "dq"): ("degrees", *VELOCITY),
    ("factor", "tau"): ("effort-sign", *EFFORT),
    ("amperes", "tau"): EFFORT,
    ("exchange", "q-dq-tau"): ("joint-order", "joint-axis", "beyond-limit"),
    ("exchange", "q"): ("joint-order", *VELOCITY),
    ("exchange", "dq"): ("joint-order", *VELOCITY),
    ("exchange", "tau"): ("joint-order",),
    ("spike", "q"): ("spike", "beyond-limit", "velocity-mismatch"),
    ("spike", "dq"): ("spike", "velocity-mismatch"),
    ("spike", "tau"): ("spike", "beyond-limit", "contact-in-free-motion"),
    ("stuck", "q"): ("stuck", "velocity-mismatch"),
    ("stuck", "dq"): ("stuck", "velocity-mismatch"),
    ("stuck", "tau"): ("stuck", "contact-in-free-motion"),
    ("delay", "tau"): ("torque-delay",),
    ("delay", "dq"): ("velocity-delay", "velocity-mismatch"),
    ("time-unit", ""): ("time-unit", "velocity-unit", "velocity-mismatch", "clock-irregular", "clock-gaps"),
    ("zero", "q"): ("position-offset", "beyond-limit"),
    ("thinned", ""): ("clock-irregular", "clock-gaps"),
    ("load", "tau"): LOAD,
    ("donor", ""): (*LOAD, "beyond-limit", "position-offset"),
    ("label", ""): ("contact-in-free-motion",),
}
"""By what is done and to which signals; "": whichever. One that tells an odd recording fits every mutation of some."""


def fits(what: str, signals: tuple[str, ...], code: str) -> bool:
    """Whether a finding of this code names the mutation."""
    head = what.split("-")[0] if what.startswith(("label-", "donor-")) else what
    codes = FITTING.get((head, "-".join(signals))) or FITTING[head, ""]
    return code in codes or code in ONE_OF_MANY


CONFIG = TrainConfig(
    recipe="prior", threads=1, observer=ObserverConfig(gain_per_s=20.0), prior=PriorConfig(most_ripples=0)
)
"""Two searches are left out, each of which takes longer than all the rest; clean and broken alike."""
TOLERANCE = 0.05
"""Of limits and of contacts found: less is no harm."""


@dataclass(frozen=True)
class Seen:
    """A finding before training."""

    code: str
    joint: str | None
    severity: str
    evidence: str
    recording: str | None = None

    @property
    def key(self) -> tuple[str | None, ...]:
        """Equal findings have equal keys; of contacts there are more where more are told."""
        count = self.evidence.split(" disturbance")[0] if self.code == "contact-in-free-motion" else None
        return (self.code, self.joint, self.severity, self.recording, count)


@dataclass(frozen=True)
class Worth:
    """Of a bundle."""

    limits_nm: list[float]
    """Median over free samples of the recordings it is judged on, a joint."""
    found: int
    events: int


def looked_at(folder: Path) -> list[Seen]:
    """Faults and warnings that a training on this dataset would be told before it learns anything.

    Raises:
        TauextError: it cannot even be read.
    """
    dataset = load_dataset(folder)
    robot = dataset.robot_file(None)
    case, _ = chosen_case(None, robot)
    recordings = dataset.training(), dataset.recordings("validation")
    results = check_results(dataset, TrainingInput(robot, PAPER_CASES[case], *recordings), CONFIG, SILENT)
    findings = [finding for result in results.values() for finding in result]
    return [Seen(f.code, f.joint, f.severity, f.evidence, f.recording) for f in findings]


def worth_of(folder: Path, out: Path, judged: Iterable[Recording]) -> Worth:
    """Train on the dataset, and judge the bundle on these recordings.

    Raises:
        TauextError: the training refuses, or the bundle does not fit the recordings.
    """
    bundle = train_bundle(load_dataset(folder), out, config=CONFIG, check=False)
    measures = EventMeasures(EventsConfig())
    limits = []
    for recording in judged:
        estimates = estimate_recording(bundle, recording, 1)
        labels = Labels(recording, EventsConfig(), CONFIG.observer.near_stiction_rad_s)
        measures.add_estimates(labels, estimates)
        limits.append(estimates.limit_nm[~event_time(recording, 0.5) & estimates.healthy])
    counts = measures.summary().all
    return Worth(np.median(np.concatenate(limits), axis=0).tolist(), counts.found, counts.events)


def verdict_before(
    what: str, signals: tuple[str, ...], seen: list[Seen], clean: list[Seen]
) -> tuple[str | None, list[Seen]]:
    """refused: a fault that the clean dataset lacks; named: a warning whose code fits; None: it would be trained on.

    And what is new.
    """
    known = {one.key for one in clean}
    new = [one for one in seen if one.key not in known]
    if any(one.severity == "fault" for one in new):
        return "refused", new
    if any(fits(what, signals, one.code) for one in new):
        return "named", new
    return None, new


def verdict_after(worth: Worth, clean: Worth) -> tuple[str, float]:
    """harmless or missed; the largest share by which a limit differs."""
    ratio = np.array(worth.limits_nm) / np.array(clean.limits_nm) - 1
    off = float(np.abs(ratio).max()) if np.isfinite(ratio).all() else float("inf")
    harmless = off <= TOLERANCE and abs(worth.found - clean.found) <= TOLERANCE * clean.found
    return ("harmless" if harmless else "missed"), off
