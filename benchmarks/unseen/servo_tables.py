"""The simulated servo arm judged and put into tables: torques, contacts, networks of the field, velocities."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from common import joined, table_row

from tauext import _core, estimate_recording
from tauext.bundle.estimates import COLLISION, Estimates
from tauext.config import EventsConfig
from tauext.data.dataset import load_split
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording
from tauext.evaluate.collisions import GRACE_S, Collision, find_collisions, first_rise, judge_latched
from tauext.evaluate.errors import sensor_reference
from tauext.evaluate.events import event_time
from tauext.evaluate.free_motion import FALSE_ALARM_QUIET_S, beginnings, time_since_touch
from tauext.sim.servo_arm import COUNT_RAD

# --- Alarms against what is true: one judge for every method.


AFTER_CONTACT_S = 3.0
"""An alarm so soon after a contact is counted apart: the arm snaps back, and its gears settle."""


@dataclass
class Verdicts:
    """One method on all test recordings of one rate."""

    peaks_nm: list[float] = field(default_factory=list)
    """Largest true torque of each contact."""
    found: list[bool] = field(default_factory=list)
    strong: list[bool] = field(default_factory=list)
    """Over 1.5 times the limits of the method that limits are known of, for its hold time and 20 ms."""
    delays_s: list[float] = field(default_factory=list)
    false_free: int = 0
    false_after: int = 0
    free_hours: float = 0.0

    def add(self, recording: Recording, alarm: np.ndarray, healthy: np.ndarray) -> list[Collision]:
        """Take in one recording, with contacts or without; says its contacts.

        Args:
            alarm: (samples,) bool.
            healthy: (samples,) bool: while a method can say nothing, time is not free.
        """
        free = ~event_time(recording, EventsConfig().tolerance_s) & healthy
        self.free_hours += float(free.sum()) / recording.rate_hz / 3600
        begun = beginnings(alarm, round(FALSE_ALARM_QUIET_S * recording.rate_hz))
        since_s = time_since_touch(recording) if recording.contact is not None else np.full(recording.samples, np.inf)
        false_since_s = since_s[begun[free[begun]]]
        after = int((false_since_s <= AFTER_CONTACT_S).sum())
        self.false_after, self.false_free = self.false_after + after, self.false_free + len(false_since_s) - after
        touches = find_collisions(recording)
        for touch in touches:
            window = slice(touch.begin, min(touch.end + round(GRACE_S * recording.rate_hz), recording.samples))
            rise = first_rise(alarm[window], bool(alarm[touch.begin - 1]))
            self.peaks_nm.append(float(touch.true_peak_nm.max()))
            self.found.append(rise is not None)
            if rise is not None:
                self.delays_s.append(float(recording.t_ns[window][rise] - recording.t_ns[touch.begin]) * 1e-9)
        return touches

    def add_estimates(self, recording: Recording, estimates: Estimates, hold_s: float, gain_per_s: float) -> None:
        """Take in what a bundle said, as a monitor would have latched it."""
        assert estimates.held_alarm is not None
        touches = self.add(recording, estimates.held_alarm == COLLISION, estimates.healthy)
        reference = sensor_reference(recording, gain_per_s)
        self.strong += [judge_latched(t, recording, estimates, hold_s, reference).strong for t in touches]

    def found_among(self, chosen: Sequence[bool] | np.ndarray) -> tuple[int, int]:
        """Found, and how many there are, of the contacts that are chosen."""
        chosen = np.asarray(chosen, dtype=bool)
        return int(np.array(self.found)[chosen].sum()), int(chosen.sum())


def at_as_many_false(judged: Callable[[float], Verdicts], false: int) -> tuple[float, Verdicts]:
    """Limits times the smallest of many factors that leaves a method with no more false alarms than another has."""
    for factor in np.geomspace(0.2, 20, 60):
        verdicts = judged(float(factor))
        if verdicts.false_free + verdicts.false_after <= false:
            return float(factor), verdicts
    return float(factor), verdicts


# --- Velocity from 12-bit positions at the rates of servo buses: five estimators beside the truth.


LOW_PASS_HZ = 5.0
SLOPE_S = 0.2
JERK_RAD_S3 = 60.0
"""Standard deviation that the Kalman filter takes the jerk of a sample for: of an arm that starts and stops."""
LAGS_S = np.arange(0, 0.2001, 0.005)
STILL_RAD_S = 2e-3
STILL_FOR_S = 0.5


@dataclass(frozen=True)
class Judged:
    """Of one estimator, all joints together."""

    rms_rad_s: float
    """Error while some joint moves."""
    lag_s: float
    """The delay of the truth that it fits best."""
    still_rad_s: float
    """RMS where the joint has stood still for half a second."""
    invented_nm: float
    """RMS at standstill of the rotor's inertia times the estimate's change over a sample: torque that nobody exerts."""
    worst_nm: float
    """The largest of it."""


def estimators(rate_hz: float, window_s: float) -> dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]]:
    """By name: from stamps [ns] and positions (samples, joints) to velocities, each from the past alone.

    Args:
        window_s: longest window of the adaptive one, which is the core's.
    """
    return {
        "difference": _difference,
        f"difference, low-passed at {LOW_PASS_HZ:g} Hz": lambda t_ns, q: _low_passed(t_ns, _difference(t_ns, q)),
        f"slope over {SLOPE_S:g} s": lambda t_ns, q: _slope(t_ns, q, max(2, round(SLOPE_S * rate_hz))),
        "Kalman, constant acceleration": _kalman,
        f"adaptive window, at most {window_s:g} s": lambda t_ns, q: _adaptive(t_ns, q, rate_hz, window_s),
    }


def judge(t_ns: np.ndarray, estimate: np.ndarray, dq: np.ndarray, rotor_kg_m2: np.ndarray) -> Judged:
    """Against the true velocity (samples, joints)."""
    t_s, error = 1e-9 * (t_ns - t_ns[0]), estimate - dq
    moving = (np.abs(dq) > STILL_RAD_S).any(axis=1)
    delayed = [
        np.mean([np.mean((np.interp(t_s - lag, t_s, dq[:, j]) - estimate[:, j]) ** 2) for j in range(dq.shape[1])])
        for lag in LAGS_S
    ]
    steps = max(1, round(STILL_FOR_S / float(np.median(np.diff(t_s)))))
    moved = np.cumsum(np.abs(dq) > STILL_RAD_S, axis=0)
    still = np.zeros(dq.shape, dtype=bool)
    still[steps:] = moved[steps:] == moved[:-steps]
    torque = rotor_kg_m2 * np.diff(estimate, axis=0, prepend=estimate[:1]) / np.median(np.diff(t_s))
    return Judged(
        rms_rad_s=_rms(error[moving]),
        lag_s=float(LAGS_S[int(np.argmin(delayed))]),
        still_rad_s=_rms(estimate[still]),
        invented_nm=_rms(torque[still]),
        worst_nm=float(np.abs(torque[still]).max(initial=0.0)),
    )


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2))) if x.size else 0.0


def _difference(t_ns: np.ndarray, q: np.ndarray) -> np.ndarray:
    dq = np.zeros_like(q)
    dq[1:] = np.diff(q, axis=0) / (1e-9 * np.diff(t_ns))[:, None]
    return dq


def _low_passed(t_ns: np.ndarray, x: np.ndarray) -> np.ndarray:
    keep = np.exp(-2 * np.pi * LOW_PASS_HZ * 1e-9 * np.diff(t_ns))
    y = x.copy()
    for k in range(1, len(y)):
        y[k] = keep[k - 1] * y[k - 1] + (1 - keep[k - 1]) * x[k]
    return y


def _slope(t_ns: np.ndarray, q: np.ndarray, steps: int) -> np.ndarray:
    """Of the line of least squares through the last steps + 1 samples; 0 before there are as many."""
    t_s, dq = 1e-9 * (t_ns - t_ns[0]), np.zeros_like(q)
    windows = np.lib.stride_tricks.sliding_window_view(t_s, steps + 1)
    centred = windows - windows.mean(axis=1, keepdims=True)
    positions = np.lib.stride_tricks.sliding_window_view(q, steps + 1, axis=0)  # (samples, joints, steps + 1)
    dq[steps:] = np.einsum("kji,ki->kj", positions, centred) / (centred**2).sum(axis=1)[:, None]
    return dq


def _kalman(t_ns: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Position, velocity, acceleration; the jerk is white from sample to sample, and so is the encoder's error."""
    noise, dq = COUNT_RAD**2 / 12, np.zeros_like(q)
    state, p = np.zeros((3, q.shape[1])), np.diag([noise, 1.0, 100.0])
    state[0] = q[0]
    for k in range(1, len(q)):
        h = 1e-9 * float(t_ns[k] - t_ns[k - 1])
        a = np.array([[1, h, h * h / 2], [0, 1, h], [0, 0, 1]])
        g = np.array([h**3 / 6, h**2 / 2, h])
        p = a @ p @ a.T + JERK_RAD_S3**2 * np.outer(g, g)
        state = a @ state
        gain = p[:, 0] / (p[0, 0] + noise)
        state = state + np.outer(gain, q[k] - state[0])
        p = p - np.outer(gain, p[0])
        dq[k] = state[1]
    return dq


def _adaptive(t_ns: np.ndarray, q: np.ndarray, rate_hz: float, window_s: float) -> np.ndarray:
    joint = _core.ServoConstants(count_rad=COUNT_RAD)
    settings = _core.ServoSettings(
        _core.TorqueFrom.duty, [joint] * q.shape[1], round(window_s * rate_hz), round(1e9 / rate_hz)
    )
    dq, _ = _core.ServoInput(settings).recording(np.ascontiguousarray(t_ns), np.ascontiguousarray(q))
    return np.asarray(dq)


# --- Tables.


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
        cells += [f"{np.sqrt(square.mean()):.3f}", joined(np.sqrt(square.mean(axis=0)), ".3f")]
    return table_row(name, *cells)


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
    return " | ".join([*cells, f"{verdicts.false_free} | {verdicts.false_after} | {verdicts.free_hours:.2f}", delay])


def _share(counts: tuple[int, int]) -> str:
    found, of = counts
    return f"{found}/{of} ({found / of:.0%})" if of else "0/0"


STRENGTHS = " | ".join([f"{a:g} to {b:g} Nm" for a, b in zip(EDGES_NM[:-2], EDGES_NM[1:-1], strict=True)])
CONTACT_COLUMNS = (
    "{first} | found at 1.5 times the limit | of all | "
    f"{STRENGTHS} | over {EDGES_NM[-2]:g} Nm | false | after a contact | in h | delay, ms: median, 95 %"
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
