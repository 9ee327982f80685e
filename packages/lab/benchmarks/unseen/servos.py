"""A low-cost servo arm (tauext_lab.sim.servo_arm), stepped by compiled code, with touches; what a bus reports of it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from tauext_lab.sim.contacts import log_uniform
from tauext_lab.sim.rig import encoder
from tauext_lab.sim.servo_arm import (
    COMMAND_TICKS,
    COUNT_RAD,
    COUNTS,
    HIGH_RAD,
    LOW_RAD,
    OUTPUT_SHARE,
    SO101_FILE,
    SO101_JOINTS,
    SUPPLY_OHM,
    SUPPLY_V,
    TICKS_HZ,
    ServoArm,
    backlash_model,
    drawn,
)

from tauext import _core
from tauext.robot.read import load_tree
from unseen.arms import Maker, direction, true_arm
from unseen.recordings import Take, split_text
from unseen.simulation import NUMBER, POINTER, WHOLE, address, compiled, draw_motion

# --- A low-cost servo arm as its user meets it: a URDF that is roughly right, and servos of which each differs.


def so101(own_seed: int = 101) -> Maker:
    """The arm as a `Maker`. What the others have of friction, currents and constants is the servos' business here."""
    none, two_three = (0.0,) * 5, (2.3,) * 5
    return Maker(
        "so101", SO101_FILE, SO101_JOINTS, 50, LOW_RAD, HIGH_RAD, two_three, (3.4,) * 5,
        none, none, (0.0216,) * 5, (1.275,) * 5, 12, True, True, stop_share=0.15, own_seed=own_seed,
    )  # fmt: skip


def servo_arm(maker: Maker, seed: int) -> ServoArm:
    """An arm that could have come out of the box: links off by up to 20 % and 1 cm, servos by 10 to 20 %."""
    rng = maker.random(seed, 0)
    tree = true_arm(maker, rng, tool=False).tree
    servos = drawn(len(maker.joints), rng)
    links = tree.links
    believed = load_tree(maker.model, maker.joints).links
    for link, rotor, known in zip(links, servos.rotor_kg_m2, believed, strict=True):
        link.rotor_inertia = rotor
        link.com = [0.5 * (a + b) for a, b in zip(link.com, known.com, strict=True)]
    return ServoArm(_core.Tree(links, tree.gravity), servos, rng.uniform(*SUPPLY_V), rng.uniform(*SUPPLY_OHM))


# --- The arm in MuJoCo: gear and link of each joint joined through a gap, stepped by servo_steps.cpp.


SAMPLE = ("q", "dq", "goal", "duty", "supply_a", "speed", "motor_nm", "load_nm", "tau_ext")
STEPS = (
    POINTER, POINTER, POINTER, WHOLE, NUMBER, NUMBER, NUMBER, POINTER, POINTER, WHOLE, POINTER, WHOLE, POINTER, WHOLE,
    POINTER, POINTER,
)  # fmt: skip
"""Arguments of servo_steps()."""
SHAPES = ("impact", "push", "wall")
"""Half sine; ramps up and down; a spring that stands where the link is as the touch begins."""


@dataclass(frozen=True)
class Touch:
    """What touches the arm once; `Contact` of these arms, whose strength is a torque."""

    shape: str
    from_s: float
    to_s: float
    link: int
    at_m: tuple[float, float, float]
    """In the link's axes."""
    direction: tuple[float, float, float]
    """In the world; impacts and walls act against the motion instead, where there is any."""
    peak: float
    """Most torque that it exerts on a joint as it begins, [N m]; of a wall, its stiffness, [N/m]."""
    rise_s: float = 0.1

    def row(self) -> list[float]:
        shape = float(SHAPES.index(self.shape))
        return [self.from_s, self.to_s, self.link, *self.at_m, *self.direction, self.peak, self.rise_s, shape]


@dataclass(frozen=True)
class ServoRun:
    """True signals at the bus's samples, (samples, joints): see SAMPLE; and the voltage, (samples,)."""

    ticks: np.ndarray
    signals: dict[str, np.ndarray]
    volts: np.ndarray


def simulate_servos(arm: ServoArm, goals: np.ndarray, rate_hz: float, touches: Sequence[Touch]) -> ServoRun:
    """The arm follows goals, (samples, joints), [rad], each written as the servos are read, at `rate_hz`.

    A goal is that of the register: whole counts. Samples are taken at the servos' ticks of 1 ms.
    """
    model = backlash_model(arm)
    data = mujoco.MjData(model)
    gears = replace(arm.servos, coulomb_nm=(1 - OUTPUT_SHARE) * arm.servos.coulomb_nm)
    table, goals = gears.table(), np.ascontiguousarray(encoder(goals, COUNTS))
    data.qpos[::2] = goals[0]
    samples, n = goals.shape
    ticks = np.round(np.arange(samples) * TICKS_HZ / rate_hz).astype(np.int32)
    acts = (ticks + COMMAND_TICKS).astype(np.int32)
    out, volts = np.zeros((samples, n, len(SAMPLE))), np.zeros(samples)
    rows = np.array([touch.row() for touch in touches], dtype=np.float64)
    taken = compiled("servo_steps", STEPS, WHOLE)(
        model._address, data._address, address(table), n, arm.volts, arm.supply_ohm, COUNT_RAD,
        address(goals), address(acts), samples, address(rows), len(touches),
        address(ticks), samples, address(out), address(volts),
    )  # fmt: skip
    if taken != samples or not np.isfinite(out).all() or data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
        raise RuntimeError("the simulation diverged")
    return ServoRun(ticks, {name: out[:, :, k].copy() for k, name in enumerate(SAMPLE)}, volts)


# --- What a bus reports of the arm: Parquet files of registers, arm.toml, and apart from them the truth.


SUPPLY_STEP_A, SUPPLY_NOISE_A = 0.0065, 0.004
"""Of a Feetech servo's register of current, and what its converter adds."""
DUTY_STEP, VOLTAGE_STEP_V = 0.001, 0.1
STAMP_JITTER_S = 3e-4
"""Of a computer that polls a serial bus."""
TORQUES_NM = (0.05, 1.5)
WALLS_N_M = (300.0, 3000.0)
SHARES = {"impact": 0.25, "push": 0.45, "wall": 0.3}
SECONDS = {"impact": (0.06, 0.25), "push": (0.5, 3.0), "wall": (0.7, 2.5)}
LINK_RADIUS_M, LAST_LINK_M = 0.02, 0.1
TOUCHED_NM = 0.02
"""A wall that a joint feels with less has not touched it."""


def draw_touches(maker: Maker, arm: ServoArm, take: Take, rng: np.random.Generator) -> list[Touch]:
    """So many touches in order of time, never two at once; the base's link is spared, as in `contacts.draw_contacts`.

    Torques are drawn by their logarithm, so that as many are near a limit as far above it, wherever the limit is.
    """
    slot, touches = (60 * take.minutes - 8.0) / max(1, take.contacts), []
    for k in range(take.contacts):
        shape = str(rng.choice(list(SHARES), p=list(SHARES.values())))
        seconds = rng.uniform(*SECONDS[shape])
        start = 8.0 + k * slot + rng.uniform(0.05, max(0.1, slot - seconds - 2.5))
        link, way = int(rng.integers(1, len(maker.joints))), direction(rng)
        further = [one.translation for one in arm.tree.links if one.parent == link]
        reach = np.array(further[0] if further else (0, 0, LAST_LINK_M)) * rng.uniform(0.3, 1.0)
        angle = rng.uniform(0, 2 * np.pi)
        at = reach + LINK_RADIUS_M * np.array([np.cos(angle), np.sin(angle), 0])
        touches.append(
            Touch(
                shape, start, start + seconds, link, tuple(at), tuple(way),
                log_uniform(rng, WALLS_N_M if shape == "wall" else TORQUES_NM), rise_s=rng.uniform(0.05, 0.2),
            )
        )  # fmt: skip
    return touches


def write_take(maker: Maker, arm: ServoArm, rate_hz: int, take: Take, number: int, seed: int, folder: Path) -> None:
    """Simulate a take and write NAME.parquet, NAME.truth.npz and NAME.touches.json into a folder.

    Motion and touches are the same at every rate; goals are written, and servos read, at that rate.
    """
    rng = maker.random(seed, 1 + number)
    goals = draw_motion(maker, round(60 * take.minutes * TICKS_HZ), TICKS_HZ, rng)[0]
    touches = draw_touches(maker, arm, take, rng)
    at = np.round(np.arange(round(60 * take.minutes * rate_hz)) * TICKS_HZ / rate_hz).astype(int)
    run = simulate_servos(arm, goals[at], rate_hz, touches)
    touched = (np.abs(run.signals["tau_ext"]) > TOUCHED_NM).any(axis=1)
    (folder / f"{take.name}.touches.json").write_text(json.dumps([vars(touch) for touch in touches], indent=1) + "\n")
    np.savez_compressed(folder / f"{take.name}.truth.npz", ticks=run.ticks, **run.signals)
    pq.write_table(_registers(maker, run, touched, rng), folder / f"{take.name}.parquet")  # last: it says all is there


def _registers(maker: Maker, run: ServoRun, touched: np.ndarray, rng: np.random.Generator) -> pa.Table:
    """What the computer has of a run; the load is the duty, the current has no sign."""
    ampere = np.abs(run.signals["supply_a"]) + SUPPLY_NOISE_A * rng.standard_normal(run.signals["q"].shape)
    volts = np.repeat(run.volts[:, None], len(maker.joints), axis=1)
    signals = {
        "position": encoder(run.signals["q"], COUNTS),
        "speed": run.signals["speed"],
        "goal": np.vstack([run.signals["goal"][1:], run.signals["goal"][-1:]]),  # sent after the reading
        "load": np.round(run.signals["duty"] / DUTY_STEP) * DUTY_STEP,
        "current": np.round(np.maximum(ampere, 0) / SUPPLY_STEP_A) * SUPPLY_STEP_A,
        "voltage": np.round(volts / VOLTAGE_STEP_V) * VOLTAGE_STEP_V,
        "signed": np.sign(run.signals["duty"]) * np.round(np.maximum(ampere, 0) / SUPPLY_STEP_A) * SUPPLY_STEP_A,
        "tau_ext": run.signals["tau_ext"],
    }
    jitter_s = np.clip(STAMP_JITTER_S * rng.standard_normal(len(run.ticks)), -2e-3, 2e-3)
    columns = {"time": (run.ticks / TICKS_HZ + jitter_s + 0.01).round(6)}
    for name, values in signals.items():
        columns |= {f"{name}_{joint}": values[:, j] for j, joint in enumerate(maker.joints)}
    return pa.table(columns | {"touched": touched.astype(np.int8)})


def description(maker: Maker, takes: Sequence[Take], source: str, model: bool) -> str:
    """The text of arm.toml as the arm's user would write it, with the torque from this source."""
    registers = {"supply-current": ("current", "duty"), "duty": ("duty", "voltage"), "goal": ()}
    columns = {"current": "current", "duty": "load", "voltage": "voltage"}
    units = {"current": "A", "duty": "1", "voltage": "V"}
    read = "\n".join(
        f'{name} = {{columns = "{columns[name]}_{{joint}}", unit = "{units[name]}"}}' for name in registers[source]
    )
    return f"""\
[robot]
model = {json.dumps(str(maker.model.resolve()) if model else "")}
joints = {json.dumps(list(maker.joints))}
rotor_inertia_kg_m2 = {json.dumps(list(maker.rotor_kg_m2))}

[time]
column = "time"

[servo]
type = "sts3215-7.4v"
torque_from = "{source}"

[signals]
q = {{columns = "position_{{joint}}", unit = "rad"}}
q_des = {{columns = "goal_{{joint}}", unit = "rad"}}
tau_ext = {{columns = "tau_ext_{{joint}}", unit = "Nm"}}
{read}

[contact]
column = "touched"

{split_text(takes, ".parquet")}"""
