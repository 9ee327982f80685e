"""A simulated SO-101 whose torques are known: errors, contacts found by tauext and by other methods, velocities.

    python benchmarks/so101_sim.py OUT [--seed 0] [--only simulate bundles tables] [--rates 50 30 100]
    python benchmarks/deep_torque.py OUT --rate 50    between bundles and tables; needs PyTorch
    python benchmarks/so101_sim.py OUT --only tables --keep     writes the tables into docs/results/so101-sim

OUT/RATEhz has the recordings, as a servo bus reports them, and the truth. OUT/RATEhz/SOURCE has tauext's results with
the torque from one source; each step is a tauext command. Existing files are used again.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import unseen.servo_tables as tables
from common import ROOT, head, joined, replace_section, table_row, tauext, write_page
from unseen.recordings import Take
from unseen.servo_recordings import description, write_take
from unseen.servo_tables import contact_cells
from unseen.servos import servo_arm, so101

from tauext import _core

KEPT = ROOT / "docs" / "results" / "so101-sim"
RATES_HZ = (50, 30, 100)
TEN_MINUTES = tuple(Take(f"train-{k}", "train", 5) for k in (1, 2))
TESTS = tuple(Take(f"free-{k}", "test", 10) for k in range(1, 5))
TOUCHED = tuple(Take(f"touched-{k}", "collisions", 10, 60) for k in range(1, 4))
HOUR = tuple(Take(f"train-{k}", "train", 10) for k in range(3, 8))
UNTOUCHED = Take("untouched-1", "", 10)
"""The motion of touched-1 that nothing touches: what a contact changes is the difference."""
TAKES = {take: 10 + number for number, take in enumerate(TEN_MINUTES + TESTS + TOUCHED + HOUR)}
"""With the number of their draws."""
TAKES[UNTOUCHED] = TAKES[TOUCHED[0]]


def tested(rate_hz: int) -> tuple[Take, ...]:
    """Takes to test on: 70 minutes at the first rate, 40 at the others."""
    return TESTS + TOUCHED if rate_hz == RATES_HZ[0] else TESTS[:2] + TOUCHED[:2]


def simulate(out: Path, seed: int) -> None:
    """All recordings: at every rate those for ten minutes of training, at the first also what an hour needs."""
    maker = so101()
    arm = servo_arm(maker, seed)
    first = [(RATES_HZ[0], take) for take in (*TEN_MINUTES, *tested(RATES_HZ[0]), UNTOUCHED)]
    others = [(rate, take) for rate in RATES_HZ[1:] for take in (*TEN_MINUTES, *tested(rate))]
    for rate, take in [*first, *others, *((RATES_HZ[0], take) for take in HOUR)]:
        folder = out / f"{rate}hz"
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / f"{take.name}.parquet").exists():
            write_take(maker, arm, rate, take, TAKES[take], seed, folder)
            print(f"{folder.name}/{take.name}", flush=True)


SOURCES = ("duty", "supply-current", "goal", "linear")
DEEP = {"duty": "load", "supply-current": "current"}
"""The signal that the networks of deep_torque.py predict, beside what tauext has from the same register."""
CONTACT_WORDS = """\
*Found at 1.5 times the limit*: share of contacts found whose true torque, low-passed by the observer's filter, exceeds
1.5 times the row's momentary limits for its hold time and 20 ms. *Of all*: share of all contacts, then by the largest
true torque at a joint. *False*: false alarms in free motion, those within 3 s after a contact, and the hours of
motion."""
DEEP_WORDS = """\
*Found at 1.5 times the limit*: by the limits of tauext's row. A network's limits are its largest errors on the fifth of
the training data that it was not trained on (factor 1). The second row of a network raises them until it has no more
false alarms than tauext."""
STEPS = ("simulate", "bundles", "tables")


@dataclass(frozen=True)
class Trial:
    """What one bundle is trained on."""

    rate_hz: int
    source: str
    model: bool = True
    hour: bool = False
    recipe: str = "tauext"
    constant: bool = False
    """Limits are constants, instead of following the error that the motion announces."""

    @property
    def bundle(self) -> str:
        return f"{self.data}-{self.recipe}{'-constant' if self.constant else ''}.tauext"

    @property
    def data(self) -> str:
        return f"{self.rate_hz}hz/{self.source}{'' if self.model else '-none'}{'-hour' if self.hour else ''}"

    @property
    def takes(self) -> tuple[Take, ...]:
        return TEN_MINUTES + (HOUR if self.hour else ()) + tested(self.rate_hz)


def trials(rates: Sequence[int]) -> list[Trial]:
    """What is trained: all sources at every rate; at the first also other recipes, no model, an hour."""
    first = rates[0]
    more = [
        *(Trial(first, "duty", recipe=recipe) for recipe in ("friction", "observer")),
        *(Trial(first, source, model=False) for source in ("duty", "goal")),
        *(Trial(first, source, constant=True) for source in SOURCES[:-1]),
        *(Trial(first, source, hour=True) for source in ("duty",)),
    ]
    return (
        [Trial(first, source) for source in SOURCES]
        + more
        + [Trial(rate, source) for rate in rates[1:] for source in SOURCES[:-1]]
    )


def make(out: Path, trial: Trial) -> Path:
    """The bundle of a trial; its dataset beside it."""
    data, raw = out / trial.data, out / f"{trial.rate_hz}hz"
    if not (data / "split.json").exists():
        law = tables.linear_law(raw, [take.name for take in TEN_MINUTES], so101().joints).round(4).tolist()
        linear = law if trial.source == "linear" else ()
        arm = data.with_suffix(".toml")
        arm.write_text(description(so101(), trial.takes, trial.source, trial.model, linear))
        files = [raw / f"{take.name}.parquet" for take in trial.takes]
        imported = data.with_suffix(".import.txt")
        tauext("import", "--source", *files, "--arm", arm, "--out", data, printed=imported)
    bundle = out / trial.bundle
    if not bundle.exists():
        case = () if trial.model else ("--case", "none")
        if trial.constant:
            settings = bundle.with_suffix(".toml")
            settings.write_text('error_scale = "off"\n')
            case += ("--config", settings)
        case += ("--accept", "effort-sign") if trial.source == "goal" else ()  # see the page: steps of 30 Hz
        printed = bundle.with_suffix(".train.txt")
        tauext("train", "--data", data, "--recipe", trial.recipe, *case, "--out", bundle, printed=printed)
        print(bundle, flush=True)
    return bundle


def write_tables(out: Path, rates: Sequence[int], seed: int, keep: bool) -> None:
    """Write the tables of all bundles that exist to OUT/tables.md, or into the page in the repository."""
    lines = [
        f"Seed {seed}. Networks were trained at 50 Hz only.",
        "",
        "### Torque of the motor",
        "",
        *torque_tables(out, rates),
    ]
    lines += ["", "### Contacts", "", CONTACT_WORDS, "", *contact_tables(out, rates)]
    lines += ["", "### Networks that predict the motor's signal", "", DEEP_WORDS, "", *deep_tables(out, rates)]
    lines += ["", "### Velocity", "", *velocity_tables(out, rates, seed)]
    if keep:
        replace_section(KEPT / "README.md", "## All tables", lines)
    else:
        write_page(out / "tables.md", lines)


def torque_tables(out: Path, rates: Sequence[int]) -> list[str]:
    lines = head("torque from | Hz | free motion: RMS error, Nm | joint by joint | in contact | joint by joint")
    joints = so101().joints
    for rate in rates:
        names = [take.name for take in tested(rate)]
        raw = out / f"{rate}hz"
        law = tables.linear_law(raw, [take.name for take in TEN_MINUTES], joints)
        linear = {name: law * tables.registers(raw, name, "signed", joints) for name in names}
        lines.append(tables.torque_row(f"linear law of the current | {rate}", raw, linear))
        for source in SOURCES[:-1]:
            data = out / Trial(rate, source).data
            if (data / "split.json").exists():
                torques = {recording.name: recording.tau for recording in tables.tests_of(data)}
                lines.append(tables.torque_row(f"{source}, the type's constants | {rate}", raw, torques))
            if (bundle := out / Trial(rate, source).bundle).exists():
                factor = np.array(_core.Bundle.load(str(bundle)).observer.nm_per_unit or 1.0)
                corrected = {name: factor * torque for name, torque in torques.items()}
                lines.append(tables.torque_row(f"{source}, corrected in training | {rate}", raw, corrected))
    return lines


def contact_tables(out: Path, rates: Sequence[int]) -> list[str]:
    first = "torque from | Hz | model | training, min | recipe | error free, in contact, Nm"
    lines = head(tables.CONTACT_COLUMNS.format(first=first))
    for trial in trials(rates):
        bundle = out / trial.bundle
        if bundle.exists():
            verdicts, errors = tables.judged(bundle, out / trial.data)
            what = (trial.source, trial.rate_hz, "urdf" if trial.model else "none", 60 if trial.hour else 10)
            recipe, wrong = trial.recipe + ", constant limits" * trial.constant, joined(errors, ".3f", ", ")
            lines.append(table_row(*what, recipe, wrong, contact_cells(verdicts, verdicts.strong)))
            print(lines[-1], flush=True)
    return lines


def deep_tables(out: Path, rates: Sequence[int]) -> list[str]:
    lines = head(tables.CONTACT_COLUMNS.format(first="signal | Hz | method | factor on limits"))
    shares = []
    for rate in rates:
        raw = out / f"{rate}hz"
        for source, signal in DEEP.items():
            trial = Trial(rate, source)
            bundle, data = out / trial.bundle, out / trial.data
            if not bundle.exists() or not (raw / f"deep-{signal}-goal").exists():
                continue
            ours, _ = tables.judged(bundle, data)
            lines.append(f"| {source} | {rate} | tauext | 1 | {contact_cells(ours, ours.strong)} |")
            for inputs, words in (("goal", "LSTM on q, dq, goal − q"), ("motion", "LSTM on q, dq")):
                kept = raw / f"deep-{signal}-{inputs}"
                if not (kept / f"{tested(rate)[-1].name}.npz").exists():
                    continue
                own, factor, equal = tables.deep_verdicts(kept, data, ours.false_free + ours.false_after)
                lines.append(f"| {source} | {rate} | {words} | 1 | {contact_cells(own, ours.strong)} |")
                cells = contact_cells(equal, ours.strong)
                lines.append(f"| {source} | {rate} | {words}, equal false alarms | {factor:.2f} | {cells} |")
                if rate == RATES_HZ[0]:
                    within, overall = tables.explained(raw, kept, TOUCHED[0].name, UNTOUCHED.name)
                    shares.append(f"| {signal} | {words}: predicted share of the signal's change | {overall:.2f} |")
                    shares.append(f"| {signal} | the same, for signals no larger than in free motion | {within:.2f} |")
            if rate == RATES_HZ[0]:
                share = tables.seen_by(bundle, data)
                shares.append(f"| {source} | tauext: share of the true torque in tau_ext | {share:.2f} |")
    learned = ["Effect of a contact, at joints with more than 0.1 Nm of contact torque:", ""]
    return [*lines, "", *learned, "| signal | | share |", "|---|---|---|", *shares]


def velocity_tables(out: Path, rates: Sequence[int], seed: int) -> list[str]:
    rotor = servo_arm(so101(), seed).servos.rotor_kg_m2
    columns = "Hz | estimator | error in motion, RMS rad/s | lag, ms | standing, RMS rad/s "
    columns += "| spurious torque, RMS Nm | largest"
    lines = head(columns)
    for rate in sorted(rates):
        names = [take.name for take in TESTS[:2]]
        lines += tables.velocity_rows(out / f"{rate}hz", names, so101().joints, rate, np.asarray(rotor))
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=0, help="of the arm, its motion and its contacts")
    parser.add_argument("--rates", type=int, nargs="+", choices=RATES_HZ, default=list(RATES_HZ))
    parser.add_argument("--only", nargs="+", choices=STEPS, default=list(STEPS))
    parser.add_argument("--keep", action="store_true", help="write the tables into docs/results/so101-sim")
    options = parser.parse_args()
    out = options.out.resolve()
    if "simulate" in options.only:
        simulate(out, options.seed)
    if "bundles" in options.only:
        for trial in trials(options.rates):
            make(out, trial)
    if "tables" in options.only:
        write_tables(out, options.rates, options.seed, options.keep)


if __name__ == "__main__":
    main()
