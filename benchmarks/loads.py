"""What arms carry, weighed by their own joints: arms of the trial on unseen arms, with loads that they do not know.

    python benchmarks/loads.py MODELS OUT [--arms ur5 panda ... rig] [--seed 0]

Each arm, and the virtual rig, is trained on nine minutes without a load, with constants of its currents that are true,
and again with ones off by up to 10 %. Then it moves with 25 loads of 0.5 to 3 kg within 10 cm of its last joint's
origin (the rig: of its tip), two windows of 4 s each; with a weight of 2.805 kg that is known; and with a constant
force on its last link. OUT/README.md and OUT/loads.json get the tables; those of docs/results/loads are of this
command. What is there is used again.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import mujoco
import numpy as np
from common import arguments, head, in_parallel, joined, table_row, trained, write_page
from unseen.arms import Maker, makers, true_arm, with_ball
from unseen.loads import (
    FARTHEST_M,
    FIRST_S,
    KNOWN_KG,
    KNOWN_S,
    LOADS,
    PUSHES,
    TRAIN,
    WINDOW_S,
    WINDOWS,
    Carried,
    carried,
    write_carrying,
)
from unseen.recordings import description, import_csv, simulate_takes

from tauext import Bundle, _core
from tauext.bundle.bundle_file import load_bundle
from tauext.data.dataset import Split, save_split
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording, save_recording
from tauext.data.servo import FROM_AMPERES
from tauext.errors import TauextError
from tauext.monitor.known_load import corrected_bundle, weigh_constants
from tauext.monitor.weighing import LoadEstimate, NamedFrame, identify, load_frame, mass_error, see
from tauext.sim.collect import SETTLE_S
from tauext.sim.config import RigConfig
from tauext.sim.rig import arm_xml, build_scene, draw_motion, joint_names, measure, roll_out

RIG = "rig"
WRONG = 0.1
KINDS = {"true": ["--fit-torque-constants", "False"], "off": []}
"""Torque constants, and the ones given to training; training corrects constants of currents unless they are given."""
TRUE_TO = 0.01
"""Standard error that is stated of the true ones, as of measured constants: magnets get warm."""


@dataclass(frozen=True)
class Subject:
    """An arm, and what is known of it when it is weighed with."""

    name: str
    carried: dict[str, Carried]
    wrong: np.ndarray
    """Where constants are off: those that are believed over the true ones."""
    frame: Callable[[Bundle], NamedFrame]
    axes: tuple[int, ...] = (0, 1, 2)
    """Along which its motion can tell a centre of mass."""


def main() -> None:
    parser = arguments(__doc__, "models", "out")
    parser.add_argument("--arms", nargs="+", default=["ur5", "panda", "kinova", "seven_axis", RIG])
    parser.add_argument("--true-only", nargs="*", default=[], help="of these, arms whose constants are never off")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    outcomes: list[Weighed] = []
    factors: dict[str, dict] = {}
    for name in options.arms:
        folder = options.out / name
        kinds = ["true"] if name in options.true_only else list(KINDS)
        known = None if name == RIG else makers(options.models)[name]
        settings = folder / "true.toml"
        folder.mkdir(parents=True, exist_ok=True)
        settings.write_text(f"torque_share = {TRUE_TO}\n")
        subject = an_arm(known, folder, options.seed, kinds) if known else the_rig(folder, options.seed)
        for kind in kinds:
            stated = ["--config", settings] if kind == "true" else []
            trained(folder / f"data-{kind}", folder / f"{kind}.tauext", *KINDS[kind], *stated)
            outcomes += weigh(folder, kind, folder / f"{kind}.tauext", subject)
        if name in options.true_only:
            continue
        factors[name] = correct(folder, subject)
        for kind in ("common", "joints"):
            if (folder / f"off-{kind}.tauext").exists():
                outcomes += weigh(folder, f"off, {kind}", folder / f"off-{kind}.tauext", subject)
    facts = summary(outcomes) | {"factors": factors}
    (options.out / "loads.json").write_text(json.dumps(facts, indent=1) + "\n")
    asked = f"python benchmarks/loads.py MODELS OUT --arms {' '.join(options.arms)}"
    asked += f" --true-only {' '.join(options.true_only)}" if options.true_only else ""
    write_page(options.out / "README.md", markdown(outcomes, factors, asked))


def an_arm(maker: Maker, folder: Path, seed: int, kinds: list[str]) -> Subject:
    """One of the trial on unseen arms; its recordings and datasets are made where they are not there."""
    takes = carried(maker, seed)
    simulate_all(maker, folder, seed, list(takes))
    for kind in kinds:
        dataset(maker, folder, seed, kind, folder / f"data-{kind}", list(takes))
    return Subject(maker.name, takes, wrong_constants(maker, seed), lambda bundle: load_frame(bundle, maker.joints[-1]))


def the_rig(folder: Path, seed: int) -> Subject:
    """The virtual rig, whose recordings hold torques; believed constants scale them."""
    wrong = np.random.default_rng([seed, 98]).uniform(1 - WRONG, 1 + WRONG, len(RigConfig().links))
    make_rig(folder, seed, {"true": np.ones_like(wrong), "off": wrong})
    return Subject(RIG, rig_carried(seed), wrong, lambda _: tip(), PLANE)


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


def weigh(folder: Path, label: str, path: Path, subject: Subject) -> list[Weighed]:
    """Every window of every load and push."""
    bundle = load_bundle(path)
    frame = subject.frame(bundle)
    data = folder / f"data-{label.split(',')[0]}"
    outcomes = []
    for name, truth in subject.carried.items():
        if name == "known":
            continue
        seen = see(bundle, load_recording(data / f"{name}.parquet"))
        for k in range(WINDOWS):
            begin = FIRST_S + k * WINDOW_S
            part = seen.part((seen.time_s >= begin) & (seen.time_s < begin + WINDOW_S))
            try:
                found = identify(bundle, frame, [part])
            except TauextError:
                outcomes.append(Weighed.refused(subject.name, label, name, truth))
                continue
            outcomes.append(Weighed.of(subject.name, label, name, truth, found, subject.axes))
    return outcomes


def correct(folder: Path, subject: Subject) -> dict:
    """The known weight on the arm whose constants are off: the common factor put into the bundle, and those of every
    joint into a new training."""
    bundle = load_bundle(folder / "off.tauext")
    recording = load_recording(folder / "data-off" / "known.parquet")
    constants = np.array(bundle.observer.nm_per_unit or np.ones(bundle.joints))
    facts: dict = {"left": (1 / (subject.wrong * constants)).tolist()}
    try:
        known = weigh_constants(bundle, subject.frame(bundle), [see(bundle, recording)], KNOWN_KG)
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
        "shows": known.shows.tolist(),
    }


# --- The virtual rig with something at its tip.


PLANE = (0, 2)
"""Axes of the tip's frame in which the arm moves: nothing tells where a load is across them."""
MJCF_AXES = (1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0)
"""Of the robot file's body in the frame of its link, z of which is along the joint's axis, +y: row by row."""
SIDEWAYS = 0.3
"""Most of a push's direction that is along gravity: that would be a load."""


def tip() -> NamedFrame:
    """The end of the last link, axes as in the robot file."""
    links = RigConfig().links
    return NamedFrame(_core.LoadFrame(len(links) - 1, list(MJCF_AXES), [0.0, -links[-1].length_m, 0.0]), "the tip")


def rig_carried(seed: int) -> dict[str, Carried]:
    """As `carried` of the other arms, in the tip's frame; centres and forces lie in the plane of motion."""
    rng = np.random.default_rng([seed, 500])
    takes = {}
    for k in range(LOADS):
        com = in_plane(rng) * rng.uniform(0, FARTHEST_M)
        mass, radius = float(rng.uniform(0.5, 3.0)), float(rng.uniform(0.02, 0.06))
        takes[f"load-{k:02d}"] = Carried(mass, tuple(com.tolist()), radius)
    takes["known"] = Carried(KNOWN_KG, tuple((in_plane(rng) * 0.06).tolist()))
    for k in range(PUSHES):
        across = np.array([rng.choice([-1.0, 1.0]), 0.0, rng.uniform(-SIDEWAYS, SIDEWAYS)])
        across /= np.linalg.norm(across)
        takes[f"push-{k}"] = Carried(0.0, (0.0, 0.0, 0.0), 0.0, float(rng.uniform(10, 40)), tuple(across.tolist()))
    return takes


def in_plane(rng: np.random.Generator) -> np.ndarray:
    x, z = rng.standard_normal(2)
    return np.array([x, 0.0, z]) / np.hypot(x, z)


def make_rig(folder: Path, seed: int, wrong: dict[str, np.ndarray]) -> None:
    """Write a dataset for each kind of constants, its torques times what the constants are wrong by."""
    carried = rig_carried(seed)
    takes: dict[str, tuple[float, Carried | None]] = {take.name: (60 * take.minutes, None) for take in TRAIN}
    for name, what in carried.items():
        takes[name] = (KNOWN_S if name == "known" else FIRST_S + WINDOWS * WINDOW_S + 0.1, what)
    missing = [kind for kind in wrong if not (folder / f"data-{kind}" / "split.json").exists()]
    if not missing:
        return
    (folder / "csv").mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor() as pool:
        made = list(pool.map(lambda k: record(seed, k, *takes[list(takes)[k]]), range(len(takes))))
    for kind in missing:
        data = folder / f"data-{kind}"
        data.mkdir(parents=True, exist_ok=True)
        robot = arm_xml(RigConfig())
        (data / "robot.xml").write_text(robot)
        for name, signals in zip(takes, made, strict=True):
            save_recording(as_recording(name, signals, wrong[kind], robot), data / f"{name}.parquet")
        train = tuple(f"{take.name}.parquet" for take in TRAIN)
        save_split(Split(train, (), tuple(f"{name}.parquet" for name in carried)), data)
    for name, what in carried.items():
        (folder / "csv" / f"{name}.truth.json").write_text(json.dumps(asdict(what)) + "\n")


def record(seed: int, number: int, seconds: float, what: Carried | None) -> dict[str, np.ndarray]:
    """Measured signals of the rig on a motion of its own, with what it carries or what pushes its tip."""
    config = RigConfig()
    moving, measuring = (np.random.default_rng([seed, 600, number, k]) for k in range(2))
    settle = round(SETTLE_S * config.rate_hz)
    q_des, dq_des = draw_motion(
        config.motion, len(config.links), settle + round(seconds * config.rate_hz), config.rate_hz, moving
    )
    scene = build_scene(config, "pulses")
    if what is not None and what.mass_kg > 0:
        add_load(scene, config, what)
    push = np.zeros((len(q_des), 3 * len(config.links)))
    if what is not None and what.push_n > 0:
        push[:, -3:] = wrench_at_tip(config, q_des, what)
    drives = np.stack([q_des, dq_des], axis=2).reshape(len(q_des), -1)
    truth = roll_out(config, scene, q_des[0], np.hstack([drives, push])).after(settle)
    return measure(config, truth, np.zeros_like(truth.q), measuring)


def add_load(scene: mujoco.MjModel, config: RigConfig, what: Carried) -> None:
    """Fix a ball to the last link."""
    body = scene.body(f"link{len(config.links)}").id
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, scene.body_iquat[body])
    own_m, mass_kg, load_kg = scene.body_ipos[body].copy(), float(scene.body_mass[body]), what.mass_kg
    load_m = np.array(what.com_m) + [0.0, 0.0, config.links[-1].length_m]
    inertia = turn.reshape(3, 3) @ np.diag(scene.body_inertia[body]) @ turn.reshape(3, 3).T
    both_kg, both_m, inertia = with_ball(mass_kg, own_m, inertia, load_kg, load_m, what.radius_m)
    sizes, axes = np.linalg.eigh(inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, axes.ravel())
    scene.body_mass[body], scene.body_ipos[body] = both_kg, both_m
    scene.body_inertia[body], scene.body_iquat[body] = sizes, quat
    mujoco.mj_setConst(scene, mujoco.MjData(scene))


def wrench_at_tip(config: RigConfig, q_des: np.ndarray, what: Carried) -> np.ndarray:
    """Of a force along a direction of the base: fx, fz and torque about +y in the last link's frame, (samples, 3).

    The drives keep the arm within milliradians of its setpoints, so these turn the force.
    """
    angle = q_des.sum(axis=1)
    x, z = what.push_n * what.direction[0], what.push_n * what.direction[2]
    along_x, along_z = np.cos(angle) * x - np.sin(angle) * z, np.sin(angle) * x + np.cos(angle) * z
    return np.stack([along_x, along_z, config.links[-1].length_m * along_x], axis=1)


def as_recording(name: str, signals: dict[str, np.ndarray], wrong: np.ndarray, robot: str) -> Recording:
    """With torques as a controller logs them that believes in wrong constants."""
    config = RigConfig()
    samples = len(signals["q"])
    return Recording(
        name=name,
        joints=tuple(joint_names(config)),
        t_ns=np.arange(samples, dtype=np.int64) * round(1e9 / config.rate_hz),
        q=signals["q"],
        dq=signals["dq"],
        tau=signals["tau"] * wrong,
        contact=np.zeros(samples, dtype=np.int8),
        rate_hz=float(config.rate_hz),
        torque_timing="held",
        source=f"virtual rig {config.name}",
        robot_sha256=hashlib.sha256(robot.encode()).hexdigest(),
        provenance={"torque": FROM_AMPERES},
    )


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
    def of(
        cls, arm: str, kind: str, recording: str, truth: Carried, found: LoadEstimate, axes: Sequence[int] = (0, 1, 2)
    ) -> Weighed:
        """Axes: those of the load frame along which the arm's motion shows a centre of mass."""
        off = float(np.linalg.norm((found.com_m - truth.com_m)[list(axes)]))
        error = float(np.linalg.norm(found.com_error_m[list(axes)]))
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


def markdown(outcomes: Sequence[Weighed], factors: dict[str, dict], command: str) -> str:
    """The page."""
    facts = summary(outcomes)["weighed"]
    lines = [
        "# Weighing loads",
        "",
        f"Written by `{command}`. Every figure is in",
        "[loads.json](loads.json).",
        "",
        "Simulated arms of [unseen arms](../unseen-arms/README.md): a wrong model, friction that depends on history,",
        "load and temperature, and motor currents as torques. Training: nine minutes of motion without a load. Test:",
        "25 loads an arm of 0.5 to 3 kg, within 10 cm of the last joint's origin, two windows of 4 s each, in any",
        "motion, pauses and creep included.",
        "",
        "A mass is right within 5 % or 0.1 kg, whichever is larger. A centre of mass is right within 2 cm for loads",
        "of 1 kg or more and within 4 cm below. A mass is *certain* if twice its reported standard error is within",
        "that tolerance; a centre is certain if its reported standard error is.",
        "",
        "The [virtual rig](../../paper.md) has two joints, a correct model and measured torques that wrong constants",
        "scale. Its loads are within 10 cm of the tip, in the plane of motion. The motion does not show the centre",
        "across that plane, so centres are judged in the plane.",
        "",
        *head(
            "constants | arm | windows | mass | centre | both | mass certain | mass right where certain "
            "| centre certain | centre right where certain | mass error, median (68 %) "
            "| mass within two standard errors"
        ),
    ]
    for kind, arms in facts.items():
        for arm, f in arms.items():
            mass, where = ("–" if f[key] is None else f"{f[key]:.0%}" for key in ("mass_where_told", "com_where_told"))
            name = f"**{arm}**" if arm == "all" else arm
            shares = [f"{f[key]:.1%}" for key in ("mass", "com", "both")]
            told = [f"{f['mass_told']:.0%}", mass, f"{f['com_told']:.0%}", where]
            off = [f"{f['mass_bias']:+.1%} (± {f['mass_spread']:.1%})", f"{f['within_2_errors']:.0%}"]
            lines.append(table_row(TITLES[kind], name, f["windows"], *shares, *told, *off))
    lines += ["", "Verdicts for windows with loads, and for constant forces of 10 to 40 N across gravity:", ""]
    lines += head("constants | arm | loads | forces")
    for kind, arms in facts.items():
        for arm, f in arms.items():
            counts = (", ".join(f"{n} {v}" for v, n in sorted(f[key].items())) for key in ("verdicts", "pushes"))
            lines.append(table_row(TITLES[kind], arm, *counts))
    lines += ["", *factor_lines(factors)]
    return "\n".join(lines) + "\n"


def factor_lines(factors: dict[str, dict]) -> list[str]:
    """Factors found with a known weight, and the true ones."""
    lines = [
        "True factors of the trained arm's torques, and factors found with a known 2.805 kg in 40 s of motion:",
        "",
        *head("arm | true | one factor | joint by joint (in brackets: the common factor)"),
    ]
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
