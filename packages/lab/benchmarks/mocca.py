"""The recording of the paper's own arm: the authors' network as a bundle, recipes trained on it, figures 5 and 7.

    python packages/lab/benchmarks/mocca.py DATA OUT [--keep]

DATA is the folder of collisions.csv and no_model_network/ (tauext_lab/bench/mocca_recording.py). OUT gets bundles, a
dataset of the segments and tables.md; --keep writes the figures of docs/results/mocca. A recipe is trained without one
segment and tested on it, for each segment in turn. Nothing of DATA is written into the repository but figures and
numbers.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib import pyplot as plt

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import ROOT, arguments, error_cells, estimates, head, joined, runs, share_interval, table_row, write_tables
from tauext_lab.bench.mocca_recording import MARGINS, ONSETS_S, RATE_HZ, Segment, nominal_tree, read_segments, recording
from tauext_lab.own_network import load_network
from tauext_lab.report.style import CONTACT, DPI, OBSERVER, OBSERVER_WIDTH, RC, WIDTH_IN

from tauext import _core
from tauext.bundle.estimates import COLLISION, OK
from tauext.config import PAPER_CASES, PAPER_GAIN_PER_S, CaseName, ObserverConfig, TrainConfig
from tauext.data.dataset import Dataset, Split, load_dataset, save_split
from tauext.data.recording_file import save_recording
from tauext.fit.tail import rate_interval
from tauext.train.stage import train_bundle

matplotlib.use("agg")
PAGE = ROOT / "docs/results/mocca"
UNITS, WINDOW = 20, 100
AUTHORS_GAIN_PER_S = 5.0
INPUT_SCALE = (3.1637, 3.1348, 1.6633, 1.7640, 1.6633, 1.7640)
"""Divisors of q (wrapped to +-pi), dq and dq(k-1), found by fitting; stated nowhere."""
OUTPUT_SCALE_NM = (76.704, 25.671)
THRESHOLDS_NM = {"authors, 15.3/3.3": (15.296, 3.2605), "authors, later, 8.5/2.5": (8.48, 2.54)}
TRAINED: dict[str, tuple[float | None, ...]] = {
    "friction": (AUTHORS_GAIN_PER_S, 20.0),
    "prior": (AUTHORS_GAIN_PER_S, 20.0, None),
}
"""Recipes and their gains: the recorded one, the paper's, and the one that the recipe chooses."""
EARLY_S, LATE_S = 0.1, 0.6
"""An alarm belongs to a collision from so long before its onset, which was read off by eye, to so long after it."""
APART_S = 0.5
"""False alarms closer together than this count as one."""


# --- The authors' network.


def authors_weights(data: Path) -> dict[str, np.ndarray]:
    """Weights as `tauext train --network` reads them; negated at the head, since r has the other sign here.

    Raises:
        SystemExit: a file is missing or has another number of weights.
    """
    shapes = {
        "lstm.weight_ih_l0": ("lstm_weight_ih_l0", (4 * UNITS, 6)),
        "lstm.weight_hh_l0": ("lstm_weight_hh_l0", (4 * UNITS, UNITS)),
        "lstm.bias_ih_l0": ("lstm_bias_ih_l0", (4 * UNITS,)),
        "lstm.bias_hh_l0": ("lstm_bias_hh_l0", (4 * UNITS,)),
        "linear.weight": ("linear_weight", (2, UNITS)),
        "linear.bias": ("linear_bias", (2,)),
    }
    found = {}
    for key, (name, shape) in shapes.items():
        path = data / "no_model_network" / f"{name}.txt"
        if not path.is_file():
            raise SystemExit(f"{path}: is no file; DATA holds the authors' network in no_model_network/")
        numbers = np.loadtxt(path).ravel()
        if len(numbers) != np.prod(shape):
            raise SystemExit(f"{path}: holds {len(numbers)} numbers; {shape} needs {np.prod(shape)}")
        found[key] = numbers.reshape(shape) * (-1.0 if key.startswith("linear") else 1.0)
    return found


def twin(weights: dict[str, np.ndarray], q: np.ndarray, dq: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """The network in NumPy, scaled outputs (windows, 2); row k of a window is ends - WINDOW + 1 + k."""
    rows = ends[:, None] - np.arange(WINDOW - 1, -1, -1)
    x = np.concatenate([np.mod(q[rows] + np.pi, 2 * np.pi) - np.pi, dq[rows], dq[rows - 1]], axis=-1) / INPUT_SCALE
    bias = weights["lstm.bias_ih_l0"] + weights["lstm.bias_hh_l0"]
    h = c = np.zeros((len(ends), UNITS))
    for step in range(WINDOW):
        gates = x[:, step] @ weights["lstm.weight_ih_l0"].T + h @ weights["lstm.weight_hh_l0"].T + bias
        i, f, g, o = np.split(gates, 4, axis=1)
        c = c / (1 + np.exp(-f)) + np.tanh(g) / (1 + np.exp(-i))
        h = np.tanh(c) / (1 + np.exp(-o))
    return np.asarray(h @ weights["linear.weight"].T + weights["linear.bias"])


# --- Bundles on segments.


@dataclass
class Tested:
    """Errors outside collisions (rows, 2), collisions found, and false alarms; summed over segments."""

    errors: list[np.ndarray] = field(default_factory=list)
    early: list[np.ndarray] = field(default_factory=list)
    """Errors of the authors' early network on the same rows."""
    found: int = 0
    peaks_nm: list[np.ndarray] = field(default_factory=list)
    """Largest |tau_ext| of each collision, a joint."""
    collisions: int = 0
    false_alarms: int = 0

    def add(self, segment: Segment, found: dict[str, np.ndarray]) -> None:
        """Add one segment and a bundle's estimates of it."""
        healthy = found["health"] == OK
        away = healthy & ~segment.near_contact
        self.errors.append(np.abs(found["tau_ext"][away]))
        self.early.append(np.abs(segment.residual - segment.early_lstm)[away])
        held = healthy & (found["held_alarm"] == COLLISION)
        begins = np.array([begin for begin, _ in runs(held & ~segment.near_contact)])
        self.false_alarms += len(begins) and 1 + int((np.diff(begins) > APART_S * RATE_HZ).sum())
        for onset_s in segment.onsets_s:
            self.collisions += 1
            inside = (segment.time_s > onset_s - EARLY_S) & (segment.time_s < onset_s + LATE_S)
            self.found += int((inside & held).any())
            self.peaks_nm.append(np.abs(found["tau_ext"][inside & healthy]).max(axis=0, initial=0.0))

    def separation(self) -> float:
        """The weakest collision's peak over the largest error outside collisions, of the joint with the larger ratio.

        All thresholds between 1 and this many times the largest errors detect every collision, without a false alarm.
        """
        largest = np.concatenate(self.errors).max(axis=0)
        return float(min((peak / largest).max() for peak in self.peaks_nm))


def write_dataset(segments: list[Segment], folder: Path) -> Dataset:
    folder.mkdir(parents=True, exist_ok=True)
    tree = nominal_tree(folder / "robot.xml")
    names = tuple(f"segment-{one.number}.parquet" for one in segments)
    for name, one in zip(names, segments, strict=True):
        save_recording(recording(one, tree), folder / name)
    save_split(Split(names, (), ()), folder)
    return load_dataset(folder)


def settings(recipe: str, gain_per_s: float | None, **others: Any) -> TrainConfig:
    return TrainConfig(recipe=recipe, margins=MARGINS, observer=ObserverConfig(gain_per_s=gain_per_s), **others)


def held_out(
    segments: list[Segment], dataset: Dataset, recipe: str, case: CaseName, gain_per_s: float | None, out: Path
) -> tuple[Tested, list[_core.Bundle]]:
    """The recipe on each segment, trained on the others."""
    tested, bundles = Tested(), []
    for one, name in zip(segments, dataset.split.train, strict=True):
        others = tuple(other for other in dataset.split.train if other != name)
        fold = replace(dataset, split=Split(others, (), (name,)))
        path = out / f"{recipe}-{case}-{gain_per_s or 'chosen'}-{one.number}.tauext"
        accept = ("limit-wide", "limit-fine")  # a friction model alone, without a model, errs by the gravity
        bundle = train_bundle(fold, path, case, config=settings(recipe, gain_per_s), check=False, accept=accept)
        tested.add(one, estimates(bundle, fold.recordings("test")[0]))
        bundles.append(bundle)
    return tested, bundles


def share(found: int, of: int) -> str:
    return "{} of {} ({:.0f} to {:.0f} %)".format(found, of, *share_interval(found, of))


def recipe_row(words: str, tested: Tested, limits_nm: np.ndarray) -> str:
    errors = np.concatenate(tested.errors)
    hours = len(errors) / RATE_HZ / 3600
    low, high = rate_interval(tested.false_alarms, hours)
    return table_row(
        words,
        *error_cells(errors),
        joined(limits_nm, ".1f", "/"),
        share(tested.found, tested.collisions),
        f"{tested.false_alarms} in {3600 * hours:.0f} s ({low:.0f} to {high:.0f}/h)",
        f"{tested.separation():.2f}",
    )


def authors_section(segments: list[Segment], dataset: Dataset, data: Path, out: Path) -> tuple[list[str], _core.Bundle]:
    weights, file = authors_weights(data), out / "authors.npz"
    np.savez(file, **weights, input_scale=INPUT_SCALE, output_scale_nm=OUTPUT_SCALE_NM)
    config = settings("paper", AUTHORS_GAIN_PER_S, limits="paper")
    bundle = train_bundle(dataset, out / "authors.tauext", "none", config=config, check=False, start=load_network(file))
    tested, difference, windows = Tested(), 0.0, 0
    for one, made in zip(segments, dataset.recordings("train"), strict=True):
        found = estimates(bundle, made)
        tested.add(one, found)
        ends = np.flatnonzero(found["health"] == OK)
        if len(ends):
            scaled = found["network"][ends] / OUTPUT_SCALE_NM
            difference = max(difference, np.abs(scaled - twin(weights, made.q, made.dq, ends)).max())
            windows += len(ends)
    errors = np.concatenate(tested.errors)
    own = {"largest error outside collisions": errors.max(axis=0)} | {k: np.array(v) for k, v in THRESHOLDS_NM.items()}
    lines = [
        f"The bundle equals a NumPy twin within {difference:.1e} of the output's scale, in {windows} windows.",
        "",
        *head("rows outside collisions, s | L1, N m | L2, N m | largest, N m | separation"),
        table_row(f"{len(errors) / RATE_HZ:.0f}", *error_cells(errors), f"{tested.separation():.2f}"),
        table_row("paper, whole test set", "0.409/0.259", "0.683/0.376", "-", "-"),
        "",
        *head("threshold, N m | collisions over it | rows outside collisions over it"),
    ]
    for words, limit in own.items():
        over = sum(bool((peak > limit).any()) for peak in tested.peaks_nm)
        lines.append(table_row(words, share(over, len(tested.peaks_nm)), int((errors > limit).any(axis=1).sum())))
    return lines, bundle


def recipes_section(segments: list[Segment], dataset: Dataset, out: Path) -> tuple[list[str], dict[str, list]]:
    lines = head(
        "recipe | L1, N m | L2, N m | largest, N m | threshold sliding, N m | collisions detected (95 %) | "
        "false alarms (95 %) | separation"
    )
    early, kept, rows = None, {}, []
    for case in ("exact", "none"):
        for recipe, gains_per_s in TRAINED.items():
            for gain in gains_per_s:
                tested, bundles = held_out(segments, dataset, recipe, case, gain, out)
                gains = sorted({round(bundle.observer.gain_per_s) for bundle in bundles})
                limits = np.mean([bundle.sliding_limit_nm for bundle in bundles], axis=0)
                words = f"{recipe}, {case}, K0 {' or '.join(map(str, gains))}"
                rows.append((gains[0], recipe_row(words, tested, limits)))
                if recipe == "prior" and gain == PAPER_GAIN_PER_S:
                    kept[case] = bundles
                if recipe == "prior" and gain == AUTHORS_GAIN_PER_S:
                    early = np.concatenate(tested.early)
    assert early is not None
    cells = [*error_cells(early), "-", "-", "-", "-"]
    lines += [row for _, row in sorted(rows, key=lambda row: row[0])]
    return [*lines, table_row("the authors' early network, exact, K0 5, rows of K0 5", *cells)], kept


# --- Figures.


def seconds_of(segments: list[Segment]) -> list[np.ndarray]:
    """Time axis of each segment, one after the other with a gap of a second, [s]."""
    starts = np.cumsum([0.0, *(one.time_s[-1] + 1.0 for one in segments)])
    return [start + one.time_s for start, one in zip(starts, segments, strict=False)]


def figure_5(segments: list[Segment], dataset: Dataset, out: Path, path: Path) -> None:
    """Observer and estimate of the five models on the longest segment; recipe prior trained on the others."""
    k = int(np.argmax([len(one.time_s) for one in segments]))
    one, made = segments[k], dataset.recordings("train")[k]
    free = slice(0, round(13.0 * RATE_HZ))
    with plt.rc_context(RC):
        figure, axes = plt.subplots(2, len(PAPER_CASES), figsize=(WIDTH_IN, 4.2), sharex=True, layout="constrained")
        others = tuple(name for name in dataset.split.train if name != dataset.split.train[k])
        fold = replace(dataset, split=Split(others, (), ()))
        for column, case in zip(axes.T, PAPER_CASES, strict=True):
            bundle = train_bundle(
                fold, out / f"figure-5-{case}.tauext", case, config=settings("prior", 20.0), check=False
            )
            found = estimates(bundle, made)
            healthy = found["health"] == OK
            for joint, axis in enumerate(column):
                observer = np.where(healthy, found["residual"][:, joint], np.nan)[free]
                estimate = observer - np.where(healthy, found["tau_ext"][:, joint], np.nan)[free]
                axis.plot(one.time_s[free], observer, color=OBSERVER, lw=OBSERVER_WIDTH, label="observer r")
                axis.plot(one.time_s[free], estimate, color="#0072b2", label="recipe prior")
                axis.set_ylabel(f"joint {joint + 1}, N m" if case == "exact" else "")
            column[0].set_title({"none": "no model"}.get(case, case))
            column[1].set_xlabel("time, s")
        figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
        figure.savefig(path, dpi=DPI)
        plt.close(figure)


def figure_7(segments: list[Segment], dataset: Dataset, bundles: dict[str, list[_core.Bundle]], path: Path) -> None:
    """Observer and estimate without a model in the ten collisions: the authors' network, and recipe prior."""
    times, made = seconds_of(segments), dataset.recordings("train")
    with plt.rc_context(RC):
        figure, axes = plt.subplots(2 * len(bundles), 1, figsize=(WIDTH_IN, 7.2), sharex=True, layout="constrained")
        for (words, each), pair in zip(bundles.items(), axes.reshape(-1, 2), strict=True):
            for one, time_s, row, bundle in zip(segments, times, made, each, strict=True):
                found = estimates(bundle, row)
                healthy = (found["health"] == OK)[:, None]
                observer = np.where(healthy, found["residual"], np.nan)
                estimate = np.where(healthy, found["residual"] - found["tau_ext"], np.nan)
                for joint, axis in enumerate(pair):
                    for begin, end in runs(one.near_contact):
                        axis.axvspan(time_s[begin], time_s[end - 1], color=CONTACT, lw=0)
                    axis.plot(time_s, observer[:, joint], color="black", label="observer r")
                    axis.plot(time_s, estimate[:, joint], color="#d62728", ls=(0, (2, 1)), label="estimate")
            for joint, axis in enumerate(pair):
                axis.set_ylabel(f"joint {joint + 1}, N m")
            pair[0].set_title(words)
        axes[-1].set_xlabel("time, s (segments one after the other)")
        lines, labels = axes[0].get_legend_handles_labels()
        figure.legend(lines[:2], labels[:2], loc="outside lower center", ncols=2)
        figure.savefig(path, dpi=DPI)
        plt.close(figure)


def main() -> None:
    parser = arguments(__doc__, "data", "out")
    parser.add_argument("--keep", action="store_true", help="write the figures of docs/results/mocca")
    options = parser.parse_args()
    data, out = options.data, options.out
    page = PAGE if options.keep else out / "page"
    segments = read_segments(data)
    assert sum(len(one.onsets_s) for one in segments) == sum(map(len, ONSETS_S.values()))
    dataset = write_dataset(segments, out / "data")
    page.mkdir(parents=True, exist_ok=True)
    authors, bundle = authors_section(segments, dataset, data, out)
    recipes, kept = recipes_section(segments, dataset, out)
    figure_5(segments, dataset, out, page / "figure-5.png")
    both = {"the authors' network, K0 = 5 1/s": [bundle] * len(segments), "recipe prior, K0 = 20 1/s": kept["none"]}
    figure_7(segments, dataset, both, page / "figure-7.png")
    write_tables(out, [*authors, "", *recipes])


if __name__ == "__main__":
    main()
