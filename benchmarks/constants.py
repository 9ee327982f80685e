"""Torque constants found in currents, and the masses and forces that follow: their errors against those reported.

    python benchmarks/constants.py MODELS OUT [--arms ur5 panda ...] [--seeds 30] [--trained 5] [--label after]

Every arm of a seed has masses off by up to 20 % from its robot file, centres of mass by up to 2 cm, and a tool of 0.5
to 1.5 kg that the file lacks (benchmarks/unseen/arms.py). Constants are fitted to two minutes of currents: `unknown`,
or `given` within 10 %. Of the first --trained seeds, bundles of recipe prior are trained, too; each weighs LOADS loads
and answers to PUSHES pushes on its last link, as trained and after `tauext load --known-kg` (`weighed`). OUT/LABEL.json
gets every value; OUT/README.md the tables of all labels there. The method was fixed on arms ur5 and panda.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common import arguments, head, table_row, write_page
from unseen.arms import Maker, TrueArm, direction, fresh_makers, makers, true_arm
from unseen.loads import FIRST_S, KNOWN_KG, KNOWN_S, WARM_S, WINDOW_S, Carried, with_load
from unseen.simulation import RATE_HZ, draw_motion, simulate, touched_point
from wrench import LOOK_S, logged, pushes_of

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.config import PAPER_CASES, ObserverConfig, TrainConfig
from tauext.data.recording import Recording
from tauext.data.servo import AMPERES, FROM_AMPERES
from tauext.errors import TauextError
from tauext.files.places import place_of
from tauext.fit.torque_constants import fit_torque_constants
from tauext.monitor import known_load
from tauext.monitor.weighing import identify, load_frame, see
from tauext.robot.load import load_tree
from tauext.train.preparation import Given
from tauext.train.stage import train_on_recordings

ARMS = ("ur5", "panda", "kinova", "seven_axis", "palletizer", "offset_wrist", "light_arm")
DEVELOPED_ON = ("ur5", "panda")
TRAIN_S = 120.0
LOADS, PUSHES = 4, 8
GIVEN_TO = 0.1
KINDS = ("unknown", "given")


def main() -> None:
    parser = arguments(__doc__, "models", "out")
    parser.add_argument("--arms", nargs="+", default=list(ARMS))
    parser.add_argument("--seeds", type=int, default=30, help="of constants, an arm")
    parser.add_argument("--trained", type=int, default=5, help="of these seeds, with masses and forces")
    parser.add_argument("--label", default="after", help="name of the values' file")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / f"{options.label}.json"
    rows: list[dict[str, Any]] = json.loads(path.read_text()) if path.exists() else []
    for name in options.arms:
        maker = (makers(options.models) | fresh_makers())[name]
        for seed in range(options.seeds):
            done = {(row["arm"], row["seed"]) for row in rows}
            if (name, seed) in done:
                continue
            rows += of_arm(maker, seed, seed < options.trained)
            path.write_text("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n")
    write_page(options.out / "README.md", markdown(options))


def of_arm(maker: Maker, seed: int, trained: bool) -> Iterator[dict[str, Any]]:
    """A row a constant, a mass and a force: what, its relative error, and the standard error reported."""
    arm, tree = true_arm(maker, maker.random(seed, 0)), load_tree(maker.model, maker.joints)
    wrong = maker.random(seed, 800).uniform(1 - GIVEN_TO, 1 + GIVEN_TO, len(maker.joints))
    moved = recorded(maker, arm, TRAIN_S, 0.0, maker.random(seed, 801))
    for kind in KINDS:
        about = {"arm": maker.name, "seed": seed, "constants": kind}
        training = as_given(moved, arm, kind, wrong)
        found = fit_torque_constants(tree, [training], ObserverConfig(), kind == "given")
        true = arm.nm_per_ampere if kind == "unknown" else 1 / wrong
        shares = np.hypot(found.standard_errors / np.abs(found.nm_per_unit), getattr(found, "common_share", 0.0))
        for off, share in zip(np.log(np.abs(found.nm_per_unit) / true), shares, strict=True):
            yield about | {"what": "constant", "off": float(off), "error": float(share)}
        if trained:
            with tempfile.TemporaryDirectory() as folder:
                out = place_of(Path(folder) / "arm.tauext")
                given = Given(maker.model, PAPER_CASES["exact"], [training], [], model=tree)
                train_on_recordings(given, TrainConfig(recipe="prior"), out)
                bundle = load_bundle(out)
            yield from used(maker, arm, seed, bundle, about, wrong)


def used(
    maker: Maker, arm: TrueArm, seed: int, bundle: _core.Bundle, about: dict[str, Any], wrong: np.ndarray
) -> Iterator[dict[str, Any]]:
    """Masses and forces of a bundle, as trained, and after a known weight."""
    kind, rng = about["constants"], maker.random(seed, 802)
    frame = load_frame(bundle, maker.joints[-1])
    loaded = []
    for k in range(LOADS + 1):
        known = k == LOADS
        what = Carried(KNOWN_KG if known else rng.uniform(0.5, 3.0), tuple((direction(rng) * 0.06).tolist()))
        seconds = KNOWN_S if known else FIRST_S + WINDOW_S + 0.1
        carrying = replace(arm, tree=with_load(arm, what))
        try:
            loaded.append((what, as_given(recorded(maker, carrying, seconds, WARM_S, rng), arm, kind, wrong)))
        except RuntimeError:  # a heavy load far out may shake an arm whose drive does not expect it
            continue
    told = wrong * arm.nm_per_ampere if kind == "given" else np.ones(len(wrong))
    pushes = pushes_of(maker, arm, PUSHES, told, maker.random(seed, 803), WARM_S)
    yield from weights(bundle, frame, loaded, about)
    yield from forces(bundle, arm, pushes, about)
    weight = [recording for what, recording in loaded if what.mass_kg == KNOWN_KG]
    try:
        known = known_load.weigh_constants(bundle, frame, [see(bundle, one) for one in weight], KNOWN_KG)
    except (TauextError, IndexError):
        return
    right = getattr(known_load, "corrected_bundle", lambda one, found: known_load.scaled_bundle(one, found.common))
    weighed = right(bundle, known)
    about = about | {"constants": f"{kind}, weighed"}
    yield from weights(weighed, frame, loaded, about)
    yield from forces(weighed, arm, pushes, about)


def weights(bundle: _core.Bundle, frame, loaded: list, about: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """A row a load."""
    for what, recording in loaded:
        if what.mass_kg == KNOWN_KG:
            continue
        found = identify(bundle, frame, [see(bundle, recording)])
        if found.verdict == "load" and found.mass_seen:
            error = np.hypot(found.mass_error_kg, getattr(found, "constants_error_kg", 0.0))
            off = np.array([found.mass_kg / what.mass_kg - 1, error / what.mass_kg]).tolist()
            yield about | {"what": "mass", "off": off[0], "error": off[1]}
            off_m = found.com_m - np.array(what.com_m)
            for axis in range(3):
                yield about | {"what": "centre", "off": float(off_m[axis]), "error": float(found.com_error_m[axis])}


def forces(bundle: _core.Bundle, arm: TrueArm, pushes: tuple, about: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """A row a push: the force along its true direction, of a force at its known point."""
    contacts, signals = pushes
    said, model = _core.estimate(bundle, *signals, 1), _core.WrenchModel(bundle)
    if model.refused:
        return
    t_ns, q, dq, _ = signals
    for contact in contacts:
        at = int(np.searchsorted(t_ns, round((contact.start_s + LOOK_S) * 1e9)))
        sample = (q[at : at + 1], *(said[name][at : at + 1] for name in ("tau_ext", "sigma_nm")))
        joint, point = bundle.links[contact.link].joint_name, touched_point(arm.tree, contact).tolist()
        sigma, speed = said["contact_sigma_nm"][at : at + 1], dq[at : at + 1]
        found = {k: v[0] for k, v in model.wrenches(joint, *sample, point, contact_sigma_nm=sigma, dq=speed).items()}
        if not np.isfinite(found["force"]).all() or found["blind"]:
            continue
        way = np.array(contact.direction)
        off, error = found["force"] @ way - contact.peak_n, np.sqrt(way @ found["covariance"] @ way)
        yield about | {"what": "force", "off": float(off / contact.peak_n), "error": float(error / contact.peak_n)}


def recorded(maker: Maker, arm: TrueArm, seconds: float, warm_s: float, rng: np.random.Generator) -> Recording:
    """The currents of an arm in motion of its own."""
    setpoints = draw_motion(maker, round(seconds * RATE_HZ), RATE_HZ, rng)
    run = simulate(arm, load_tree(maker.model, maker.joints), setpoints, maker.torque_nm, [], warm_s)
    t_ns, q, dq, ampere = logged(maker, arm, run, np.ones(len(maker.joints)), rng)
    return Recording(
        name="motion", joints=maker.joints, t_ns=t_ns, q=q, dq=dq, tau=ampere, rate_hz=maker.rate_hz,
        torque_timing="instant", source="simulated", robot_sha256="", provenance={"torque": AMPERES},
    )  # fmt: skip


def as_given(recording: Recording, arm: TrueArm, kind: str, wrong: np.ndarray) -> Recording:
    """The recording as an import has it: in amperes, or in N m by constants that are wrong by these factors."""
    if kind == "unknown":
        return recording
    return replace(recording, tau=recording.tau * arm.nm_per_ampere * wrong, provenance={"torque": FROM_AMPERES})


def markdown(options: argparse.Namespace) -> str:
    """The tables of all labels."""
    labels = {path.stem: json.loads(path.read_text()) for path in sorted(options.out.glob("*.json"), reverse=True)}
    text = f"""# Errors of torque constants, masses and forces

Written by `python benchmarks/constants.py MODELS OUT`; values: {", ".join(f"[{k}.json]({k}.json)" for k in labels)}.

Simulated arms of [unseen arms](../unseen-arms/README.md), another one a seed: masses off by up to 20 % from the robot
file, centres of mass by up to 2 cm, and a tool that the file lacks. Two minutes of currents determine the constants.

- `unknown`: no constant is given; `given`: constants right within {GIVEN_TO:.0%}, which training corrects; `weighed`:
  after `tauext load --known-kg {KNOWN_KG}`.
- Masses: loads of 0.5 to 3 kg, a window of {WINDOW_S:g} s. Forces: along the true direction of a push of 20 to 45 N at
  a known point of the last link; pushes with a blind direction are left out. Centres are in mm.
- *Error*: RMS of value / truth - 1 (of the logarithm for constants). *Reported*: RMS of the standard error reported.
  *Within two*: share of errors within two reported standard errors; 95 % for normal errors that are known exactly.

The method was fixed on the arms {" and ".join(DEVELOPED_ON)}; the others were run once.

{chr(10).join(head(COLUMNS))}
"""
    groups = {"developed on": DEVELOPED_ON, "run once": tuple(set(ARMS) - set(DEVELOPED_ON))}
    for what in ("constant", "mass", "centre", "force"):
        for kind in dict.fromkeys(row["constants"] for rows in labels.values() for row in rows):
            for group, arms in groups.items():
                for label, rows in labels.items():
                    some = [
                        row for row in rows
                        if row["what"] == what and row["constants"] == kind and row["arm"] in arms
                    ]  # fmt: skip
                    if some:
                        text += line(what, kind, group, label, some) + "\n"
    text += f"\nEvery arm, as trained without constants:\n\n{chr(10).join(head(COLUMNS.replace('arms', 'arm')))}\n"
    for what in ("constant", "mass", "force"):
        for arm in ARMS:
            for label, rows in labels.items():
                some = [row for row in rows if (row["what"], row["constants"], row["arm"]) == (what, "unknown", arm)]
                if some:
                    text += line(what, "unknown", arm, label, some) + "\n"
    return text


COLUMNS = "of | constants | arms | | number | error | reported | reported / error | within two"


def line(what: str, kind: str, group: str, label: str, rows: list[dict[str, Any]]) -> str:
    """A row of a table."""
    off, error = (np.array([row[name] for row in rows], dtype=float) for name in ("off", "error"))
    error = np.where(np.isfinite(error), error, 10.0)
    used = error < 0.5 if what == "constant" else np.ones(len(off), bool)
    off, error = off[used], error[used]
    rms, said = (float(np.sqrt(np.mean(np.square(one)))) for one in (off, error))
    text = (lambda x: f"{1e3 * x:.1f} mm") if what == "centre" else (lambda x: f"{x:.1%}")
    inside = float(np.mean(np.abs(off) <= 2 * error))
    return table_row(what, kind, group, label, len(off), text(rms), text(said), f"{said / rms:.2f}", f"{inside:.0%}")


if __name__ == "__main__":
    main()
