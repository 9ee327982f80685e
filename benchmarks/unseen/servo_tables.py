"""Tables of the simulated servo arm: torques against the truth, contacts, networks of the field, velocities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from tauext import _core, estimate_recording
from tauext.data.dataset import load_split
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording
from unseen.servo_judging import Verdicts, at_as_many_false
from unseen.velocities import estimators, judge

EDGES_NM = (0.02, 0.1, 0.2, 0.4, 0.8, 50.0)
FELT_NM = 0.1
VELOCITY_WINDOW_S = 0.2
"""That of arm.toml's template."""


def truth(raw: Path, name: str) -> dict[str, np.ndarray]:
    """True signals of a take at its samples, (samples, joints)."""
    with np.load(raw / f"{name}.truth.npz") as stored:
        return dict(stored)


def registers(raw: Path, name: str, what: str, joints: Sequence[str]) -> np.ndarray:
    """What the bus said of a take, (samples, joints)."""
    table = pq.read_table(raw / f"{name}.parquet", columns=[f"{what}_{joint}" for joint in joints])
    return np.column_stack([column.to_numpy() for column in table.columns])


def linear_law(raw: Path, takes: Sequence[str], joints: Sequence[str]) -> np.ndarray:
    """The constant of each joint, [N m/A], by which the signed current explains the motor's true torque in free motion
    best: better than anybody without a torque sensor could fit it."""
    a = np.concatenate([registers(raw, take, "signed", joints) for take in takes])
    b = np.concatenate([truth(raw, take)["motor_nm"] for take in takes])
    return np.asarray((a * b).sum(axis=0) / (a * a).sum(axis=0))


def tests_of(data: Path) -> list[Recording]:
    """Free motion and contacts of a dataset."""
    split = load_split(data)
    return [load_recording(data / name) for name in (*split.test, *split.collisions)]


def torque_row(name: str, raw: Path, torques: Mapping[str, np.ndarray]) -> str:
    """RMS error of the motor's torque in free motion and while something touches the arm, joint by joint.

    Args:
        torques: of every test take, (samples, joints), [N m].
    """
    free, touched = [], []
    for take, torque in torques.items():
        true = truth(raw, take)
        touching = (true["tau_ext"] != 0).any(axis=1)
        error = torque - true["motor_nm"]
        free.append(error[~touching])
        touched.append(error[touching])
    cells = []
    for errors in (free, touched):
        square = np.concatenate(errors) ** 2
        joints = " · ".join(f"{x:.3f}" for x in np.sqrt(square.mean(axis=0)))
        cells += [f"{np.sqrt(square.mean()):.3f}", joints]
    return f"| {name} | {' | '.join(cells)} |"


def judged(bundle_path: Path, data: Path) -> tuple[Verdicts, list[float]]:
    """What a bundle said on the test recordings; RMS of tau_ext less the truth in free motion and in contacts."""
    bundle, verdicts = _core.Bundle.load(str(bundle_path)), Verdicts()
    free, touched = [], []
    for recording in tests_of(data):
        estimates = estimate_recording(bundle, recording)
        verdicts.add_estimates(recording, estimates, bundle.hold_s, bundle.observer.gain_per_s)
        assert recording.tau_ext is not None
        error = (estimates.tau_ext - recording.tau_ext)[estimates.healthy]
        touching = (recording.tau_ext != 0).any(axis=1)[estimates.healthy]
        free.append(error[~touching])
        touched.append(error[touching])
    return verdicts, [float(np.sqrt(np.mean(np.concatenate(errors) ** 2))) for errors in (free, touched)]


def contact_cells(verdicts: Verdicts, strong: Sequence[bool]) -> str:
    """Found of the strong ones, of all, by strength; false alarms; delay."""
    peaks = np.array(verdicts.peaks_nm)
    cells = [_share(verdicts.found_among(strong)), _share(verdicts.found_among(np.ones(len(peaks))))]
    for low, high in zip(EDGES_NM[:-1], EDGES_NM[1:], strict=True):
        found, of = verdicts.found_among((peaks >= low) & (peaks < high))
        cells.append(f"{found}/{of}")
    delays = np.array(verdicts.delays_s)
    delay = f"{1000 * np.median(delays):.0f}, {1000 * np.quantile(delays, 0.95):.0f}" if len(delays) else "–"
    return " | ".join(
        [*cells, str(verdicts.false_free), str(verdicts.false_after), f"{verdicts.free_hours:.2f}", delay]
    )


def _share(counts: tuple[int, int]) -> str:
    found, of = counts
    return f"{found}/{of} ({found / of:.0%})" if of else "0/0"


CONTACT_HEAD = (
    "| torque from | {first} | found at 1.5 times the limit | of all | "
    + " | ".join(
        f"{a:g} to {b:g} Nm" if b < 50 else f"over {a:g} Nm" for a, b in zip(EDGES_NM[:-1], EDGES_NM[1:], strict=True)
    )
    + " | false | after a contact | in h | delay, ms: median, 95 % |"
)


def deep_verdicts(kept: Path, data: Path, false: int) -> tuple[Verdicts, float, Verdicts]:
    """A predicting network at the limits that its held-out motion gives, and at as many false alarms as another method.

    Its limits are the largest residuals held out, joint by joint; the second ones are these times a factor.
    """
    with np.load(kept / "held-out.npz") as held:
        limit = np.abs(held["signal"] - held["prediction"]).max(axis=0)
    ratios = {}
    for recording in tests_of(data):
        with np.load(kept / f"{recording.name}.npz") as said:
            ratios[recording.name] = (np.abs(said["signal"] - said["prediction"]) / limit).max(axis=1)
    recordings = tests_of(data)

    def at(factor: float) -> Verdicts:
        verdicts = Verdicts()
        for recording in recordings:
            healthy = recording.time_s > 1.0
            verdicts.add(recording, (ratios[recording.name] > factor) & healthy, healthy)
        return verdicts

    factor, equal = at_as_many_false(at, false)
    return at(1.0), factor, equal


def explained(raw: Path, kept: Path, touched: str, untouched: str) -> tuple[float, float]:
    """Share of what a contact changes in the motor's signal that the network predicts from its inputs: where the signal
    is no larger than in the same motion untouched, and over all.

    The same motion with contacts and without: least squares of the change of the prediction on that of the signal, over
    the joints and samples that the contact turns with more than FELT_NM, each joint in units of its signal.
    """
    felt = np.abs(truth(raw, touched)["tau_ext"]) > FELT_NM
    with np.load(kept / f"{touched}.npz") as a, np.load(kept / f"{untouched}.npz") as b:
        unit, usual = b["signal"].std(axis=0), np.abs(b["signal"]).max(axis=0)
        signal, said = ((a[name] - b[name]) / unit for name in ("signal", "prediction"))
        known = felt & (np.abs(a["signal"]) <= usual)
    within, overall = ((said * signal)[at].sum() / (signal**2)[at].sum() for at in (known, felt))
    return float(within), float(overall)


def seen_by(bundle_path: Path, data: Path) -> float:
    """Share of the true tau_ext that is in a bundle's answer: least squares joints and samples as in `explained`."""
    bundle, above, below = _core.Bundle.load(str(bundle_path)), 0.0, 0.0
    for recording in tests_of(data):
        said, true = estimate_recording(bundle, recording), recording.tau_ext
        assert true is not None
        at = said.healthy[:, None] & (np.abs(true) > FELT_NM)
        above += float((said.tau_ext[at] * true[at]).sum())
        below += float((true[at] ** 2).sum())
    return above / below


def velocity_rows(raw: Path, takes: Sequence[str], joints: Sequence[str], rate_hz: int, rotor: np.ndarray) -> list[str]:
    """A line an estimator."""
    rows: dict[str, list] = {}
    for take in takes:
        stamps = pq.read_table(raw / f"{take}.parquet", columns=["time"])["time"].to_numpy()
        t_ns, q = np.round(1e9 * stamps).astype(np.int64), registers(raw, take, "position", joints)
        for name, estimate in estimators(rate_hz, VELOCITY_WINDOW_S).items():
            rows.setdefault(name, []).append(judge(t_ns, estimate(t_ns, q), truth(raw, take)["dq"], rotor))
    lines = []
    for name, parts in rows.items():
        rms, still, invented = (
            np.sqrt(np.mean([getattr(part, key) ** 2 for part in parts]))
            for key in ("rms_rad_s", "still_rad_s", "invented_nm")
        )
        lag_ms = 1000 * np.mean([part.lag_s for part in parts])
        worst = max(part.worst_nm for part in parts)
        lines.append(f"| {rate_hz} | {name} | {rms:.4f} | {lag_ms:.0f} | {still:.4f} | {invented:.4f} | {worst:.3f} |")
    return lines
