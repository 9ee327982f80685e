"""Torque constants found in currents, and the masses and forces that follow: their errors against those reported.

    python benchmarks/constants.py MODELS OUT [--arms ur5 panda ...] [--seeds 6] [--trained 2] [--label after]

Every arm of a seed has masses off by up to 20 % from its robot file and centres of mass by up to 2 cm, and a tool of
0.5 to 1.5 kg (benchmarks/unseen/arms.py). Constants are fitted to two minutes of currents: `unknown`, `given` within
10 %, or `tool missing`: unknown, and the file lacks the tool. Of the first --trained seeds, bundles of recipe prior are
trained, too; each weighs LOADS loads and answers to PUSHES pushes on its last link, as trained and after `tauext load
--known-kg` (`weighed`). OUT/LABEL.json gets every value, OUT/constants.json and .md the tables of all labels.
The method was fixed on arms ur5 and panda.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common import arguments, head, save_json, table_row, write_tables
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
from tauext.fit.torque_constants import ConstantsConfig, fit_torque_constants
from tauext.monitor.known_load import weigh_constants
from tauext.monitor.weighing import identify, load_frame, see
from tauext.robot.inertial import inertial_parameters, with_inertial_parameters
from tauext.robot.read import load_tree
from tauext.train.preparation import TrainingInput
from tauext.train.stage import train_on_recordings

ARMS = ("ur5", "panda", "kinova", "seven_axis", "palletizer", "offset_wrist", "light_arm")
DEVELOPED_ON = ("ur5", "panda")
TRAIN_S = 120.0
LOADS, PUSHES = 4, 8
GIVEN_TO = 0.1
KINDS = ("unknown", "given", "tool missing")
WHATS = ("constant", "mass", "centre", "force")
LABELS = ("before", "after")
"""`before`: errors by the curvature of the evidence and 5 % common to all; masses without the constants'.
`after`: errors of the constants contain those of the robot file, and masses those of the constants."""


def main() -> None:
    parser = arguments(__doc__, "models", "out", arms=ARMS)
    parser.add_argument("--seeds", type=int, default=6, help="of constants, an arm")
    parser.add_argument("--trained", type=int, default=2, help="of these seeds, with masses and forces")
    parser.add_argument("--label", default="after", choices=LABELS, help="of the code that runs")
    options = parser.parse_args()
    path = options.out / f"{options.label}.json"
    rows: list[dict[str, Any]] = json.loads(path.read_text()) if path.exists() else []
    for name in options.arms:
        maker = (makers(options.models) | fresh_makers())[name]
        for seed in range(options.seeds):
            done = {(row["arm"], row["seed"]) for row in rows}
            if (name, seed) in done:
                continue
            rows += of_arm(maker, seed, seed < options.trained)
            save_json(rows, path)
    labels = {
        label: json.loads(path.read_text()) for label in LABELS if (path := options.out / f"{label}.json").exists()
    }
    lines = summary(labels)
    write_tables(options.out, tables(lines), lines, "constants")


def of_arm(maker: Maker, seed: int, trained: bool) -> Iterator[dict[str, Any]]:
    """A row a constant, a mass and a force: what, its relative error, and the standard error reported."""
    arm, bare = true_arm(maker, maker.random(seed, 0)), load_tree(maker.model, maker.joints)
    tree = with_tool(maker, seed, arm, bare)
    wrong = maker.random(seed, 800).uniform(1 - GIVEN_TO, 1 + GIVEN_TO, len(maker.joints))
    moved = recorded(maker, arm, TRAIN_S, 0.0, maker.random(seed, 801))
    for kind in KINDS:
        about = {"arm": maker.name, "seed": seed, "constants": kind}
        training = as_given(moved, arm, kind, wrong)
        model = bare if kind == "tool missing" else tree
        found = fit_torque_constants(model, [training], ObserverConfig(), kind == "given")
        true = 1 / wrong if kind == "given" else arm.nm_per_ampere
        shares = np.hypot(found.standard_errors / np.abs(found.nm_per_unit), getattr(found, "common_share", 0.0))
        for off, share in zip(np.log(np.abs(found.nm_per_unit) / true), shares, strict=True):
            yield about | {"what": "constant", "off": float(off), "error": float(share)}
        if trained and kind != "tool missing":
            with tempfile.TemporaryDirectory() as folder:
                out = Path(folder) / "arm.tauext"
                given = TrainingInput(maker.model, PAPER_CASES["exact"], [training], [], model=tree)
                train_on_recordings(given, TrainConfig(recipe="prior"), out)
                bundle = load_bundle(out)
            yield from used(maker, arm, seed, bundle, about, wrong)


def with_tool(maker: Maker, seed: int, arm: TrueArm, bare: _core.Tree) -> _core.Tree:
    """The file's tree with the arm's tool."""
    without = true_arm(maker, maker.random(seed, 0), tool=False).tree.links[-1]
    tool = inertial_parameters(arm.tree.links[-1])[:10] - inertial_parameters(without)[:10]
    links = bare.links
    links[-1] = with_inertial_parameters(links[-1], inertial_parameters(links[-1]) + np.r_[tool, 0.0])
    return _core.Tree(links, bare.gravity)


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
        known = weigh_constants(bundle, frame, [see(bundle, one) for one in weight], KNOWN_KG)
    except (TauextError, IndexError):
        return
    weighed = _core.corrected_bundle(bundle, known)
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
    if kind != "given":
        return recording
    return replace(recording, tau=recording.tau * arm.nm_per_ampere * wrong, provenance={"torque": FROM_AMPERES})


COLUMNS = "of | constants | arms | | number | error | reported | reported / error | within two"
GROUPS = {"developed on": DEVELOPED_ON, "run once": tuple(arm for arm in ARMS if arm not in DEVELOPED_ON)}


def summary(labels: dict[str, list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """A line of the tables each: by kind of constants and group of arms, then by arm."""
    kinds = dict.fromkeys(row["constants"] for rows in labels.values() for row in rows)
    asked = [(what, kind, group) for what in WHATS for kind in kinds for group in GROUPS]
    asked += [(what, "unknown", arm) for what in WHATS for arm in ARMS]
    lines = []
    for what, kind, group in asked:
        for label, rows in labels.items():
            arms = GROUPS.get(group, (group,))
            some = [one for one in rows if (one["what"], one["constants"]) == (what, kind) and one["arm"] in arms]
            if some:
                lines.append({"of": what, "constants": kind, "arms": group, "label": label} | figures(what, some))
    return lines


def figures(what: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """RMS of errors and of reported standard errors, and the share within two of them.

    Constants that are no better than a guess are left out: they are not used as N m.
    """
    off, error = (np.array([np.nan if row[name] is None else row[name] for row in rows]) for name in ("off", "error"))
    used = error < ConstantsConfig.guess if what == "constant" else np.isfinite(error)
    off, error = off[used], error[used]
    rms, said = (float(np.sqrt(np.mean(np.square(one)))) for one in (off, error))
    return {
        "number": len(off),
        "error": rms,
        "reported": said,
        "reported_over_error": said / rms,
        "within_two": float(np.mean(np.abs(off) <= 2 * error)),
    }


def tables(lines: list[dict[str, Any]]) -> list[str]:
    """By group of arms, then by arm as trained without constants."""
    by_group, by_arm = ([table_line(one) for one in lines if (one["arms"] in GROUPS) == grouped] for grouped in (1, 0))
    return [*head(COLUMNS), *by_group, "", *head(COLUMNS.replace("arms", "arm")), *by_arm]


def table_line(of: dict[str, Any]) -> str:
    """A row of a table."""
    error, said = (f"{1e3 * of[k]:.1f} mm" if of["of"] == "centre" else f"{of[k]:.1%}" for k in ("error", "reported"))
    cells = (of["of"], of["constants"], of["arms"], of["label"], of["number"], error, said)
    return table_row(*cells, f"{of['reported_over_error']:.2f}", f"{of['within_two']:.0%}")


if __name__ == "__main__":
    main()
