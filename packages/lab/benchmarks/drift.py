"""What the drift tracker takes off: of friction that falls or is off from the start, and of pushes that last.

    python packages/lab/benchmarks/drift.py BUNDLE DATASET [--recordings 20]

BUNDLE: of recipe prior or tauext, with limits, trained on DATASET, which the virtual rig made with its default settings
and calibration recordings; the last of these are used. What follows friction that is off at once is judged beside none.
"""

import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import arguments, collisions_begin, head, joined, rms, table_row
from tauext_lab.sim.collect import simulate_recording
from tauext_lab.sim.config import RigConfig

from tauext import _core
from tauext.config import DriftConfig
from tauext.data.dataset import load_split
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording

Signals = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
BREAK_NS = 1_000_000_000
OK = 1
LENGTH_S = 90.0
WITHOUT, SLOW, BOTH = "without", "slow", "both"
"""No tracker; the slow one; with the one that follows friction that is off at once."""
MINUTES = (1, 5, 10)


def main() -> None:
    parser = arguments(__doc__, "bundle", "dataset")
    parser.add_argument("--recordings", type=int, default=20)
    options = parser.parse_args()
    bundle = _core.Bundle.load(str(options.bundle))
    names = load_split(options.dataset).calibration[-options.recordings :]
    free = end_to_end([load_recording(options.dataset / name) for name in names])
    titles = (WITHOUT, SLOW, BOTH, "false collisions", "last one after")
    print("\n".join(head(" | ".join(["friction of both joints", *titles]))))
    print_errors("as trained", bundle, free)
    print_errors("falls to 85 % in 30 minutes", bundle, with_friction(np.linspace(1, 0.85, 20).tolist()))
    for share in (0.95, 0.9, 0.85, 0.7, 1.05, 1.15, 1.3):
        print_errors(f"{share:.0%} from the start", bundle, with_friction([share] * 7))
    print_errors("Coulomb's and static 130 %", bundle, with_friction([1.3] * 7, viscous=False))
    pushes = {f"constant {n:g} Nm on joint 1": np.array([n, 0.0]) * np.ones_like(free[1]) for n in (1.0, 10.0)}
    pushes |= {f"{n:g} N against the tool's velocity": against_velocity(free, n) for n in (2.0, 5.0, 10.0, 20.0)}
    print("\n".join(head(" | ".join(["push", "joint", *(f"{SLOW}, {m} min" for m in MINUTES)]))))
    for title, push in pushes.items():
        print_absorbed(title, bundle, free, push)


def end_to_end(recordings: Sequence[Recording]) -> Signals:
    """t_ns, q, dq, tau of one after the other, with a gap between that restarts the observer."""
    times, start = [], 0
    for recording in recordings:
        times.append(recording.t_ns - recording.t_ns[0] + start)
        start = int(times[-1][-1]) + BREAK_NS
    signals = (np.concatenate([getattr(r, name) for r in recordings]) for name in ("q", "dq", "tau"))
    return (np.concatenate(times), *signals)


def with_friction(shares: Sequence[float], viscous: bool = True) -> Signals:
    """Free motion of the rig, a recording for each of these shares of its Coulomb, static and viscous friction."""

    def config(share: float) -> RigConfig:
        names = ("coulomb_nm", "static_nm", "viscous_nm_s_rad")[: 3 if viscous else 2]
        joints = [replace(f, **{name: share * getattr(f, name) for name in names}) for f in RigConfig().friction]
        return replace(RigConfig(), friction=tuple(joints))

    return end_to_end([simulate_recording(config(s), "free", LENGTH_S, 7, k) for k, s in enumerate(shares)])


def against_velocity(signals: Signals, force_n: float) -> np.ndarray:
    """Joint torques of a constant force against the velocity of the tip, as of a cable or of wiping."""
    _, q, dq, _ = signals
    upper, lower = (link.length_m for link in RigConfig().links)
    first, second = q[:, 0], q[:, 0] + q[:, 1]
    jacobian = np.array(
        [
            [upper * np.cos(first) + lower * np.cos(second), lower * np.cos(second)],
            [-upper * np.sin(first) - lower * np.sin(second), -lower * np.sin(second)],
        ]
    )
    velocity = np.einsum("xjn,nj->nx", jacobian, dq)
    speed = np.maximum(np.linalg.norm(velocity, axis=1, keepdims=True), 0.02)
    return np.einsum("xjn,nx->nj", jacobian, -force_n * velocity / speed)


def estimate(bundle: _core.Bundle, signals: Signals, tracker: str) -> dict[str, np.ndarray]:
    bundle = _core.Bundle.from_bytes(bundle.to_bytes())
    if tracker == WITHOUT:
        bundle.drift.time_constant_s = 0
    bundle.drift.friction_share = DriftConfig().friction_share if tracker == BOTH else 0.0
    return _core.estimate(bundle, *signals, os.cpu_count() or 1)


def print_errors(title: str, bundle: _core.Bundle, signals: Signals) -> None:
    """RMSE of tau_ext, which is 0: all of it -> the last third; false collisions; when the last of them began."""
    errors, alarms = [], []
    for tracker in (WITHOUT, SLOW, BOTH):
        said = estimate(bundle, signals, tracker)
        healthy = said["health"] == OK
        last = healthy & (np.arange(len(healthy)) >= 2 * len(healthy) // 3)
        rmse = [joined(rms(said["tau_ext"][rows], axis=0), by="/") for rows in (healthy, last)]
        errors.append(" → ".join(rmse))
        begun = collisions_begin(said["held_alarm"], signals[0])
        alarms.append(str(len(begun)))
        end = f"{(begun[-1] - signals[0][0]) / 1e9:.0f} s" if len(begun) else "–"
    hours = (signals[0][-1] - signals[0][0]) / 3.6e12
    print(table_row(title, *errors, f"{', '.join(alarms)} in {hours:.2f} h", end), flush=True)


def print_absorbed(title: str, bundle: _core.Bundle, signals: Signals, push_nm: np.ndarray) -> None:
    """Share of a push, from the third minute on, that drift has learned: of its squares, over a minute of motion.

    A drive that holds its motion against a push gives that much less: tau_m falls by it, and r = -tau_m + ... rises.
    """
    t_ns, q, dq, tau = signals
    begin = int(np.searchsorted(t_ns, t_ns[0] + 180 * 10**9))
    push_nm = np.where(np.arange(len(t_ns))[:, None] >= begin, push_nm, 0.0)
    shares: list[list[str]] = [[], []]
    free, said = (estimate(bundle, (t_ns, q, dq, one), SLOW) for one in (tau, tau - push_nm))
    for minutes in MINUTES:
        end_ns = t_ns[begin] + minutes * 60 * 10**9
        rows = (t_ns > end_ns - 60 * 10**9) & (t_ns <= end_ns) & (said["health"] == OK) & (free["health"] == OK)
        learned = (said["drift"] - free["drift"])[rows]
        for joint in range(2):
            size = float(push_nm[rows, joint] @ push_nm[rows, joint])
            shares[joint].append(f"{float(learned[:, joint] @ push_nm[rows, joint]) / size:.0%}" if size else "–")
    for joint, row in enumerate(shares):
        print(table_row(title, joint + 1, *row), flush=True)


if __name__ == "__main__":
    main()
