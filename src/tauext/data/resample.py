"""Recordings of several rates brought to the slowest one, with what that costs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tauext.data.recording import FLAGS, SIGNALS, Recording
from tauext.data.recording_file import describe, load_recording, save_recording


def resampled(recording: Recording, rate_hz: float) -> tuple[Recording, np.ndarray]:
    """The recording at a lower rate, linear between its samples, and the torque that this loses.

    Nothing is filtered: a reader at this rate gets samples of the same noise.

    Returns:
        The recording, and the root mean square (joints,) of the torque that is not linear between the new samples,
        [N m or A].
    """
    period_ns = round(1e9 / rate_hz)
    count = int((recording.t_ns[-1] - recording.t_ns[0]) // period_ns) + 1
    t_ns = recording.t_ns[0] + period_ns * np.arange(count)
    after = np.clip(np.searchsorted(recording.t_ns, t_ns), 1, recording.samples - 1)
    apart = recording.t_ns[after] - recording.t_ns[after - 1]
    kept = (apart < 2.5e9 / recording.rate_hz) | (t_ns == recording.t_ns[after]) | (t_ns == recording.t_ns[after - 1])
    t_ns = t_ns[kept]  # nothing is made up within a gap
    signals: dict[str, Any] = {}
    for name in SIGNALS:
        if (values := getattr(recording, name)) is not None:
            signals[name] = np.stack([np.interp(t_ns, recording.t_ns, column) for column in values.T], axis=1)
    before = np.searchsorted(recording.t_ns, t_ns, side="right") - 1
    signals |= {name: values[before] for name in FLAGS if (values := getattr(recording, name)) is not None}
    back = [np.interp(recording.t_ns, t_ns, column) for column in signals["tau"].T]
    lost = np.sqrt(((np.stack(back, axis=1) - recording.tau) ** 2).mean(axis=0))
    words = f"resampled from {recording.rate_hz:g} to {rate_hz:g} Hz, linear in between"
    done = [*recording.provenance.get("done", []), words]
    facts = recording.provenance | {"done": done, "resampled_from_hz": recording.rate_hz}
    return replace(recording, t_ns=t_ns, rate_hz=rate_hz, provenance=facts, **signals), lost


def to_one_rate(paths: Iterable[Path], unit: str) -> str:
    """Resample the recordings in these files to the lowest of their rates; returns what it costs, or an empty text.

    Args:
        unit: of the torque.
    """
    rates = {path: describe(path).rate_hz for path in paths}
    slowest = min(rates.values(), default=0.0)
    faster = [path for path, rate_hz in rates.items() if rate_hz > slowest]
    if not faster:
        return ""
    lost = []
    for path in faster:
        recording, of_joints = resampled(load_recording(path), slowest)
        save_recording(recording, path)
        lost.append(of_joints)
    joint = int(np.argmax(np.max(lost, axis=0)))
    listed = ", ".join(f"{rate_hz:g}" for rate_hz in sorted({rates[path] for path in faster}, reverse=True))
    return (
        f"recordings at {listed} Hz ({len(faster)} of {len(rates)}) are resampled to {slowest:g} Hz, the rate of the "
        f"others, linear in between. What lies above {slowest / 2:g} Hz is lost: of the torque {np.max(lost):.2g} "
        f"{unit} rms at '{recording.joints[joint]}', and less at other joints. To keep it, import each rate alone"
    )
