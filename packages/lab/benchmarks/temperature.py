"""What the joints' temperatures are worth: an arm trained over its warm-up, met cold and warm, with and without them.

    python packages/lab/benchmarks/temperature.py MODELS OUT [--arms ur5 seven_axis] [--seed 0]

MODELS: as for unseen_arms.py, whose arms these are. OUT/ARM gets recordings, dataset and bundles; what is there is used
again. Training: twelve minutes from switch-on. Test: four minutes from switch-on, and four after half an hour.
The floor is what is left of the error where the two parts of each joint's friction have factors of their own in every
20 s.
"""

import os
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import arguments, collisions_begin, estimates, head, joined, rms, table_row, trained
from unseen.arms import makers
from unseen.recordings import Take, make_dataset

from tauext import _core
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording
from tauext.fit.temperature import COULOMB, of_kinds

TAKES = (
    *(Take(f"train-{k}", "train", 3, 0, 180.0 * k) for k in range(4)),
    Take("cold", "test", 4),
    Take("warm", "test", 4, 0, 1800),
)
OK = 1
PIECE_S = 20


def main() -> None:
    options = arguments(__doc__, "models", "out", arms=("ur5", "seven_axis"), seed=0).parse_args()
    columns = "temperature | tracker | RMSE of each joint, Nm | ratio | floor | false collisions"
    print("\n".join(head(f"arm, test | {columns}")))
    for name in options.arms:
        maker, folder = makers(options.models)[name], options.out / name
        data = make_dataset(maker, options.seed, folder, TAKES, os.cpu_count(), temperature=True)
        bundles = {word: folder / f"{word}.tauext" for word in ("without", "with")}
        for word, bundle in bundles.items():
            settings = folder / f"{word}.toml"
            settings.write_text(f"prior.follow_temperature = {'true' if word == 'with' else 'false'}\n")
            trained(data, bundle, "--config", settings, recipe="tauext")
        for test in ("cold", "warm"):
            for tracking in (False, True):
                compare(f"{name}, {test}", bundles, data / f"{test}.parquet", tracking)


def compare(title: str, bundles: dict[str, Path], recording: Path, tracking: bool) -> None:
    """Errors of tau_ext, which is 0, with and without temperatures."""
    made = load_recording(recording)
    without = floor = None
    for word, path in bundles.items():
        bundle = _core.Bundle.load(str(path))
        if not tracking:
            bundle.drift.time_constant_s = 0
        said = estimates(bundle, made, os.cpu_count() or 1)
        rmse = rms(said["tau_ext"][said["health"] == OK], axis=0)
        if without is None or floor is None:
            without, floor = rmse, floor_nm(bundle, made)
        alarms = len(collisions_begin(said["held_alarm"], made.t_ns))
        shares = [f"{np.sqrt(np.mean((one / without) ** 2)):.2f}" for one in (rmse, floor)]
        tracker = "on" if tracking else "off"
        print(table_row(title, word, tracker, joined(rmse, by=" "), *shares, alarms), flush=True)


def floor_nm(bundle: _core.Bundle, made: Recording) -> np.ndarray:
    """RMSE of each joint, (n,), that the two parts of its friction cannot explain in pieces of 20 s, no tracker."""

    def estimate(prior: _core.PriorSettings) -> dict[str, np.ndarray]:
        other = _core.Bundle.from_bytes(bundle.to_bytes())
        other.prior, other.drift = prior, _core.DriftSettings()
        return _core.estimate(other, made.t_ns, made.q, made.dq, made.tau, os.cpu_count() or 1)

    said = estimate(bundle.prior)
    parts = [estimate(of_kinds(bundle.prior, frozenset(kinds)))["prior"] for kinds in ((), COULOMB, ("viscous",))]
    piece = (made.t_ns - made.t_ns[0]) // (PIECE_S * 10**9)
    squares, rows = np.zeros(bundle.joints), 0
    for k in np.unique(piece):
        at = (piece == k) & (said["health"] == OK)
        for joint in range(bundle.joints):
            friction = np.stack([part[at, joint] - parts[0][at, joint] for part in parts[1:]], axis=1)
            left = said["tau_ext"][at, joint]
            squares[joint] += np.sum((left - friction @ np.linalg.lstsq(friction, left, rcond=None)[0]) ** 2)
        rows += int(at.sum())
    return np.sqrt(squares / rows)


if __name__ == "__main__":
    main()
