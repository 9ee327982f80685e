"""An admittance loop on the force at the tool presses a stiff wall with 20 N, while the arm is hit.

    python benchmarks/admittance.py MODELS OUT [--arms seven_axis ur5] [--walls 1e4 1e5] [--seed 0]

The loop runs at the rate of the arm's controller: v = (F_set - F) / D along the wall's normal, where F is
`Monitor.tool_force()` of the declared contact. Arms, bundles and hits are those of benchmarks/pressing.py, whose OUT is
used. The arm presses at rest, and while the tool wipes along the wall. OUT/admittance.md gets the table,
OUT/admittance.png a picture of the first arm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib.pyplot as plt
import mujoco
import numpy as np
from common import arguments, head, table_row, write_tables
from pressing import ACKNOWLEDGED_S, GRACE_S, STRENGTHS, bundle_of, declare, presser_of
from tauext_lab.sim.rig import encoder
from unseen.presses import AFTER_HIT_S, WARM_S, Plant, Presser, draw_hit
from unseen.recordings import DRIVE_VELOCITY_RAD_S
from unseen.simulation import RATE_HZ, Contact, Steps
from unseen.touches import Kinematics

from tauext import _core

SET_N, TOLERANCE_N = 20.0, 2.0
DECLARED_N = 30.0
LENGTH_S, FIRST_HIT_S, HIT_EVERY_S = 70.0, 25.0, 5.0
DECLARED_S, START_S = 2.0, 3.0
APPROACH_M_S = 0.01
GAP_M = 0.005
CROSSOVER_RAD_S = 1.5
"""Of the loop on a wall of stiffness k: D = k / this."""
DRIVE_N_M = 4e4
"""Stiffness of an arm that its drives hold, as an integrator would guess it: in series with the wall."""
WALL_N_S_M, FRICTION, SLIPS_M_S = 400.0, 0.2, 0.005
WIPE_M, WIPE_S = 0.05, 4.0
"""Amplitude and period of the tool's way along the wall."""
DAMPED = 0.02
"""Of the inverse kinematics."""


@dataclass
class Course:
    """What happened, at the controller's rate."""

    wipes: bool
    wall_n_m: float
    t_s: list[float] = field(default_factory=list)
    true_n: list[float] = field(default_factory=list)
    found_n: list[float] = field(default_factory=list)
    sigma_n: list[float] = field(default_factory=list)
    depth_mm: list[float] = field(default_factory=list)
    """Of the commanded tip behind the wall's face."""
    alarm: list[bool] = field(default_factory=list)
    hits: list[Contact] = field(default_factory=list)


class Wall:
    """A springy plane that the tool's tip touches, with friction."""

    def __init__(self, point_m: np.ndarray, normal: np.ndarray, stiffness_n_m: float) -> None:
        self.point_m, self.normal, self.stiffness_n_m = point_m, normal, stiffness_n_m

    def force_n(self, tip_m: np.ndarray, v_m_s: np.ndarray) -> np.ndarray:
        """On the tip, (3,)."""
        depth, speed = float((self.point_m - tip_m) @ self.normal), float(v_m_s @ self.normal)
        if depth <= 0:
            return np.zeros(3)
        push = max(0.0, self.stiffness_n_m * depth - WALL_N_S_M * speed)
        along = v_m_s - speed * self.normal
        return push * self.normal - FRICTION * push * along / float(np.hypot(np.linalg.norm(along), SLIPS_M_S))


class Instruments:
    """What encoders and drives measure, a step of the simulation at a time; see unseen.recordings.readings."""

    def __init__(self, presser: Presser, plant: Plant, rng: np.random.Generator) -> None:
        arm, self._counts = plant.arm, 2**presser.maker.encoder_bits
        self._arm, self._nm_per_unit, self._rng = arm, plant.nm_per_unit, rng
        self._keeps = np.exp([-1 / (arm.current_filter_s * RATE_HZ), -DRIVE_VELOCITY_RAD_S / RATE_HZ])
        self.q: np.ndarray | None = None
        self.dq = np.zeros(len(presser.maker.joints))
        self._ampere: np.ndarray | None = None

    def read(self, q: np.ndarray, motor_nm: np.ndarray) -> None:
        """Follow a step."""
        measured, ampere = encoder(q, self._counts), motor_nm / self._arm.nm_per_ampere
        if self.q is not None and self._ampere is not None:
            ampere = self._keeps[0] * self._ampere + (1 - self._keeps[0]) * ampere
            self.dq = self._keeps[1] * self.dq + (1 - self._keeps[1]) * (measured - self.q) * RATE_HZ
        self.q, self._ampere = measured, ampere

    @property
    def tau(self) -> np.ndarray:
        """As the controller reports it."""
        assert self._ampere is not None
        noisy = self._ampere + self._arm.current_noise_a * self._rng.standard_normal(len(self._ampere))
        return np.round(noisy / self._arm.current_step_a) * self._arm.current_step_a * self._nm_per_unit


def tip_of(model: mujoco.MjModel, data: mujoco.MjData, tip_m: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Place of the tool's tip (3,), and how it and the last link's turn follow the joints (6, joints)."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    point = data.xpos[-1] + data.xmat[-1].reshape(3, 3) @ np.array(tip_m)
    jacobian = np.zeros((6, model.nv))
    mujoco.mj_jac(model, data, jacobian[:3], jacobian[3:], point, model.nbody - 1)
    return point, jacobian


def pose(presser: Presser, known: Kinematics, rng: np.random.Generator) -> np.ndarray:
    """Of some that are drawn, the one from which the tool moves best in every direction."""
    low, high = (np.array(one) for one in (presser.maker.low_rad, presser.maker.high_rad))
    drawn = low + (high - low) * rng.uniform(0.2, 0.8, (200, len(low)))

    def least(q: np.ndarray) -> float:
        known.data.qpos[:] = q
        return float(np.linalg.svd(tip_of(known.model, known.data, presser.tip_m)[1], compute_uv=False)[-1])

    return np.array(max(drawn, key=least))


def joint_speeds(known: Kinematics, presser: Presser, q: np.ndarray, v_m_s: np.ndarray) -> np.ndarray:
    """Speeds of the joints that move the tip so, without turning the tool."""
    known.data.qpos[:] = q
    jacobian = tip_of(known.model, known.data, presser.tip_m)[1]
    squares = jacobian @ jacobian.T + DAMPED**2 * np.eye(6)
    return np.asarray(jacobian.T @ np.linalg.solve(squares, np.append(v_m_s, np.zeros(3))))


def hits_on(presser: Presser, start: np.ndarray, rng: np.random.Generator) -> list[Contact]:
    """One on each link in turn, from FIRST_HIT_S on."""
    arm, q = Kinematics(presser.tree), np.tile(start, (round(LENGTH_S * RATE_HZ), 1))
    times = np.arange(FIRST_HIT_S, LENGTH_S - HIT_EVERY_S, HIT_EVERY_S)
    return [
        draw_hit(presser, arm, k % len(start), (at_s, at_s + 2.0), q, STRENGTHS, rng) for k, at_s in enumerate(times)
    ]


def run(presser: Presser, bundle: _core.Bundle, wall_n_m: float, wipes: bool, seed: int) -> Course:
    """One press against a wall, with hits on each link once it is steady."""
    maker, plant = presser.maker, presser.plant
    assert plant is not None
    rng = np.random.default_rng([9, seed, int(wipes)])
    samples, dt, every = round(LENGTH_S * RATE_HZ), 1 / RATE_HZ, RATE_HZ // maker.rate_hz
    known = Kinematics(plant.known)
    q = pose(presser, known, rng)
    course = Course(wipes, wall_n_m, hits=hits_on(presser, q, rng))
    standing = np.tile(q, (samples, 1))
    setpoints = (standing, np.zeros_like(standing), np.zeros_like(standing))
    steps = Steps(plant.arm, plant.known, setpoints, maker.torque_nm, course.hits, WARM_S)
    at_m, _ = tip_of(steps.model, steps.data, presser.tip_m)
    normal = steps.data.xmat[-1].reshape(3, 3) @ np.array(presser.axis)
    side = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    side /= np.linalg.norm(side)
    wall = Wall(at_m - GAP_M * normal, normal, wall_n_m)
    damping = (1 / (1 / wall_n_m + 1 / DRIVE_N_M)) / CROSSOVER_RAD_S
    monitor, instruments = _core.Monitor(bundle), Instruments(presser, plant, rng)
    dq, normal_n, wiped_s, declared = np.zeros_like(q), 0.0, 0.0, False
    for k in range(samples):
        now_s = k * dt
        point, jacobian = tip_of(steps.model, steps.data, presser.tip_m)
        force = wall.force_n(point, jacobian[:3] @ steps.data.qvel)
        steps.q_des[k], steps.dq_des[k] = q, dq
        steps.forward[k] = plant.known.momentum(q[None], dq[None])[1][0]
        steps.run(k, 1, jacobian[:3].T @ force)
        instruments.read(steps.out[0, k], steps.out[1, k])
        if k % every == 0:
            if course.alarm and course.alarm[-1] and now_s - 1e-9 * monitor.last.alarm_t_ns >= ACKNOWLEDGED_S:
                monitor.acknowledge()
            if not declared and now_s > DECLARED_S:
                declared = True
                declare(monitor, presser, DECLARED_N, LENGTH_S)
            alarm = monitor.step(k * 1_000_000, instruments.q, instruments.dq, instruments.tau).alarm
            normal_n, sigma_n = force_along(monitor, presser, normal)
            course.t_s.append(now_s)
            course.true_n.append(float(force @ normal))
            course.found_n.append(normal_n)
            course.sigma_n.append(sigma_n)
            course.depth_mm.append(1e3 * float((wall.point_m - point) @ normal))
            course.alarm.append(alarm == _core.Alarm.collision)
        speed = float(np.clip((SET_N - normal_n) / damping, -APPROACH_M_S, APPROACH_M_S))
        moves = now_s > START_S and not course.alarm[-1]  # a collision holds the arm until it is acknowledged
        wiped_s += moves * dt
        wiped = WIPE_M * 2 * np.pi / WIPE_S * np.sin(2 * np.pi * wiped_s / WIPE_S)
        dq = joint_speeds(known, presser, q, moves * (-speed * normal + wipes * wiped * side))
        q = q + dq * dt
    steps.done()
    return course


def force_along(monitor: _core.Monitor, presser: Presser, normal: np.ndarray) -> tuple[float, float]:
    """Force of the wall as estimated, and its standard error, [N]; 0 and NaN while it is unknown."""
    tool = monitor.tool_force().wrench
    if not tool.known:
        return 0.0, float("nan")
    return float(np.array(tool.force) @ normal), float(np.sqrt(normal @ np.array(tool.covariance)[:3, :3] @ normal))


# --- What a press shows, a table and a picture.


TOUCHES_N = 1.0


def facts(course: Course) -> dict:
    """Rise, overshoot, steady force, delay of the estimate, hits and other alarms of a press."""
    t, true, found, sigma = (np.array(one) for one in (course.t_s, course.true_n, course.found_n, course.sigma_n))
    begin = int(np.argmax(true > TOUCHES_N)) if (true > TOUCHES_N).any() else -1
    quiet = (t > t[begin] + 5.0) & (t > FIRST_HIT_S - 8.0) if begin >= 0 else np.zeros(len(t), dtype=bool)
    alarm = np.array(course.alarm)
    rises = t[np.flatnonzero(alarm & ~np.append(False, alarm[:-1]))]
    hits, near = [], np.zeros(len(rises), dtype=bool)
    for hit in course.hits:
        within = (rises >= hit.start_s) & (rises <= hit.end_s + GRACE_S)
        hits.append(bool(within.any()))
        near |= (rises >= hit.start_s) & (rises <= hit.end_s + AFTER_HIT_S)
        quiet &= (t < hit.start_s) | (t > hit.end_s + 2.0)
    smooth = np.convolve(true, np.ones(25) / 25, "same")
    half = [next((float(t[k]) for k in range(begin, len(t)) if one[k] > SET_N / 2), None) for one in (smooth, found)]
    settled = np.flatnonzero(np.abs(smooth - SET_N) > TOLERANCE_N)
    settled = settled[t[settled] < FIRST_HIT_S]
    return {
        "wipes": course.wipes,
        "wall_n_m": course.wall_n_m,
        "touched_s": float(t[begin]) if begin >= 0 else None,
        "settled_s": float(t[settled[-1]] - t[begin]) if begin >= 0 and len(settled) else None,
        "overshoot_n": float(true[t < FIRST_HIT_S].max() - SET_N),
        "mean_n": float(true[quiet].mean()),
        "sd_n": float(true[quiet].std()),
        "within": float((np.abs(true[quiet] - SET_N) <= TOLERANCE_N).mean()),
        "found_off_n": float((found - true)[quiet].mean()),
        "sigma_n": float(np.nanmedian(sigma[quiet])),
        "covered": float((np.abs(found - true)[quiet] <= 2 * sigma[quiet]).mean()),
        "delay_s": half[1] - half[0] if None not in half else None,
        "hits": [int(sum(hits)), len(hits)],
        "false": int((~near).sum()),
    }


COLUMNS = (
    "arm | state | wall, N/m | within 2 N from, s | overshoot, N | steady force, N: mean | sd | within 2 N | "
    "estimate less truth, N | standard error, N | within two | it passes 10 N later, ms | hits found | other alarms"
)


def row(name: str, one: dict) -> str:
    """Of the table."""
    settled, delay = (one[key] for key in ("settled_s", "delay_s"))
    return table_row(
        name, "wiping" if one["wipes"] else "still", f"{one['wall_n_m']:.0e}",
        "–" if settled is None else f"{settled:.1f}", f"{one['overshoot_n']:.1f}", f"{one['mean_n']:.1f}",
        f"{one['sd_n']:.1f}", f"{one['within']:.0%}", f"{one['found_off_n']:+.1f}", f"{one['sigma_n']:.1f}",
        f"{one['covered']:.0%}", "–" if delay is None else f"{1e3 * delay:.0f}", "{}/{}".format(*one["hits"]),
        one["false"],
    )  # fmt: skip


TRUE, FOUND, ALARM = "0.15", "#1f6fb4", "#c8501e"


def draw(courses: Sequence[Course], out: Path) -> None:
    """Force and the tip behind the wall's face over time, a column a course."""
    figure, axes = plt.subplots(
        2, len(courses), figsize=(6.2 * len(courses), 6.0), sharex=True, sharey="row", squeeze=False,
        height_ratios=(2, 1), constrained_layout=True,
    )  # fmt: skip
    for (force, depth), course in zip(axes.T, courses, strict=True):
        t, found, sigma = (np.array(one) for one in (course.t_s, course.found_n, course.sigma_n))
        force.axhspan(SET_N - TOLERANCE_N, SET_N + TOLERANCE_N, color="0.9", label=f"{SET_N:g} ± {TOLERANCE_N:g} N")
        force.fill_between(t, found - 2 * sigma, found + 2 * sigma, color=FOUND, alpha=0.2, lw=0)
        force.plot(t, found, color=FOUND, lw=0.8, label="tool_force(), band of two standard errors")
        force.plot(t, course.true_n, color=TRUE, lw=1.0, label="true force of the wall")
        alarm, edges = np.array(course.alarm), np.flatnonzero(np.diff(np.append(False, course.alarm).astype(int)))
        for k, first in enumerate(edges[::2]):
            last = edges[2 * k + 1] if 2 * k + 1 < len(edges) else len(alarm) - 1
            force.axvspan(t[first], t[last], ymin=0.94, color=ALARM, label="collision alarm" if k == 0 else None)
        for k, hit in enumerate(course.hits):
            label = "a hit, by its link" if k == 0 else None
            force.plot(hit.start_s, -9, "^", color=ALARM, ms=5, label=label, clip_on=False)
            force.annotate(
                str(hit.link + 1), (hit.start_s, -9), (0, 6), textcoords="offset points", ha="center", size=8
            )
        depth.plot(t, course.depth_mm, color=TRUE, lw=1.0)
        force.set_title(f"{'wiping' if course.wipes else 'still'}, wall of {1e-3 * course.wall_n_m:g} N/mm")
        depth.set_xlabel("time, s")
        for axis in (force, depth):
            axis.grid(color="0.92")
    axes[0, 0].set_ylabel("force on the tool, N")
    axes[1, 0].set_ylabel("tip behind the wall's face, mm")
    axes[0, 0].set_ylim(-12, 60)
    axes[0, 0].legend(loc="upper left", fontsize=8)
    figure.savefig(out, dpi=110)
    plt.close(figure)


def main() -> None:
    parser = arguments(__doc__, "models", "out", arms=("seven_axis", "ur5"), seed=0)
    parser.add_argument("--walls", nargs="+", type=float, default=[1e4, 1e5], help="N/m, default: 1e4 1e5")
    options = parser.parse_args()
    rows, content = head(COLUMNS), []
    for name in options.arms:
        presser = presser_of(name, options.models, options.out)
        bundle, courses = bundle_of(presser, options.out / name), []
        for wall in options.walls:
            for wipes in (False, True):
                courses.append(run(presser, bundle, wall, wipes, options.seed))
                content.append({"arm": name} | facts(courses[-1]))
                rows.append(row(name, content[-1]))
                print(rows[-1], flush=True)
        draw(courses[: len(options.walls)], options.out / f"admittance-{name}.png")
    write_tables(options.out, rows, content, "admittance")


if __name__ == "__main__":
    main()
