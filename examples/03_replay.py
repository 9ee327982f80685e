"""A recording through the monitor, one sample after the other, as a control loop would send it.

    python examples/03_replay.py ARM.tauext RECORDING.parquet

Prints a line whenever health or alarm changes. A collision is acknowledged a second after it was raised, so that the
next one is seen too; on an arm a person does that. `tauext run` does all this and more, faster, and writes files.
"""

from __future__ import annotations

import math
import sys

import tauext

ACKNOWLEDGE_AFTER_NS = 1_000_000_000


def describe(t_ns: int, joints: list[str], units: list[str], e: tauext.Estimate) -> str:
    """One line: when, health and why, alarm and where."""
    line = f"{t_ns * 1e-9:.3f} s: health {e.health.name}, alarm {e.alarm.name}"
    if e.alarm_joint >= 0:
        j, sigma = e.alarm_joint, e.sigma_nm[e.alarm_joint]
        known = f" ± {sigma:.1f}" if math.isfinite(sigma) else ""  # a bundle may have no error scale
        line += f" on {joints[j]} (tau_ext {e.tau_ext[j]:.1f}{known} {units[j]})"
    return ", ".join([line, *e.causes])


def replay(bundle_path: str, recording_path: str) -> None:
    bundle, recording = tauext.load_bundle(bundle_path), tauext.load_recording(recording_path)
    tauext.expect_fit(bundle, recording)  # joints, rate, what a torque sample means
    monitor = tauext.Monitor(bundle)
    before, clear = None, 0
    for t_ns, q, dq, tau in zip(recording.t_ns.tolist(), recording.q, recording.dq, recording.tau, strict=True):
        e = monitor.step(t_ns, q, dq, tau)
        clear += e.clear  # healthy and no alarm: the only thing that means "no collision"
        if (e.health, e.alarm) != before:
            print(describe(t_ns, monitor.joint_names, monitor.estimate_units, e))
        if e.alarm == tauext.Alarm.collision and t_ns - e.alarm_t_ns >= ACKNOWLEDGE_AFTER_NS:
            monitor.acknowledge()
        before = e.health, e.alarm
    print(f"{recording.samples} samples, {clear} of them clear")


def main() -> int:
    if len(sys.argv) != 3:
        print("usage: 03_replay.py ARM.tauext RECORDING.parquet", file=sys.stderr)
        return 2
    try:
        replay(*sys.argv[1:])
    except tauext.TauextError as error:  # a file that is missing, damaged or does not fit the other
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
