"""What a monitor weighs in its loop beside what `tauext load` says of the same seconds: on the arms of loads.py.

    python benchmarks/weigh_in_loop.py MODELS OUT [--arms ur5 panda ...] [--seed 0]

OUT is what `python benchmarks/loads.py MODELS OUT` left. Each monitor meets its load with the sample that the window of
4 s begins with, less what its columns take to warm up. A row an arm: how far the two masses are apart, in standard
errors, and how many masses of each are within 5 % or 0.1 kg of the truth.
"""

from __future__ import annotations

import numpy as np
from common import arguments
from unseen.arms import makers
from unseen.loads import FIRST_S, WINDOW_S, carried

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording
from tauext.monitor.weighing import LoadEstimate, identify, load_frame, see


def main() -> None:
    parser = arguments(__doc__, "models", "out")
    parser.add_argument("--arms", nargs="+", default=["ur5", "panda", "kinova", "seven_axis"])
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print("arm | loads | same verdict | apart, standard errors: median, most | right: loop, command")
    for name in options.arms:
        truth = {
            take: one for take, one in carried(makers(options.models)[name], options.seed).items() if "load" in take
        }
        folder = options.out / name
        bundle = load_bundle(folder / "true.tauext")
        pairs = [
            (one.mass_kg, *both(bundle, load_recording(folder / "data-true" / f"{take}.parquet")))
            for take, one in truth.items()
        ]
        same = sum(loop.verdict == command.verdict for _, loop, command in pairs)
        apart = [abs(loop.mass_kg - command.mass_kg) / command.mass_error_kg for _, loop, command in pairs]
        right = [sum(is_right(pair[k].mass_kg, pair[0]) for pair in pairs) for k in (1, 2)]
        print(f"{name} | {len(pairs)} | {same} | {np.median(apart):.2f}, {max(apart):.2f} | {right[0]}, {right[1]}")


def both(bundle: _core.Bundle, recording: Recording) -> tuple[LoadEstimate, LoadEstimate]:
    """By a monitor, and by the command, of the first window."""
    warm_s, t_s = 10 / bundle.observer.gain_per_s, recording.time_s
    first, end = np.searchsorted(t_s, [max(FIRST_S - warm_s, 0.0), FIRST_S + WINDOW_S])
    monitor = _core.Monitor(bundle, own_rate=True)
    for rows in (slice(0, first), slice(first, end)):
        if rows.start == first:
            monitor.start_weighing()
        monitor.run(recording.t_ns[rows], recording.q[rows], recording.dq[rows], recording.tau[rows])
    seen = see(bundle, recording)
    part = seen.part((seen.time_s >= FIRST_S) & (seen.time_s < FIRST_S + WINDOW_S))
    return monitor.estimate_load(), identify(bundle, load_frame(bundle), [part])


def is_right(mass_kg: float, truth_kg: float) -> bool:
    """Within 5 % or 0.1 kg."""
    return abs(mass_kg - truth_kg) <= max(0.05 * truth_kg, 0.1)


if __name__ == "__main__":
    main()
