"""Datasets in which joints rest, and what becomes of each: a bundle that does not monitor them, or one sentence.

A cell is one of the product of the lists below: which joints rest, in which recordings and with how much noise, unit of
the torque, rate, recipe and case. `python tests/resting_joints.py FIRST COUNT STEP` prints a table.
"""

from __future__ import annotations

import itertools
import math
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from made_arms import six_axis, urdf
from made_recordings import Drive, made_motion
from small_datasets import AMPERES, MAIN, NM_PER_A, SMALL_NETWORK, SMALL_PRIOR, Ending, crossed, ended, unhealthy

from tauext.bundle.bundle_file import load_bundle
from tauext.check.finding import codes
from tauext.config import TrainConfig
from tauext.data.dataset import Split, load_dataset, save_split
from tauext.data.recording import Recording
from tauext.data.recording_file import save_recording
from tauext.data.servo import FROM_AMPERES
from tauext.recipes import RECIPES
from tauext.robot.read import load_tree
from tauext.train.stage import train_bundle

JOINTS = 4
RESTING = [joints for size in range(JOINTS + 1) for joints in itertools.combinations(range(JOINTS), size)]
"""Every subset of the joints."""
WHERE = ("always", "but in one recording")
NOISE = ("none", "little", "torque alone", "coarse")
"""On the signals of a joint that rests."""
TORQUES = ("N m", AMPERES, FROM_AMPERES)
RATES_HZ = (25.0, 50.0, 125.0, 250.0, 500.0, 1000.0)
CASES = ("exact", "none", "mass+com")
SECONDS = 36.0
PIECES = 3
PRODUCT = [RESTING, WHERE, NOISE, TORQUES, RATES_HZ, tuple(RECIPES), CASES]
COUNT = math.prod(map(len, PRODUCT))


@dataclass(frozen=True)
class Cell:
    """One cell of the product, by its number."""

    number: int

    @property
    def choices(self) -> tuple:
        found, left = [], self.number
        for choices in reversed(PRODUCT):
            left, k = divmod(left, len(choices))
            found.append(choices[k])
        return tuple(reversed(found))

    @property
    def words(self) -> str:
        resting, where, noise, torque, rate_hz, recipe, case = self.choices
        joints = ", ".join(map(str, resting)) or "none"
        return f"rest {joints} {where}, noise {noise}, {torque}, {rate_hz:g} Hz, {recipe}, {case}"

    def write(self, folder: Path) -> Path:
        """The dataset's folder."""
        resting, where, noise, torque, rate_hz, _, _ = self.choices
        like = six_axis()
        parts = [
            replace(
                like[k],
                joint=f"joint{k + 1}",
                parent=f"joint{k}" if k else None,
                axis=np.array(axis),
                rpy=np.zeros(3),
                mass=8.0 * 0.7**k,
                inertia=like[k].inertia * 0.7**k / 4,
            )
            for k, axis in enumerate(crossed(JOINTS))
        ]
        (folder / "robot.urdf").write_text(urdf(parts).replace('effort="100"', 'effort="2000"'))
        tree = load_tree(folder / "robot.urdf", [part.joint for part in parts])
        drive = Drive(nm_per_a=NM_PER_A if torque == AMPERES else None)
        reach, rng, names = np.full(JOINTS, 1.2), np.random.default_rng(self.number), []
        moved = made_motion(tree, SECONDS / 60, rate_hz, self.number, PIECES, reach, drive=drive).recordings
        reach[list(resting)] = 0.0
        rests = made_motion(tree, SECONDS / 60, rate_hz, self.number, PIECES, reach, drive=drive).recordings
        for k, one in enumerate(rests):
            one = moved[k] if where != "always" and k == 1 else at_rest(one, list(resting), noise, rng)
            one = replace(one, provenance=one.provenance | {"torque": torque})
            save_recording(one, folder / f"{one.name}.parquet")
            names.append(f"{one.name}.parquet")
        apart = self.number % 3
        train, rest = names[: PIECES - apart], names[PIECES - apart :]
        save_split(Split(tuple(train), tuple(rest[:1]), (), calibration=tuple(rest[1:])), folder)
        return folder

    @property
    def config(self) -> TrainConfig:
        recipe = self.choices[5]
        network = SMALL_NETWORK if RECIPES[recipe].network is not None else {}
        prior = {"prior": SMALL_PRIOR} if recipe not in MAIN or self.number % 2 else {}
        return TrainConfig(recipe=recipe, threads=1, **network, **prior)

    def ending(self) -> Ending:
        """Train with what the checks mind accepted; a fault is a traceback, or a bundle that monitors what rests."""
        with tempfile.TemporaryDirectory() as name:
            data, out = self.write(Path(name)), Path(name) / "b.tauext"
            return ended(self.number, self.words, "train", lambda: self.trained(data, out))

    def trained(self, data: Path, out: Path) -> str:
        dataset = load_dataset(data)
        train_bundle(dataset, out, self.choices[-1], None, self.config, accept=tuple(codes()))
        training, watched = dataset.training(), load_bundle(out).monitored
        used = [*training, *dataset.recordings("validation")]
        never = [j for j in self.choices[0] if all(np.ptp(one.q[:, j]) < 0.02 for one in used)]
        if any(watched[j] for j in never) and len(never) < JOINTS:
            return f"monitors {never}, which never move: {watched}"
        return unhealthy(out, training)


def at_rest(one: Recording, joints: list[int], noise: str, rng: np.random.Generator) -> Recording:
    """The recording, with this noise on the signals of the joints that rest."""
    q, dq, tau = one.q.copy(), one.dq.copy(), one.tau.copy()
    shape = q[:, joints].shape
    q[:, joints], dq[:, joints] = q[0, joints], 0.0
    if noise == "little":
        q[:, joints] += 2e-5 * rng.standard_normal(shape)
        dq[:, joints] += 4e-4 * rng.standard_normal(shape)
    elif noise == "none":
        tau[:, joints] = tau[0, joints]
    elif noise == "coarse":
        tau[:, joints] = np.round(tau[:, joints])
    return replace(one, q=q, dq=dq, tau=tau)


def main() -> None:
    first, count, step = map(int, sys.argv[1:4])
    ends: Counter[str] = Counter()
    for number in itertools.islice(cells(first, step), count):
        one = Cell(number).ending()
        kind = "fault" if one.fault else "sentence" if one.message else "bundle"
        ends[kind] += 1
        print(f"{number} {kind}: {one.words}: {one.fault or one.message}", flush=True)
    print(dict(ends))


def cells(first: int, step: int) -> Iterator[int]:
    """Numbers of cells, a step apart."""
    return (k % COUNT for k in range(first, first + step * COUNT, step))


if __name__ == "__main__":
    main()
