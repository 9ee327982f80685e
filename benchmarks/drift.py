"""What the drift tracker takes off: of friction that falls, and of pushes that last.

    python benchmarks/drift.py BUNDLE DATASET [--recordings 20]

BUNDLE: of recipe prior or tauext, with limits, trained on DATASET, which the virtual rig made with its default settings
and calibration recordings; the last of these are used. docs/method/evidence.md holds the numbers that it prints.
"""

import argparse
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.data import Recording, load_recording, load_split
from tauext.rig import RigConfig
from tauext.rig.recording import simulate_recording

Signals = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
BREAK_NS = 1_000_000_000
OK, COLLISION = 1, 2
LENGTH_S = 90.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bundle", type=Path)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--recordings", type=int, default=20)
    options = parser.parse_args()
    bundle = _core.Bundle.load(str(options.bundle))
    names = load_split(options.dataset).calibration[-options.recordings :]
    free = end_to_end([load_recording(options.dataset / name) for name in names])
    print_errors("free motion", bundle, free)
    for push_nm in (1.0, 10.0):
        print_absorbed(bundle, free, push_nm)
    for share in (0.95, 0.9, 0.85):
        print_errors(f"friction at {share:.0%} from the start", bundle, with_friction([share] * 7))
    print_errors("friction falling to 85 % in 30 minutes", bundle, with_friction(np.linspace(1, 0.85, 20).tolist()))


def end_to_end(recordings: Sequence[Recording]) -> Signals:
    """t_ns, q, dq, tau of one after the other, with a gap between that restarts the observer."""
    times, start = [], 0
    for recording in recordings:
        times.append(recording.t_ns - recording.t_ns[0] + start)
        start = int(times[-1][-1]) + BREAK_NS
    signals = (np.concatenate([getattr(r, name) for r in recordings]) for name in ("q", "dq", "tau"))
    return (np.concatenate(times), *signals)


def with_friction(shares: Sequence[float]) -> Signals:
    """Free motion of the rig, a recording for each of these shares of its Coulomb, static and viscous friction."""

    def config(share: float) -> RigConfig:
        names = ("coulomb_nm", "static_nm", "viscous_nm_s_rad")
        return replace(
            RigConfig(),
            friction=tuple(
                replace(f, **{name: share * getattr(f, name) for name in names}) for f in RigConfig().friction
            ),
        )

    return end_to_end([simulate_recording(config(s), "free", LENGTH_S, 7, k) for k, s in enumerate(shares)])


def estimate(bundle: _core.Bundle, signals: Signals, tracking: bool) -> dict[str, np.ndarray]:
    bundle = _core.Bundle.from_bytes(bundle.to_bytes())
    if not tracking:
        bundle.drift.time_constant_s = 0
    return _core.estimate(bundle, *signals, os.cpu_count() or 1)


def print_errors(title: str, bundle: _core.Bundle, signals: Signals) -> None:
    """RMSE of tau_ext, which is 0, over all of it and over its last third."""
    for tracking in (False, True):
        said = estimate(bundle, signals, tracking)
        healthy = said["health"] == 1
        last = healthy & (np.arange(len(healthy)) >= 2 * len(healthy) // 3)
        rmse = [np.sqrt((said["tau_ext"][rows] ** 2).mean(axis=0)) for rows in (healthy, last)]
        words = "with tracker   " if tracking else "without tracker"
        alarms = false_collisions(said, signals[0])
        told = f", {alarms} false collisions in {healthy.sum() * bundle.observer.sample_period_ns / 3.6e12:.2f} h"
        if tracking:
            told += f", frozen {frozen_share(bundle, said, signals[0]):.1%} of it by torque"
        print(f"{title}, {words}: RMSE {rmse[0].round(3)} Nm, last third {rmse[1].round(3)} Nm{told}", flush=True)


def false_collisions(said: dict[str, np.ndarray], t_ns: np.ndarray) -> int:
    """Collisions that began, those less than 0.5 s apart counted as one."""
    at = np.flatnonzero(said["held_alarm"] == COLLISION)
    return 0 if len(at) == 0 else 1 + int((np.diff(t_ns[at]) >= 500_000_000).sum())


def frozen_share(bundle: _core.Bundle, said: dict[str, np.ndarray], t_ns: np.ndarray) -> float:
    """Share of healthy samples at which a touch, as DriftTracker defines one, was at most freeze_s ago."""
    drift, near = bundle.drift, said["near_stiction"].astype(bool)
    levels = ("sliding_limit_nm", "near_stiction_limit_nm")
    lower = [np.minimum(getattr(bundle, name), getattr(bundle, f"contact_{name}")) for name in levels]
    limit = np.where(near, lower[1], lower[0]) * said["limit_scale"]
    over = np.maximum(drift.freeze_share * limit, drift.freeze_floor_nm or 0.0) + said["doubt"]
    healthy = said["health"] == OK
    touched = np.flatnonzero(((np.abs(said["tau_ext"]) > over).any(axis=1)) & healthy)
    if len(touched) == 0:
        return 0.0
    last = touched[np.maximum(np.searchsorted(touched, np.arange(len(t_ns)), side="right") - 1, 0)]
    since_ns = t_ns - t_ns[last]
    frozen = (since_ns >= 0) & (since_ns <= drift.freeze_s * 1e9)
    return float((frozen & healthy).sum() / healthy.sum())


def print_absorbed(bundle: _core.Bundle, signals: Signals, push_nm: float) -> None:
    """Share of a push on joint 1, from the middle on, that is no longer in tau_ext: mean over five seconds of motion.

    A drive that holds its motion against a push gives that much less: tau_m falls by it, and r = -tau_m + ... rises.
    """
    t_ns, q, dq, tau = signals
    begin = len(t_ns) // 2
    pushed = tau.copy()
    pushed[begin:, 0] -= push_nm
    without, said = estimate(bundle, signals, True), estimate(bundle, (t_ns, q, dq, pushed), True)
    shares = []
    for after_s in (60, 300, 600):
        end = int(np.searchsorted(t_ns, t_ns[begin] + after_s * 10**9))
        rows = slice(max(begin, end - 5000), end)
        seen = (said["tau_ext"] - without["tau_ext"])[rows, 0]
        shares.append(1 - np.nanmean(seen) / push_nm)
    told = ", ".join(f"{share:.1%} after {s} s" for share, s in zip(shares, (60, 300, 600), strict=True))
    print(f"push of {push_nm:g} Nm on joint 1, absorbed: {told}", flush=True)


if __name__ == "__main__":
    main()
