"""What arms carry, weighed by their own joints: arms of the trial on unseen arms, with loads that they do not know.

    python packages/lab/benchmarks/loads.py MODELS OUT [--arms ur5 panda ...] [--seed 0]

Each arm is trained on nine minutes without a load, with constants of its currents that are true, and again with ones
off by up to 10 %. Then it moves with 25 loads of 0.5 to 3 kg within 10 cm of its last joint's origin, two windows of 4
s each; with weights of 2.805 and 1.6 kg that are known, 40 s each; and with a constant force on its last link.
OUT/loads.md and OUT/loads.json get the tables. What is there is used again.
"""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import arguments, head, in_parallel, joined, table_row, trained, write_tables
from unseen.arms import Maker, makers, true_arm
from unseen.loads import FIRST_S, KNOWN_KG, TRAIN, WINDOW_S, WINDOWS, Carried, carried, write_carrying
from unseen.recordings import make_dataset, simulate_takes

from tauext._core import corrected_bundle
from tauext.bundle.bundle_file import load_bundle
from tauext.data.recording_file import load_recording
from tauext.errors import TauextError
from tauext.monitor.known_load import weigh_constants
from tauext.monitor.weighing import identify, load_frame, mass_error, see

KINDS = {"true": ["--fit-torque-constants", "False"], "off": []}
"""Torque constants, and what training is told: it corrects constants of currents unless they are given."""


def main() -> None:
    parser = arguments(__doc__, "models", "out", arms=("ur5", "panda", "kinova", "seven_axis"), seed=0)
    parser.add_argument("--true-only", nargs="*", default=[], help="of these, arms whose constants are never off")
    options = parser.parse_args()
    outcomes: list[Weighed] = []
    factors: dict[str, dict] = {}
    for name in options.arms:
        folder, maker = options.out / name, makers(options.models)[name]
        folder.mkdir(parents=True, exist_ok=True)
        settings = folder / "true.toml"
        settings.write_text("torque_share = 0.01\n")  # as of measured constants: magnets get warm
        takes = carried(maker, options.seed)
        simulate_takes(maker, options.seed, folder / "csv", TRAIN, os.cpu_count() or 1)
        in_parallel(os.cpu_count(), write_carrying, [(maker, options.seed, take, folder / "csv") for take in takes])
        for kind in ["true"] if name in options.true_only else KINDS:
            constants = true_arm(maker, maker.random(options.seed, 0)).nm_per_ampere
            constants = constants * (wrong_constants(maker, options.seed) if kind == "off" else 1.0)
            data = make_dataset(
                maker, options.seed, folder, TRAIN, name=f"data-{kind}", more={"test": list(takes)},
                constants=constants.tolist(),
            )  # fmt: skip
            stated = ["--config", settings] if kind == "true" else []
            bundle = trained(data, folder / f"{kind}.tauext", *KINDS[kind], *stated)
            outcomes += weigh(data, kind, bundle, maker, takes)
        if name not in options.true_only:
            factors[name], bundles = correct(folder, maker, options.seed)
            for kind, bundle in bundles.items():
                outcomes += weigh(folder / "data-off", f"off, {kind}", bundle, maker, takes)
    facts = {kind: figures([w for w in outcomes if w.kind == kind]) for kind in dict.fromkeys(w.kind for w in outcomes)}
    write_tables(options.out, tables(facts, factors), {"weighed": facts, "factors": factors}, "loads")


def wrong_constants(maker: Maker, seed: int) -> np.ndarray:
    """By which the ones given are off."""
    return maker.random(seed, 98).uniform(0.9, 1.1, len(maker.joints))


def weigh(data: Path, label: str, path: Path, maker: Maker, takes: dict[str, Carried]) -> list[Weighed]:
    """Every window of every load and push."""
    bundle, outcomes = load_bundle(path), []
    frame = load_frame(bundle, maker.joints[-1])
    for name, truth in takes.items():
        if name in KNOWN_KG:
            continue
        seen = see(bundle, load_recording(data / f"{name}.parquet"))
        for k in range(WINDOWS):
            begin, one = FIRST_S + k * WINDOW_S, (maker.name, label, truth)
            part = seen.part((seen.time_s >= begin) & (seen.time_s < begin + WINDOW_S))
            try:
                found = identify(bundle, frame, [part])
            except TauextError:
                outcomes.append(Weighed(*one, "refused"))
                continue
            off, error = (float(np.linalg.norm(v)) for v in (found.com_m - truth.com_m, found.com_error_m))
            stated = found.mass_kg, mass_error(found), off, error, found.constants_error_kg
            outcomes.append(Weighed(*one, found.verdict, *stated))
    return outcomes


def correct(folder: Path, maker: Maker, seed: int) -> tuple[dict, dict[str, Path]]:
    """The bundle whose constants are off after each known weight: the factors found, and the bundles by the weight."""
    bundle, path = load_bundle(folder / "off.tauext"), folder / "off.tauext"
    constants = np.array(bundle.observer.nm_per_unit or np.ones(bundle.joints))
    facts: dict = {"left": (1 / (wrong_constants(maker, seed) * constants)).tolist()}
    bundles = {}
    for name, kg in KNOWN_KG.items():
        motion = see(bundle, load_recording(folder / "data-off" / f"{name}.parquet"))
        try:
            known = weigh_constants(bundle, load_frame(bundle, maker.joints[-1]), [motion], kg)
        except TauextError as error:
            return facts | {"refused": str(error)}, bundles
        bundle = corrected_bundle(bundle, known)
        path = folder / f"off-{name}.tauext"
        bundle.save(str(path))
        bundles[name] = path
        told, settings = np.array(bundle.observer.nm_per_unit), bundle.wrench_settings
        facts[name] = {
            "common": float(np.median(told / constants)),
            "common_error": known.common_error,
            "joints": (told / settings.torque_factor / constants).tolist(),
            "errors": known.errors.tolist(),
            "shows": known.shows,
        }
    return facts, bundles


TITLES = {
    "true": "true constants",
    "off": "off by up to 10 %, as trained",
    "off, known": "then a known weight",
    "off, known-2": "then a second known weight",
}


@dataclass(frozen=True)
class Weighed:
    """One window."""

    arm: str
    kind: str
    truth: Carried
    verdict: str
    mass_kg: float = np.nan
    mass_error_kg: float = np.nan
    off_m: float = np.nan
    com_error_m: float = np.nan
    constants_error_kg: float = np.nan

    @property
    def within(self) -> tuple[float, float]:
        """Tolerances of mass [kg] and centre [m]."""
        return max(0.05 * self.truth.mass_kg, 0.1), 0.02 if self.truth.mass_kg >= 1.0 else 0.04

    @property
    def right(self) -> tuple[bool, bool]:
        """Mass, centre."""
        off = abs(self.mass_kg - self.truth.mass_kg), self.off_m
        return tuple(self.verdict == "load" and one <= most for one, most in zip(off, self.within, strict=True))

    @property
    def certain(self) -> tuple[bool, bool]:
        """Twice the reported standard error of the mass, and that of the centre, are within the tolerances."""
        reported = 2 * self.mass_error_kg, self.com_error_m
        return tuple(self.verdict == "load" and one <= most for one, most in zip(reported, self.within, strict=True))


def figures(of: Sequence[Weighed]) -> dict:
    """By arm, and of all."""
    groups = {arm: [w for w in of if w.arm == arm] for arm in dict.fromkeys(w.arm for w in of)}
    return {arm: row(some) for arm, some in (groups | {"all": of}).items()}


def row(of: Sequence[Weighed]) -> dict:
    """Figures of the loads among these."""
    loads = [w for w in of if w.truth.mass_kg > 0]
    seen = [w for w in loads if w.verdict == "load"]
    off = np.array([w.mass_kg - w.truth.mass_kg for w in seen])
    share = off / [w.truth.mass_kg for w in seen]
    right, certain = (np.array([getattr(w, name) for w in loads]) for name in ("right", "certain"))
    where = [right[certain[:, k], k] for k in range(2)]
    return {
        "windows": len(loads),
        "mass": float(right[:, 0].mean()),
        "com": float(right[:, 1].mean()),
        "both": float(right.all(axis=1).mean()),
        "mass_told": float(certain[:, 0].mean()),
        "mass_where_told": float(where[0].mean()) if len(where[0]) else None,
        "com_told": float(certain[:, 1].mean()),
        "com_where_told": float(where[1].mean()) if len(where[1]) else None,
        "mass_bias": float(np.median(share)),
        "mass_spread": float(np.quantile(np.abs(share - np.median(share)), 0.68)),
        "mass_rms": rms(share),
        "mass_rms_stated": rms([w.mass_error_kg / w.truth.mass_kg for w in seen]),
        "constants_rms_stated": rms([w.constants_error_kg / w.truth.mass_kg for w in seen]),
        "within_2_errors": float(np.mean(np.abs(off) <= 2 * np.array([w.mass_error_kg for w in seen]))),
        "verdicts": dict(Counter(w.verdict for w in loads)),
        "pushes": dict(Counter(w.verdict for w in of if w.truth.push_n > 0)),
    }


def rms(values: Sequence[float] | np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def tables(facts: dict, factors: dict[str, dict]) -> list[str]:
    """Masses and centres, verdicts, factors found with a known weight beside the true ones."""
    lines = head(
        "constants | arm | windows | mass | centre | both | mass certain | mass right where certain | centre certain "
        "| centre right where certain | mass error, median (68 %) | RMS | stated | of it constants "
        "| mass within two standard errors | loads | forces"
    )
    keys = ("mass", "com", "both", "mass_told", "mass_where_told", "com_told", "com_where_told")
    for kind, arms in facts.items():
        for arm, f in arms.items():
            shares = ["–" if f[key] is None else f"{f[key]:.1%}" for key in keys]
            off = [f"{f['mass_bias']:+.1%} (± {f['mass_spread']:.1%})"]
            off += [f"{f[key]:.1%}" for key in ("mass_rms", "mass_rms_stated", "constants_rms_stated")]
            off += [f"{f['within_2_errors']:.0%}"]
            counts = (", ".join(f"{n} {v}" for v, n in sorted(f[key].items())) for key in ("verdicts", "pushes"))
            lines.append(table_row(TITLES[kind], arm, f["windows"], *shares, *off, *counts))
    lines += ["", *head("arm | constants off by, joint by joint | after one known weight | after two")]
    for arm, f in factors.items():
        found = [
            " · ".join(f"{x:.3f} ± {e:.3f}" for x, e in zip(f[name]["joints"], f[name]["errors"], strict=True))
            if name in f
            else f"refused: {f['refused']}"
            for name in KNOWN_KG
        ]
        lines.append(table_row(arm, joined(f["left"], ".3f"), *found))
    return lines


if __name__ == "__main__":
    main()
