"""The test of the rig: networks trained on the rig alone, on a recording of the paper's own arm.

    python benchmarks/rig_transfer.py DATA BUNDLE.tauext ...

DATA is the folder of collisions.csv (benchmarks/mocca_recording.py); the bundles are of recipe paper, trained on
`tauext simulate`. Nothing is trained on the recording. It has 100 Hz, so the observer of a bundle is set to that rate;
the network's steps of 10 ms stay as they are.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from common import arguments, head, joined, runs, table_row
from mocca_recording import RATE_HZ, Segment, nominal_tree, read_segments, recording

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.bundle.estimates import OK

AFTER_S = 0.5
"""A collision is found from its onset, 0.1 s early since that was read off by eye, to so long after it."""
APART_S = 0.5


def at_recorded_rate(path: Path, segments: list[Segment], tree: _core.Tree) -> _core.Bundle:
    """The bundle with the observer of the recording's rate and torque timing."""
    bundle = load_bundle(path)
    bundle.observer = _core.ObserverSettings(
        gain_per_s=bundle.observer.gain_per_s,
        timing=_core.TorqueTiming.averaged,
        sample_period_ns=round(1e9 / RATE_HZ),
        network_stride=1,
    )
    first = recording(segments[0], tree)
    samples = bundle.window_steps + 2
    bundle.set_reference(*(np.ascontiguousarray(a[:samples]) for a in (first.t_ns, first.q, first.dq, first.tau)))
    return bundle


def judged(bundle: _core.Bundle, segments: list[Segment], tree: _core.Tree) -> list[str]:
    """Cells: seconds, L1, L2, largest error; collisions found and false alarms at the bundle's limits; collisions whose
    estimate is larger than any error outside them."""
    free, peaks, found, false = [], [], 0, 0
    for segment in segments:
        one = recording(segment, tree)
        estimates = _core.estimate(bundle, one.t_ns, one.q, one.dq, one.tau, 1, None)
        healthy = estimates["health"] == OK
        size = np.abs(estimates["tau_ext"])
        over = healthy & (size > estimates["limit_nm"]).any(axis=1)
        away = healthy & ~segment.near_contact
        free.append(size[away])
        edges = runs(over & away)
        false += sum(k == 0 or begin - edges[k - 1][1] > APART_S * RATE_HZ for k, (begin, _) in enumerate(edges))
        for onset_s in segment.onsets_s:
            window = healthy & (np.abs(segment.time_s - onset_s - AFTER_S / 2 + 0.05) <= AFTER_S / 2 + 0.05)
            found += bool(over[window].any())
            peaks.append(size[window].max(axis=0))
    errors = np.concatenate(free)
    largest = errors.max(axis=0)
    return [
        f"{len(errors) / RATE_HZ:.0f}",
        joined(errors.mean(axis=0), ".2f", "/"),
        joined(np.sqrt((errors**2).mean(axis=0)), ".2f", "/"),
        joined(largest, ".1f", "/"),
        joined(bundle.sliding_limit_nm, ".1f", "/"),
        f"{found} of {len(peaks)}",
        str(false),
        f"{sum((peak > largest).any() for peak in peaks)} of {len(peaks)}",
    ]


def main() -> None:
    parser = arguments(__doc__, "data")
    parser.add_argument("bundles", nargs="+", type=Path)
    options = parser.parse_args()
    segments = read_segments(options.data)
    columns = "network | free motion, s | L1, N m | L2, N m | largest, N m | limits sliding, N m | found | false alarms"
    print("\n".join(head(columns + " | above every error")))
    with tempfile.TemporaryDirectory() as folder:
        tree = nominal_tree(Path(folder) / "robot.xml")
        for path in options.bundles:
            bundle = at_recorded_rate(path, segments, tree)
            print(table_row(f"{path.parent.name}/{path.stem}", *judged(bundle, segments, tree)))


if __name__ == "__main__":
    main()
