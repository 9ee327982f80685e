"""What each part adds: estimator x limits x observer gain, at a bundle's own limits and at one false alarm an hour.

    python packages/lab/benchmarks/ablation.py DATA OUT [--models exact none] [--seeds 0 1 2] [--hours 8 5]

DATA is a dataset of `tauext simulate` with calibration and test hours. Recordings are reduced to RATE_HZ (positions and
speeds of every fifth sample, the torque's mean over the step), so that an hour costs a fifth. What OUT holds already is
not repeated; OUT gets tables.md.

Each estimator is trained once. Its output on a recording is computed once and judged by three kinds of limits: the
largest error on validation motion and no hold time [Lim2021]; a constant for a promised rate; one that follows the
error, for the same rate. All limits of one bundle are also scaled by one factor, to the same measured false alarm rate.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import arguments, checkpoint, head, in_parallel, joined, share_interval, table_row, tauext, write_tables
from tauext_lab.evaluate.collisions import find_collisions
from tauext_lab.evaluate.free_motion import FreeMotionErrors
from tauext_lab.evaluate.missed_curve import MissedCurve

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.bundle.estimates import Estimates, lacking
from tauext.config import AlarmConfig, FreeMotionConfig
from tauext.data.dataset import Split, load_split, save_split
from tauext.data.recording import SIGNALS, Recording
from tauext.data.recording_file import load_recording, save_recording
from tauext.files.provenance import VERSION
from tauext.fit.tail import rate_interval
from tauext.train.error_scale import HeldOut, collect_rows, fit_error_scale
from tauext.train.held_peaks import collect_peaks
from tauext.train.paper_limits import paper_limits, set_limits
from tauext.train.promised_limits import promised_limits

RATE_HZ = 200
GAINS_PER_S = (20.0, 50.0)
"""The paper's gain, which recipe prior also chooses on this arm, and the next one that it chooses from."""
ALARM = AlarmConfig()
MARGINS = FreeMotionConfig()
LIMITS = ("largest validation error", "constant", "adaptive")
ONE_AN_HOUR = 1.0
SEEDED = ("paper", "dense", "tauext")
"""Estimators with a network that are trained once a seed."""
ESTIMATORS = ("observer", "friction", "prior", "tauext", "dense", "paper")
AT_OTHER_GAIN = ("friction", "prior", "tauext", "dense")


# --- Data: the same recordings at a lower rate.


def reduced(recording: Recording) -> Recording:
    """The recording at RATE_HZ; a torque is its mean over the step that ends at its stamp."""
    every = round(recording.rate_hz / RATE_HZ)
    at = np.arange(every, recording.samples, every)
    signals = {name: getattr(recording, name)[at] for name in SIGNALS if getattr(recording, name) is not None}
    sums = np.cumsum(recording.tau, axis=0)
    signals["tau"] = (sums[at - 1] - np.vstack([np.zeros_like(sums[:1]), sums[at - 1][:-1]])) / every
    touched = recording.contact is not None and np.maximum.reduceat(recording.contact, np.r_[0, at])[:-1]
    return replace(
        recording,
        t_ns=recording.t_ns[at],
        rate_hz=float(RATE_HZ),
        torque_timing="averaged",
        contact=touched if recording.contact is not None else None,
        contact_link=recording.contact_link[at] if recording.contact_link is not None else None,
        **signals,
    )


def reduce_dataset(data: Path, out: Path, calibration_hours: float, test_hours: float) -> None:
    """Write the reduced dataset: DATA's motion of training and validation, its collisions, and hours of the rest."""
    if (out / "split.json").exists():
        return
    split = load_split(data)
    spans = [3600 * hours / 90 for hours in (calibration_hours, test_hours)]
    calibration, test = split.calibration[: round(spans[0])], split.test[: round(spans[1])]
    out.mkdir(parents=True, exist_ok=True)
    (out / "robot.xml").write_text((data / "robot.xml").read_text())
    for name in (*split.train, *split.validation, *split.collisions, *calibration, *test):
        if not (out / name).exists():
            save_recording(reduced(load_recording(data / name)), out / name)
    save_split(Split(split.train, split.validation, test, split.collisions, calibration), out)


# --- Estimators.


@dataclass(frozen=True)
class Job:
    """One estimator of one model at one gain."""

    estimator: str
    model: str
    gain_per_s: float
    seed: int

    @property
    def name(self) -> str:
        return f"{self.estimator}-{self.model}-{self.gain_per_s:g}-{self.seed}"


def jobs(models: list[str], seeds: list[int]) -> list[Job]:
    """Every estimator at the paper's gain, networks with every seed; some at the other gain, with one."""
    paper, other = GAINS_PER_S
    found = []
    for k, seed in enumerate(seeds):
        for model in models:
            at_paper_gain = ESTIMATORS if k == 0 else SEEDED
            found += [Job(estimator, model, paper, seed) for estimator in at_paper_gain]
            found += [Job(estimator, model, other, seed) for estimator in AT_OTHER_GAIN if k == 0]
    return found


def train(job: Job, data: Path, out: Path, paper: Path | None) -> Path | None:
    """The bundle of a job with limits as in the paper; None: a network of the paper's recipe that is not there.

    Args:
        paper: folder with bundles CASE-SEED.tauext of recipe paper, trained on the recordings before their reduction.
    """
    bundle = out / "bundles" / f"{job.name}.tauext"
    if bundle.exists():
        return bundle
    settings = out / "bundles" / f"{job.name}.toml"
    settings.parent.mkdir(parents=True, exist_ok=True)
    settings.write_text(f"observer.gain_per_s = {job.gain_per_s:g}\n")
    words = ["train", "--data", data, "--case", job.model, "--seed", job.seed, "--limits", "paper"]
    words += ["--threads", 1, "--config", settings, "--out", bundle]
    if job.estimator != "paper":
        tauext(*words, "--recipe", job.estimator, printed=bundle.with_suffix(".log"))
        return bundle
    if paper is None or not (source := paper / f"{job.model}-{job.seed}.tauext").exists():
        return None
    tauext(*words, "--recipe", "dense", "--max-steps", 1000, printed=bundle.with_suffix(".log"))
    made, network = load_bundle(bundle), load_bundle(source)
    made.shape, made.parameters = network.shape, network.parameters
    made.input_factors, made.output_scale_nm = network.input_factors, network.output_scale_nm
    first = load_recording(data / load_split(data).train[0])
    samples = made.window_steps * made.observer.network_stride + 1 + made.observer.network_stride
    made.set_reference(*(np.ascontiguousarray(a[:samples]) for a in (first.t_ns, first.q, first.dq, first.tau)))
    bundle.write_bytes(made.to_bytes())
    return bundle


# --- Three kinds of limits for one estimator, and their false alarms and detections.


def recordings(data: Path, names: tuple[str, ...]) -> Iterator[Recording]:
    return (load_recording(data / name) for name in names)


def with_outputs(bundle: _core.Bundle, recording: Recording) -> HeldOut:
    """The recording with the network's outputs; they do not depend on limits."""
    if not bundle.has_network:
        return HeldOut(recording)
    signals = (recording.t_ns, recording.q, recording.dq, recording.tau)
    return HeldOut(recording, outputs=_core.network_outputs(bundle, *signals, 1, None))


def judged_bundles(path: Path, data: Path, split: Split) -> dict[str, _core.Bundle]:
    """Copies of a bundle with each kind of limits."""
    first = load_bundle(path)
    validation = [with_outputs(first, one) for one in recordings(data, split.validation)]
    calibration = [with_outputs(first, one) for one in recordings(data, split.calibration)]
    found = {}
    for kind in LIMITS:
        bundle = found[kind] = load_bundle(path)
        bundle.error_scale = _core.ErrorScaleSettings()
        if kind == "adaptive":
            fit_error_scale(bundle, collect_rows(bundle, validation, 1, MARGINS))
        if kind == "largest validation error":
            set_limits(bundle, paper_limits(bundle, validation, 1, MARGINS), replace(ALARM, collision_hold_s=0.0))
        else:
            peaks = collect_peaks(bundle, calibration, ALARM.holds_s, 1, MARGINS)
            promised_limits(bundle, peaks, ALARM).put(bundle, ALARM)
    return found


def judge(path: Path, data: Path) -> dict:
    """False alarms and detections of a bundle with each kind of limits."""
    split = load_split(data)
    bundles = judged_bundles(path, data, split)
    first = next(iter(bundles.values()))
    errors = {kind: FreeMotionErrors(one.joints) for kind, one in bundles.items()}
    curves = {kind: MissedCurve(one.hold_s) for kind, one in bundles.items()}
    for names, touched in ((split.test, False), (split.collisions, True)):
        for recording in recordings(data, names):
            judged = with_outputs(first, recording)
            signals = (recording.t_ns, recording.q, recording.dq, recording.tau)
            for kind, bundle in bundles.items():
                columns = _core.estimate(bundle, *signals, 1, None, judged.outputs)
                absent = {"alarm", *lacking(bundle)}
                estimates = Estimates.of(recording.joints, recording.t_ns, columns, absent)
                if touched:
                    curves[kind].add_collisions(find_collisions(recording), recording, estimates)
                else:
                    errors[kind].add(recording, estimates)
                    curves[kind].add_free(recording, estimates)
    content: dict = {"version": VERSION, "gain_per_s": first.observer.gain_per_s, "network": first.has_network}
    for kind, bundle in bundles.items():
        summary = asdict(errors[kind].summary(None))
        free = {key: summary[key] for key in ("hours", "l1_nm", "l2_nm", "rmse_near_stiction_nm", "false_collisions")}
        points = [asdict(point) for point in curves[kind].summary()]
        limits = {"sliding": bundle.sliding_limit_nm, "near": bundle.near_stiction_limit_nm, "hold_s": bundle.hold_s}
        content[kind] = {"free": free, "curve": points, "limits": limits}
    return content


def at_rate(curve: list[dict], per_hour: float) -> dict | None:
    """The point with the lowest limits whose measured false alarm rate is at most this."""
    fitting = [point for point in curve if point["false_per_hour"] <= per_hour]
    return min(fitting, key=lambda point: point["scale"]) if fitting else None


def rows(out: Path, model: str, gain: float) -> Iterator[str]:
    """A line for each estimator and kind of limits: the seeds' mean, and their range where there are several."""
    for estimator in ESTIMATORS:
        paths = sorted(out.glob(f"judged/{estimator}-{model}-{gain:g}-*.json"))
        kept = [json.loads(path.read_text()) for path in paths]
        for kind in LIMITS if kept else ():
            free = [one[kind]["free"] for one in kept]
            curves = [one[kind]["curve"] for one in kept]
            collisions = 500
            own = [collisions - next(p["missed"] for p in curve if p["scale"] == 1.0) for curve in curves]
            equal = [collisions - point["missed"] for curve in curves if (point := at_rate(curve, ONE_AN_HOUR))]
            false, hours = [one["false_collisions"] for one in free], free[0]["hours"]
            low, high = rate_interval(sum(false), hours * len(false))
            yield table_row(
                estimator + ("" if len(kept) == 1 else f" ({len(kept)} seeds)"),
                kind,
                joined(np.mean([one["l1_nm"] for one in free], axis=0), ".2f", "/"),
                joined(np.mean([one[kind]["limits"]["sliding"] for one in kept], axis=0), ".1f", "/"),
                f"{spread(false)} ({low:.2f} to {high:.2f}/h)",
                detected(own, collisions),
                detected(equal, collisions),
            )


def spread(counts: list[int]) -> str:
    return f"{counts[0]}" if len(set(counts)) == 1 else f"{min(counts)} to {max(counts)}"


def detected(counts: list[int], of: int) -> str:
    if not counts:
        return "-"
    low, high = share_interval(round(np.mean(counts)), of)
    return f"{spread(counts)} ({low:.0f} to {high:.0f} %)"


COLUMNS = (
    "estimator | threshold | L1, N m | sliding, N m | false alarms (95 % of the rate) | detected of 500 at its own "
    "threshold (95 %) | detected at one measured false alarm an hour (95 %)"
)


def tables(out: Path, models: list[str]) -> list[str]:
    lines = []
    for model in models:
        for gain in GAINS_PER_S:
            lines += [f"**{'Exact model' if model == 'exact' else 'No model'}, K0 = {gain:g} 1/s**", "", *head(COLUMNS)]
            lines += [*rows(out, model, gain), ""]
    return lines


def run(job: Job, data: Path, out: Path, paper: Path | None) -> None:
    bundle = train(job, data, out, paper)
    if bundle is not None:
        checkpoint(out / "judged" / f"{job.name}.json", lambda: judge(bundle, data))
    print(job.name, "" if bundle else "has no network of the paper's recipe", flush=True)


def main() -> None:
    parser = arguments(__doc__, "data", "out", workers=2)
    parser.add_argument("--models", nargs="+", default=["exact", "none"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--hours", nargs=2, type=float, default=[8.0, 5.0], help="of calibration and of test motion")
    parser.add_argument("--paper", type=Path, help="folder with CASE-SEED.tauext of recipe paper")
    options = parser.parse_args()
    out, data = options.out, options.out / "data"
    reduce_dataset(options.data, data, *options.hours)
    in_parallel(options.workers, run, [(job, data, out, options.paper) for job in jobs(options.models, options.seeds)])
    write_tables(out, tables(out, options.models))


if __name__ == "__main__":
    main()
