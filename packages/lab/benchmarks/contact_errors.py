"""How far tau_ext is from the truth in free motion, during a contact and after it, beside its standard error.

    python packages/lab/benchmarks/contact_errors.py OUT [--arms rig seven ...] [--draws 6] [--unseen UNSEEN/ARM ...]

Simulated arms move, are grabbed at a random point of a random link, stop at the collision alarm, are pulled back and
forth for 1 to 10 s, released, stand, and move on. Bundles are trained briefly (recipe prior, exact model). UNSEEN/ARM:
what unseen_arms.py made: arms with a wrong URDF and motor currents, hit and pushed while they move; their
urdf-prior.tauext is judged. OUT gets bundles, draws, contact_errors.json and .md; what is there is used again, so that
another version judges the same draws.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import arguments, estimates, head, in_parallel, rms, short, table_row, write_tables
from tauext_lab.sim.arms import ARMS, GearedArm
from tauext_lab.sim.collect import SETTLE_S
from tauext_lab.sim.plant import Mover, Plant
from tauext_lab.sim.rig import draw_motion, measure, roll_out

from tauext import _core
from tauext.config import PAPER_CASES, AlarmConfig, PriorConfig, TrainConfig
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording
from tauext.files.atomic_write import atomic_write
from tauext.robot.model_case import estimated_model
from tauext.train.preparation import TrainingInput
from tauext.train.stage import train_on_recordings

# --- Free motion to train on, and a hand that pulls.


def prior_recipe(ripples: int) -> TrainConfig:
    little_reserve = AlarmConfig(friction_reserve=0.1)
    return TrainConfig(recipe="prior", alarm=little_reserve, prior=PriorConfig(most_ripples=ripples))


PRACTICE = {"rig": (8, prior_recipe(2)), "seven": (6, prior_recipe(0))}
"""By arm: minutes to train on; a search for ripples in seven joints would take longer than everything else."""


def practice_recording(arm: GearedArm, seconds: float, seed: int, number: int) -> Recording:
    """Recording `number` of the arm's free motion around its home; the same arguments give the same samples."""
    moving, measuring = (np.random.default_rng(s) for s in np.random.SeedSequence(seed, spawn_key=(number,)).spawn(2))
    settle, samples = round(SETTLE_S * arm.rate_hz), round(seconds * arm.rate_hz)
    q_des, dq_des = draw_motion(arm.motion, len(arm.joints), samples + settle, arm.rate_hz, moving)
    q_des += arm.home
    controls = np.stack([q_des, dq_des], axis=2).reshape(len(q_des), -1)
    truth = roll_out(arm, arm.model, q_des[0], controls).after(settle)
    measured = measure(arm, truth, np.zeros_like(truth.q), measuring)
    return Recording(
        name=f"practice-{number:03d}",
        joints=arm.joints,
        t_ns=np.arange(samples, dtype=np.int64) * round(1e9 / arm.rate_hz),
        **{signal: measured[signal] for signal in ("q", "dq", "tau")},
        rate_hz=float(arm.rate_hz),
        torque_timing="held",
        source=f"sim {arm.name}",
        robot_sha256=hashlib.sha256(arm.xml.encode()).hexdigest(),
        provenance={"seed": seed, "number": number},
    )


class Hand:
    """A point of a link that a spring pulls towards a target, as a person's arm would."""

    stiffness_n_m, largest_n = 250.0, 80.0

    def __init__(self, plant: Plant, joint: int, local_m: np.ndarray) -> None:
        """Take hold of a point in the link's frame; it does not pull yet."""
        self.joint, self.local_m = joint, local_m
        origin, rotation = plant.body_pose(joint)
        self.target_m = self.grabbed_m = origin + rotation @ local_m
        self.damping_n_s_m = 15.0 if plant.arm.name.startswith("rig") else 10.0

    def force_n(self, plant: Plant) -> tuple[np.ndarray, np.ndarray]:
        """Force on the link and where it acts, (3,) each, in the base frame."""
        origin, rotation = plant.body_pose(self.joint)
        point = origin + rotation @ self.local_m
        jacobian = np.zeros((3, plant.model.nv))
        mujoco.mj_jac(plant.model, plant.data, jacobian, None, point, self.joint + 1)
        force = self.stiffness_n_m * (self.target_m - point) - self.damping_n_s_m * (jacobian @ plant.data.qvel)
        return force * min(1.0, self.largest_n / max(float(np.linalg.norm(force)), 1e-9)), point


# --- Arms that are grabbed, pulled and released.


PHASES = ("free motion", "first second of the push", "pressed while stopped", "released, still stopped", "moving again")
BEFORE_S, STAND_S, AFTER_S = 4.0, 3.0, 4.0
UNSEEN_PHASES = ("free motion", "contact while moving", "the second after it")
PRESS_S = (1.0, 10.0)
SETTLED_S = 1.5
"""From the begin of a draw: the observer has forgotten its start."""
REACH_M = 0.3
"""A pointer is pulled so far from the point that it grabbed, at most."""
PULL_HZ = (0.2, 1.0)
ALONG = (1.0, 2.5)
"""Where a link is grabbed, from its joint: in lengths of the way to its centre of mass."""
COARSE_COUNTS = 4096


def coarse(arm: GearedArm) -> GearedArm:
    """With encoders of 12 bit."""
    return replace(arm, name=f"{arm.name}-12bit", sensors=replace(arm.sensors, encoder_counts=COARSE_COUNTS))


CASES: dict[str, Callable[[], GearedArm]] = {
    "rig": ARMS["rig"],
    "seven": ARMS["seven"],
    "rig-12bit": lambda: coarse(ARMS["rig"]()),
    "seven-12bit": lambda: coarse(ARMS["seven"]()),
}


def main() -> None:
    parser = arguments(__doc__, "out", arms=tuple(CASES), seed=0, workers=os.cpu_count() or 1)
    parser.add_argument("--draws", type=int, default=6)
    parser.add_argument("--unseen", type=Path, nargs="+", default=[])
    options = parser.parse_args()
    for folder in options.unseen:
        for needed in ("urdf-prior.tauext", "urdf/contacts-1.parquet", "csv/contacts-1.truth.npz"):
            if not (folder / needed).exists():
                parser.error(f"--unseen {folder}: holds no {needed} (arms whose logs have gaps are not supported)")
    options.out.mkdir(parents=True, exist_ok=True)
    in_parallel(options.workers, train, [(name, options.out) for name in options.arms])
    jobs = [(name, options.out, options.seed + k) for name in options.arms for k in range(options.draws)]
    in_parallel(options.workers, draw_of, jobs)
    rows = [row for name in options.arms for row in judged(name, options.out, options.seed, options.draws)]
    rows += [row for folder in options.unseen for row in judged_unseen(folder)]
    write_tables(options.out, table(rows), short(rows), "contact_errors")


def train(name: str, out: Path) -> Path:
    """A bundle from minutes of the arm's free motion."""
    path = out / f"{name}.tauext"
    if not path.exists():
        arm = CASES[name]()
        count, config = PRACTICE[arm.name.split("-")[0]]
        recordings = [practice_recording(arm, 60.0, 0, k) for k in range(count)]
        robot = out / f"{name}.xml"
        robot.write_text(arm.xml)
        tree = estimated_model(robot, arm.joints, PAPER_CASES["exact"])
        train_on_recordings(TrainingInput(robot, PAPER_CASES["exact"], recordings, [], model=tree), config, path)
    return path


def draw_of(name: str, out: Path, seed: int) -> Path:
    """One grab, and what is true: a recording at the loop's rate, the true external torque and the phases."""
    path = out / f"{name}-{seed}.npz"
    if path.exists():
        return path
    arm, bundle = CASES[name](), _core.Bundle.load(str(train(name, out)))
    rng = np.random.default_rng([seed, 36])
    plant, mover, monitor = Plant(arm, seed), Mover(arm, seed), _core.Monitor(bundle)
    press_s = rng.uniform(*PRESS_S)
    joint = int(rng.integers(len(arm.joints)))
    away = rng.normal(size=3)
    away *= REACH_M * rng.uniform(0.3, 1.0) / np.linalg.norm(away)
    pull_hz, local = rng.uniform(*PULL_HZ), rng.uniform(*ALONG) * plant.model.body_ipos[joint + 1]
    hand: Hand | None = None
    signals: dict[str, list[np.ndarray]] = {key: [] for key in ("q", "dq", "tau", "true")}
    stamps: list[int] = []
    phases: list[int] = []
    ends_s = BEFORE_S + 1.0 + press_s
    stopped = False
    total_s = ends_s + STAND_S + AFTER_S
    while plant.time_s < total_s:
        now = plant.time_s
        if hand is None and BEFORE_S <= now < ends_s:
            hand = Hand(plant, joint, local)
        if hand is not None and now >= ends_s:
            hand = None
        if hand is not None:
            hand.target_m = hand.grabbed_m + away * np.cos(2 * np.pi * pull_hz * max(0.0, now - BEFORE_S - 1.0))
        if now >= ends_s + STAND_S and stopped:
            stopped = False
            monitor.resume()
            mover.resume()
        force, point = hand.force_n(plant) if hand is not None else (None, None)
        sample = plant.step(*mover.step(), force, point, joint)
        q, dq = sample.q, sample.dq
        said = monitor.step(sample.t_ns, q, dq, sample.tau)
        if hand is not None and not stopped and said.alarm == _core.Alarm.collision:
            stopped = True
            mover.stop()
        stamps.append(sample.t_ns)
        for key, value in (("q", q), ("dq", dq), ("tau", sample.tau), ("true", sample.tau_ext)):
            signals[key].append(value.copy())
        phases.append(phase(now, ends_s, stopped))
    columns = {key: np.array(values) for key, values in signals.items()}
    with atomic_write(path) as part, part.open("wb") as file:
        np.savez_compressed(file, t_ns=np.array(stamps), phase=np.array(phases), joint=joint, **columns)
    return path


def phase(now: float, ends_s: float, stopped: bool) -> int:
    """Of PHASES; -1: none of them, also where the alarm did not come."""
    if now < SETTLED_S:
        return -1
    if now < BEFORE_S:
        return 0
    if now < BEFORE_S + 1.0:
        return 1
    if now < ends_s:
        return 2 if stopped else -1
    if now < ends_s + STAND_S:
        return 3 if stopped else -1
    return 4


def judged(name: str, out: Path, seed: int, draws: int) -> list[dict]:
    """Error against standard error by phase and joint, over all draws."""
    arm, bundle = CASES[name](), _core.Bundle.load(str(train(name, out)))
    found: list[tuple[np.ndarray, ...]] = []
    for k in range(seed, seed + draws):
        with np.load(out / f"{name}-{k}.npz") as kept:
            said = estimates(bundle, recording_of(arm, kept))
            phases, true = kept["phase"], kept["true"]
        found.append((phases, said["tau_ext"], true, said["contact_sigma_nm"]))
    return tabulated(name, PHASES, arm.joints, found)


def judged_unseen(folder: Path) -> list[dict]:
    """The same of an arm of unseen_arms.py, whose bundle is there."""
    bundle = _core.Bundle.load(str(folder / "urdf-prior.tauext"))
    found: list[tuple[np.ndarray, ...]] = []
    joints: tuple[str, ...] = ()
    for path in sorted((folder / "csv").glob("contacts-*.truth.npz")):
        name = path.name.split(".")[0]
        recording = load_recording(folder / "urdf" / f"{name}.parquet")
        joints, now = recording.joints, recording.time_s
        with np.load(path) as kept:
            whole = kept["tau_ext"].astype(float)
        at = np.arange(len(whole)) * recording.duration_s / (len(whole) - 1)
        true = np.stack([np.interp(now, at, column) for column in whole.T], axis=1)
        phases = np.where(now < 2 * SETTLED_S, -1, 0)
        contacts = json.loads(path.with_suffix(".json").read_text())
        for contact in contacts:
            begins, ends = contact["start_s"], contact["end_s"]
            phases[(now >= begins - 0.5) & (now < ends + 3.0)] = -1
        for contact in contacts:
            begins, ends = contact["start_s"], contact["end_s"]
            phases[(now >= begins) & (now < ends)] = 1
            phases[(now >= ends) & (now < ends + 1.0)] = 2
        said = estimates(bundle, recording)
        found.append((phases, said["tau_ext"], true, said["contact_sigma_nm"]))
    return tabulated(folder.name, UNSEEN_PHASES, joints, found)


def tabulated(name: str, titles: Sequence[str], joints: Sequence[str], found: list[tuple]) -> list[dict]:
    """A row a phase and joint of phases, tau_ext, true torques and standard errors."""
    phases, tau_ext, true, sigma = (np.concatenate(column) for column in zip(*found, strict=True))
    rows = []
    for number, title in enumerate(titles):
        at = (phases == number) & np.isfinite(tau_ext).all(axis=1)
        for j, joint in enumerate(joints) if at.any() else ():
            e, s = tau_ext[at, j] - true[at, j], sigma[at, j]
            sizes = {"true_nm": float(rms(true[at, j])), "error_nm": float(rms(e)), "sigma_nm": float(rms(s))}
            within = [float(np.mean(np.abs(e) <= times * s)) for times in (1, 2, 3)]
            rows.append({"arm": name, "phase": title, "joint": joint} | sizes | {"within": within})
    return rows


def recording_of(arm: GearedArm, kept: np.lib.npyio.NpzFile) -> Recording:
    signals = {key: kept[key] for key in ("t_ns", "q", "dq", "tau")}
    return Recording("drawn", arm.joints, **signals, rate_hz=float(arm.rate_hz), torque_timing="held",
                     source=f"sim {arm.name}", robot_sha256="")  # fmt: skip


def table(rows: list[dict]) -> list[str]:
    """A row an arm and phase: the least and the most of its joints."""
    lines = head("arm | phase | true, N m | error | standard error | within 1, % | 2 | 3")
    for arm, title in dict.fromkeys((row["arm"], row["phase"]) for row in rows):
        of = [row for row in rows if (row["arm"], row["phase"]) == (arm, title)]

        def both(values: list[float], form: str) -> str:
            low, high = format(min(values), form), format(max(values), form)
            return low if low == high else f"{low} to {high}"

        cells = [both([row[key] for row in of], ".2f") for key in ("true_nm", "error_nm", "sigma_nm")]
        cells += [both([100 * row["within"][k] for row in of], ".0f") for k in range(3)]
        lines.append(table_row(arm, title, *cells))
    return lines


if __name__ == "__main__":
    main()
