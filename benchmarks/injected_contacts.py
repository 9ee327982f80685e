"""Whether forces added to free motion are detected as often as the same forces on the arm: docs/results/injected.

    python benchmarks/injected_contacts.py OUT DATASET BUNDLE [--copies 6] [--seed 0]

DATASET: recordings of contacts with the true external torque (tau_ext) or a sensor's, and free test motion, as `tauext
simulate` makes them. BUNDLE: trained on its free motion. Each contact's torque is added to free motion COPIES times, as
`tauext evaluate --inject` adds its forces. OUT/README.md gets detected shares of both over the peak, as a share of the
limit.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from common import arguments, head, table_row, write_page

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.data.dataset import load_dataset
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording
from tauext.evaluate.collisions import find_collisions, judge_latched
from tauext.evaluate.injected import InjectedForce, Injection, estimate_recording

EDGES = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 5.0, 1e9)
"""Peaks over the sliding limit."""
AFTER_S = 0.05
"""Of a contact's torque behind its end, which a sensor shows late."""


def main() -> None:
    parser = arguments(__doc__, "out", "dataset", "bundle")
    parser.add_argument("--copies", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    bundle, dataset = load_bundle(options.bundle), load_dataset(options.dataset)
    limit_nm = np.array(bundle.sliding_limit_nm)
    torques: list[np.ndarray] = []
    real: list[tuple[float, bool, float | None]] = []
    for name in dataset.split.collisions:
        recording = load_recording(dataset.folder / name)
        estimates = estimate_recording(bundle, recording, 0)
        true = recording.tau_ext if recording.tau_ext is not None else recording.tau_ext_sensor
        if true is None:
            parser.error(f"{name}: the recording holds no external torque")
        for touch in find_collisions(recording):
            verdict = judge_latched(touch, recording, estimates, bundle.hold_s, None)
            torque = true[touch.begin : touch.end + round(AFTER_S * recording.rate_hz)]
            torques.append(torque)
            real.append((peak_over(torque, limit_nm), verdict.latched, verdict.delay_s))
    added = inject(bundle, dataset.folder, dataset.split.test, torques, options.copies, options.seed)
    write_page(options.out / "README.md", table(real, added))


def inject(
    bundle: _core.Bundle, folder: Path, names: list[str], torques: list[np.ndarray], copies: int, seed: int
) -> list[tuple[float, bool, float | None]]:
    """The same torques in free motion, each so many times, one every few seconds in an order drawn by seed."""
    limit_nm, rng = np.array(bundle.sliding_limit_nm), np.random.default_rng(seed)
    waiting = [torque for _ in range(copies) for torque in rng.permutation(np.array(torques, dtype=object))]
    found = []
    while waiting:
        left = len(waiting)
        for name in names:
            recording = load_recording(folder / name)
            events, at = [], round(2.0 * recording.rate_hz)
            while waiting and at + len(waiting[-1]) + recording.rate_hz < recording.samples:
                torque = waiting.pop()
                events.append(InjectedForce(at, "contact", 0, peak_over(torque, limit_nm), torque))
                at += len(torque) + round(rng.uniform(2.0, 3.0) * recording.rate_hz)
            found += detected(bundle, recording, events)
        if len(waiting) == left:
            raise SystemExit("the free test recordings are shorter than a contact")
    return found


def detected(
    bundle: _core.Bundle, recording: Recording, events: list[InjectedForce]
) -> list[tuple[float, bool, float | None]]:
    injection = Injection({"": bundle}, 0, 0)
    injection.add("", recording, [events], 0)
    return [(peak, latched, delay_s) for _, _, peak, latched, _, delay_s in injection.seen[""]]


def peak_over(torque: np.ndarray, limit_nm: np.ndarray) -> float:
    return float((np.abs(torque) / limit_nm).max())


def table(real: list[tuple[float, bool, float | None]], added: list[tuple[float, bool, float | None]]) -> list[str]:
    columns = "peak over the limit | contacts | detected | added | detected | difference, points | delay, ms | added"
    lines = head(columns)
    for low, high in [*zip(EDGES, EDGES[1:], strict=False), (0.0, 1e9)]:
        cells = ["all" if (low, high) == (0.0, 1e9) else f"over {low:g}" if high > 1e8 else f"{low:g} to {high:g}"]
        if not any(low <= row[0] < high for row in real):
            continue
        shares, delays = [], []
        for rows in (real, added):
            here = [row for row in rows if low <= row[0] < high]
            known = [row[2] for row in here if row[2] is not None]
            share = np.mean([row[1] for row in here]) if here else np.nan
            shares.append(100 * share)
            delays.append(f"{1e3 * np.median(known):.0f}" if known else "–")
            cells += [str(len(here)), f"{100 * share:.1f} %"]
        lines.append(table_row(*cells, f"{shares[1] - shares[0]:+.1f}", *delays))
    return lines


if __name__ == "__main__":
    main()
