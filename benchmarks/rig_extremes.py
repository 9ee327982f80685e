"""The virtual rig beside the real one: extremes in free motion, sizes of its collisions, and what it costs to simulate.

    python benchmarks/rig_extremes.py [--minutes 90] [--collision-recordings 20] [--seed 0] [--data DATA]

docs/paper.md holds the table that it prints.
"""

import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from common import arguments, head, table_row

from tauext import _core
from tauext.config import PAPER_CASES, ObserverConfig
from tauext.data.dataset import load_split
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording
from tauext.evaluate.collisions import Collision, find_collisions
from tauext.fit.bundle_writing import build_setup
from tauext.report.paper import OBSERVER_PEAK_NM
from tauext.robot.model_case import estimated_model
from tauext.sim.collect import simulate_dataset
from tauext.sim.config import RigConfig

REAL = {"motor torque": (91, 33), **OBSERVER_PEAK_NM}
"""Largest positive values in free motion, joints 1 and 2, [N m]: normalisation constants in data/DataCreate.m of
[Mocca2020] (docs/references.md), code for the paper's arm: the first of three gains."""
REAL_GAIN_PER_S = 5.0
"""Gain K0 of these values: that of the recording's first gain (benchmarks/mocca_recording.py)."""
WITHIN = 0.2


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--minutes", type=float, default=90.0)
    parser.add_argument("--collision-recordings", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--data", type=Path, help="a dataset of `tauext simulate`; default: simulate one")
    options = parser.parse_args()
    if options.data is not None:
        print_extremes(options.data)
        return
    with tempfile.TemporaryDirectory() as folder:
        data, config = Path(folder) / "data", RigConfig()
        started = time.monotonic()
        simulate_dataset(data, config, options.seed, options.minutes, 0)
        print_cost(data, options.minutes, time.monotonic() - started)
        print_extremes(data)
        touched = Path(folder) / "collisions"
        simulate_dataset(touched, config, options.seed, 1.0, options.collision_recordings)
        print_collisions(touched)


def free_recordings(data: Path) -> Iterator[Recording]:
    split = load_split(data)
    return (load_recording(data / name) for name in sorted(split.train + split.validation + split.test))


def print_cost(data: Path, minutes: float, seconds: float) -> None:
    """Wall time of simulating and writing the free motion, its rate and its size."""
    size = sum(path.stat().st_size for path in data.glob("*.parquet")) / 1e6
    print(f"{minutes:g} minutes at 1 kHz in {seconds:.1f} s on {os.cpu_count()} cores ({size:.0f} MB of Parquet)\n")


def print_extremes(data: Path) -> None:
    """Largest |motor torque| and |residual| of each estimated model, beside the real rig's; share near stiction."""
    extremes = {name: np.zeros(2) for name in REAL}
    near, samples, off_path = np.zeros(2), 0, np.zeros(2)
    for recording in free_recordings(data):
        extremes["motor torque"] = np.maximum(extremes["motor torque"], np.abs(recording.tau).max(axis=0))
        for name, case in PAPER_CASES.items():
            tree = estimated_model(data / "robot.xml", recording.joints, case)
            settings = build_setup(tree, recording, ObserverConfig(gain_per_s=REAL_GAIN_PER_S)).observer
            seen = _core.observe(tree, settings, recording.t_ns, recording.q, recording.dq, recording.tau)
            warm = seen.residual[seen.warm.astype(bool)]
            extremes[name] = np.maximum(extremes[name], np.abs(warm).max(axis=0))
        near += (np.abs(recording.dq) < ObserverConfig().near_stiction_rad_s).sum(axis=0)
        samples += recording.samples
        off_path = np.maximum(off_path, np.abs(recording.q - recording.q_des).max(axis=0))
    print("\n".join(head("extreme in free motion, Nm | real 1/2 | virtual 1/2 | ratio 1/2 | within 20 %")))
    for name, real in REAL.items():
        ratio = extremes[name] / real
        verdict = "yes" if (np.abs(ratio - 1.0) <= WITHIN).all() else "NO"
        print(table_row(name, pair(real, 0), pair(extremes[name], 1), pair(ratio, 2), verdict))
    print(f"\nnear stiction: {pair(100.0 * near / samples, 1)} % of the time")
    print(f"off the commanded path by at most {pair(off_path, 4)} rad\n")


def print_collisions(data: Path) -> None:
    """How many collisions of each kind, and the spread of their sensor peaks and lengths."""
    touches: dict[str, list[Collision]] = {"pulses": [], "pads": []}
    for name in load_split(data).collisions:
        for touch in find_collisions(load_recording(data / name)):
            touches[touch.kind].append(touch)
    columns = "collisions | number | on link 1/2 | sensor peak, Nm: least, quartiles, largest | length, s"
    print("\n".join(head(columns)))
    for kind, found in touches.items():
        if found:
            peaks = np.percentile([touch.sensor_peak_nm.max() for touch in found], [0, 25, 50, 75, 100])
            lengths = [touch.end_s - touch.start_s for touch in found]
            links = np.bincount([touch.link for touch in found], minlength=2)
            spread = " · ".join(f"{peak:.1f}" for peak in peaks)
            print(table_row(kind, len(found), pair(links, 0), spread, f"{min(lengths):.2f}–{max(lengths):.2f}"))


def pair(values: np.ndarray | tuple[float, ...], digits: int) -> str:
    """The joints' values with a slash between."""
    return "/".join(f"{value:.{digits}f}" for value in values)


if __name__ == "__main__":
    main()
