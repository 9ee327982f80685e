"""What arms carry, weighed by their own joints: arms of the trial on unseen arms, with loads that they do not know.

    python benchmarks/loads.py MODELS OUT [--arms ur5 panda ...] [--seed 0]

Each arm is trained on nine minutes without a load, with constants of its currents that are true, and again with ones
off by up to 10 %. Then it moves with 25 loads of 0.5 to 3 kg within 10 cm of its last joint's origin, two windows of 4
s each; with a weight of 2.805 kg that is known; and with a constant force on its last link. OUT/loads.md and
OUT/loads.json get the tables. What is there is used again.
"""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import arguments, head, in_parallel, joined, table_row, trained, write_tables
from unseen.arms import Maker, makers, true_arm
from unseen.loads import (
    FIRST_S,
    KNOWN_KG,
    TRAIN,
    WINDOW_S,
    WINDOWS,
    Carried,
    carried,
    write_carrying,
)
from unseen.recordings import description, import_csv, simulate_takes

from tauext._core import LoadFound, corrected_bundle
from tauext.bundle.bundle_file import load_bundle
from tauext.data.recording_file import load_recording
from tauext.errors import TauextError
from tauext.monitor.known_load import weigh_constants
from tauext.monitor.weighing import identify, load_frame, mass_error, see

WRONG = 0.1
KINDS = {"true": ["--fit-torque-constants", "False"], "off": []}
"""Torque constants, and the ones given to training; training corrects constants of currents unless they are given."""
TRUE_TO = 0.01
"""Standard error that is stated of the true ones, as of measured constants: magnets get warm."""


def main() -> None:
    parser = arguments(__doc__, "models", "out", arms=("ur5", "panda", "kinova", "seven_axis"), seed=0)
    parser.add_argument("--true-only", nargs="*", default=[], help="of these, arms whose constants are never off")
    options = parser.parse_args()
    outcomes: list[Weighed] = []
    factors: dict[str, dict] = {}
    for name in options.arms:
        folder = options.out / name
        kinds = ["true"] if name in options.true_only else list(KINDS)
        settings = folder / "true.toml"
        folder.mkdir(parents=True, exist_ok=True)
        settings.write_text(f"torque_share = {TRUE_TO}\n")
        maker = makers(options.models)[name]
        takes = carried(maker, options.seed)
        simulate_all(maker, folder, options.seed, list(takes))
        for kind in kinds:
            dataset(maker, folder, options.seed, kind, folder / f"data-{kind}", list(takes))
            stated = ["--config", settings] if kind == "true" else []
            trained(folder / f"data-{kind}", folder / f"{kind}.tauext", *KINDS[kind], *stated)
            outcomes += weigh(folder, kind, folder / f"{kind}.tauext", maker, takes)
        if name in options.true_only:
            continue
        factors[name] = correct(folder, maker, options.seed)
        for kind in ("common", "joints"):
            if (folder / f"off-{kind}.tauext").exists():
                outcomes += weigh(folder, f"off, {kind}", folder / f"off-{kind}.tauext", maker, takes)
    facts = summary(outcomes) | {"factors": factors}
    write_tables(options.out, tables(facts["weighed"], factors), facts, "loads")


def wrong_constants(maker: Maker, seed: int) -> np.ndarray:
    return maker.random(seed, 98).uniform(1 - WRONG, 1 + WRONG, len(maker.joints))


def simulate_all(maker: Maker, folder: Path, seed: int, names: list[str]) -> None:
    """Every recording that does not exist: those to train on, and these of `carried`."""
    raw = folder / "csv"
    simulate_takes(maker, seed, raw, TRAIN, os.cpu_count())
    missing = [name for name in names if not (raw / f"{name}.truth.json").exists()]
    in_parallel(os.cpu_count(), write_carrying, [(maker, seed, name, raw) for name in missing])


def dataset(maker: Maker, folder: Path, seed: int, kind: str, out: Path, names: list[str], part: str = "test") -> None:
    """Import training and, into a part of the split, the recordings of these names, with constants that are true, off
    by up to WRONG, or unknown."""
    if out.is_dir():
        return
    arm = true_arm(maker, maker.random(seed, 0))
    wrong = wrong_constants(maker, seed) if kind == "off" else 1.0
    text = description(maker, seed, model=True, takes=TRAIN)
    constants = json.dumps("unknown" if kind == "unknown" else (arm.nm_per_ampere * wrong).tolist())
    text = re.sub(r"torque_constant = .*", f"torque_constant = {constants}", text)
    text = text.replace(f"{part} = []", f"{part} = {json.dumps([f'{name}.csv' for name in names])}")
    files = [folder / "csv" / f"{name}.csv" for name in [*(take.name for take in TRAIN), *names]]
    import_csv(text, files, folder / "csv" / f"arm-{out.name}.toml", out)


def weigh(folder: Path, label: str, path: Path, maker: Maker, takes: dict[str, Carried]) -> list[Weighed]:
    """Every window of every load and push."""
    bundle = load_bundle(path)
    frame = load_frame(bundle, maker.joints[-1])
    data = folder / f"data-{label.split(',')[0]}"
    outcomes = []
    for name, truth in takes.items():
        if name == "known":
            continue
        seen = see(bundle, load_recording(data / f"{name}.parquet"))
        for k in range(WINDOWS):
            begin = FIRST_S + k * WINDOW_S
            part = seen.part((seen.time_s >= begin) & (seen.time_s < begin + WINDOW_S))
            try:
                found = identify(bundle, frame, [part])
            except TauextError:
                outcomes.append(Weighed.refused(maker.name, label, name, truth))
                continue
            outcomes.append(Weighed.of(maker.name, label, name, truth, found))
    return outcomes


def correct(folder: Path, maker: Maker, seed: int) -> dict:
    """The known weight on the arm whose constants are off: the common factor put into the bundle, and those of every
    joint into a new training."""
    bundle = load_bundle(folder / "off.tauext")
    recording = load_recording(folder / "data-off" / "known.parquet")
    constants = np.array(bundle.observer.nm_per_unit or np.ones(bundle.joints))
    facts: dict = {"left": (1 / (wrong_constants(maker, seed) * constants)).tolist()}
    try:
        known = weigh_constants(bundle, load_frame(bundle, maker.joints[-1]), [see(bundle, recording)], KNOWN_KG)
    except TauextError as error:
        return facts | {"refused": str(error)}
    corrected_bundle(bundle, known).save(str(folder / "off-common.tauext"))
    told = (constants * known.factors).tolist()
    constants_told = ["--torque-constants", *(f"{k:.6g}" for k in told)]
    trained(folder / "data-off", folder / "off-joints.tauext", *constants_told)
    return facts | {
        "common": known.common,
        "common_error": known.common_error,
        "joints": known.factors.tolist(),
        "errors": known.errors.tolist(),
        "shows": known.shows,
    }


# --- Tables.


MASS_SHARE, MASS_KG = 0.05, 0.1
COM_M, COM_LIGHT_M, LIGHT_KG = 0.02, 0.04, 1.0
TITLES = {
    "true": "true constants",
    "off": "off by up to 10 %, as trained",
    "off, common": "then `--known-kg`, one factor",
    "off, joints": "then retrained with `--torque-constants`",
}


@dataclass(frozen=True)
class Weighed:
    """One window."""

    arm: str
    kind: str
    recording: str
    truth: Carried
    verdict: str
    mass_kg: float = np.nan
    mass_error_kg: float = np.nan
    off_m: float = np.nan
    com_error_m: float = np.nan

    @classmethod
    def of(cls, arm: str, kind: str, recording: str, truth: Carried, found: LoadFound) -> Weighed:
        off, error = (float(np.linalg.norm(one)) for one in (found.com_m - truth.com_m, found.com_error_m))
        return cls(arm, kind, recording, truth, found.verdict, found.mass_kg, mass_error(found), off, error)

    @classmethod
    def refused(cls, arm: str, kind: str, recording: str, truth: Carried) -> Weighed:
        return cls(arm, kind, recording, truth, "refused")

    @property
    def mass_right(self) -> bool:
        true = self.truth.mass_kg
        return self.verdict == "load" and abs(self.mass_kg - true) <= max(MASS_SHARE * true, MASS_KG)

    @property
    def mass_told(self) -> bool:
        """Twice the reported standard error is within the tolerance."""
        return self.verdict == "load" and 2 * self.mass_error_kg <= max(MASS_SHARE * self.truth.mass_kg, MASS_KG)

    @property
    def within_m(self) -> float:
        return COM_M if self.truth.mass_kg >= LIGHT_KG else COM_LIGHT_M

    @property
    def com_right(self) -> bool:
        return self.verdict == "load" and self.off_m <= self.within_m

    @property
    def com_told(self) -> bool:
        """The reported standard error is within the tolerance."""
        return self.verdict == "load" and self.com_error_m <= self.within_m


def row(of: Sequence[Weighed]) -> dict:
    """Figures of the loads among these."""
    loads = [w for w in of if w.truth.mass_kg > 0]
    seen = [w for w in loads if w.verdict == "load"]
    off = np.array([w.mass_kg - w.truth.mass_kg for w in seen])
    told = [w for w in loads if w.com_told]
    share = off / [w.truth.mass_kg for w in seen]
    return {
        "windows": len(loads),
        "mass": float(np.mean([w.mass_right for w in loads])),
        "com": float(np.mean([w.com_right for w in loads])),
        "both": float(np.mean([w.mass_right and w.com_right for w in loads])),
        "mass_told": float(np.mean([w.mass_told for w in loads])),
        "mass_where_told": mean_of([w.mass_right for w in loads if w.mass_told]),
        "com_told": len(told) / len(loads),
        "com_where_told": mean_of([w.com_right for w in told]),
        "mass_bias": float(np.median(share)),
        "mass_spread": float(np.quantile(np.abs(share - np.median(share)), 0.68)),
        "within_2_errors": float(np.mean(np.abs(off) <= 2 * np.array([w.mass_error_kg for w in seen]))),
        "verdicts": dict(Counter(w.verdict for w in loads)),
        "pushes": dict(Counter(w.verdict for w in of if w.truth.push_n > 0)),
    }


def mean_of(values: Sequence[bool]) -> float | None:
    """None of none."""
    return float(np.mean(values)) if values else None


def summary(outcomes: Sequence[Weighed]) -> dict:
    """By constants and arm, `all` over arms."""
    facts: dict = {}
    for kind in dict.fromkeys(w.kind for w in outcomes):
        of = [w for w in outcomes if w.kind == kind]
        facts[kind] = {arm: row([w for w in of if w.arm == arm]) for arm in dict.fromkeys(w.arm for w in of)}
        facts[kind]["all"] = row(of)
    return {"weighed": facts}


def tables(facts: dict, factors: dict[str, dict]) -> list[str]:
    """Masses and centres, verdicts, factors."""
    lines = head(
        "constants | arm | windows | mass | centre | both | mass certain | mass right where certain | centre certain "
        "| centre right where certain | mass error, median (68 %) | mass within two standard errors"
    )
    for kind, arms in facts.items():
        for arm, f in arms.items():
            mass, where = ("–" if f[key] is None else f"{f[key]:.0%}" for key in ("mass_where_told", "com_where_told"))
            name = f"**{arm}**" if arm == "all" else arm
            shares = [f"{f[key]:.1%}" for key in ("mass", "com", "both")]
            told = [f"{f['mass_told']:.0%}", mass, f"{f['com_told']:.0%}", where]
            off = [f"{f['mass_bias']:+.1%} (± {f['mass_spread']:.1%})", f"{f['within_2_errors']:.0%}"]
            lines.append(table_row(TITLES[kind], name, f["windows"], *shares, *told, *off))
    lines += ["", *head("constants | arm | loads | forces")]
    for kind, arms in facts.items():
        for arm, f in arms.items():
            counts = (", ".join(f"{n} {v}" for v, n in sorted(f[key].items())) for key in ("verdicts", "pushes"))
            lines.append(table_row(TITLES[kind], arm, *counts))
    return [*lines, "", *factor_lines(factors)]


def factor_lines(factors: dict[str, dict]) -> list[str]:
    """Factors found with a known weight, and the true ones."""
    lines = head("arm | true | one factor | joint by joint (in brackets: the common factor)")
    for arm, f in factors.items():
        true = joined(f["left"], ".3f")
        if "refused" in f:
            lines.append(f"| {arm} | {true} | refused: {f['refused']} | |")
            continue
        own = " · ".join(f"{x:.3f}" if s else f"({x:.3f})" for x, s in zip(f["joints"], f["shows"], strict=True))
        lines.append(table_row(arm, true, f"{f['common']:.3f} ± {f['common_error']:.3f}", own))
    return lines


if __name__ == "__main__":
    main()
