"""Time and accuracy of the sweep (p and beta of a 7-axis arm) beside Pinocchio's and MuJoCo's way to the same numbers.

    python benchmarks/dynamics.py [--states 2000] [--rounds 7]

The sweep runs as shipped, through its batched call; Pinocchio and MuJoCo are called from Python a state at a time, so
their times contain the calls. Everything is measured in turns, and medians are given.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
from common import about_run, arguments, head, table_row

from tauext.robot.read import load_tree

ARM = Path(__file__).parent / "seven_axis.urdf"
SHIFT_S = 1e-4
"""MuJoCo has no Coriolis matrix; dM/dt comes from momenta this long before and after."""


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--states", type=int, default=2000)
    parser.add_argument("--rounds", type=int, default=7)
    options = parser.parse_args()

    tree = load_tree(ARM)
    random = np.random.default_rng(1)
    q, dq = random.uniform(-2.9, 2.9, (options.states, tree.size)), random.uniform(-2, 2, (options.states, tree.size))
    model = pin.buildModelFromUrdf(str(ARM))
    model.armature = np.array([link.rotor_inertia for link in tree.links])
    scene = mujoco.MjModel.from_xml_path(str(ARM))
    scene.dof_armature[:] = model.armature

    ways: dict[str, Callable[[], tuple[float, np.ndarray]]] = {
        "tauext sweep": lambda: timed(lambda: np.stack(tree.momentum(q, dq)), options.states, 11),
        "Pinocchio from Python": lambda: timed(lambda: by_pinocchio(model, q, dq), options.states),
        "MuJoCo from Python": lambda: timed(lambda: by_mujoco(scene, q, dq), options.states),
    }
    times: dict[str, list[float]] = {name: [] for name in ways}
    answers: dict[str, np.ndarray] = {}
    for _ in range(options.rounds):
        for name, way in ways.items():
            ns, answers[name] = way()
            times[name].append(ns)

    print(f"{about_run()}; Pinocchio {pin.__version__}, MuJoCo {mujoco.__version__}")
    print(f"{ARM.name}, {options.states} random states, median of {options.rounds} rounds in turns\n")
    print("\n".join(head("p and beta of one state | ns | min | max | ratio | difference of p | beta")))
    base, reference = statistics.median(times["tauext sweep"]), answers["Pinocchio from Python"]
    for name, ns in times.items():
        median = statistics.median(ns)
        off = (np.abs(a - b).max() / np.abs(b).max() for a, b in zip(answers[name], reference, strict=True))
        numbers = f"{median:.0f}", f"{min(ns):.0f}", f"{max(ns):.0f}", f"{median / base:.1f}"
        print(table_row(name, *numbers, *(f"{one:.1e}" for one in off)))
    print("\ndifference: largest, relative to the largest value of Pinocchio's from Python")


def timed(work: Callable[[], np.ndarray], states: int, batches: int = 1) -> tuple[float, np.ndarray]:
    """Median time per state [ns] over batches, and the answer of the last."""
    ns = []
    for _ in range(batches):
        start = time.perf_counter_ns()
        answer = work()
        ns.append((time.perf_counter_ns() - start) / states)
    return statistics.median(ns), answer


def by_pinocchio(model: pin.Model, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
    data, out = model.createData(), np.empty((2, *q.shape))
    for k in range(len(q)):
        upper = np.triu(pin.crba(model, data, q[k]))
        out[0, k] = upper @ dq[k] + np.triu(upper, 1).T @ dq[k]
        coriolis = pin.computeCoriolisMatrix(model, data, q[k], dq[k])
        out[1, k] = pin.computeGeneralizedGravity(model, data, q[k]) - coriolis.T @ dq[k]
    return out


def by_mujoco(scene: mujoco.MjModel, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
    data, out = mujoco.MjData(scene), np.empty((2, *q.shape))
    p = np.empty((3, scene.nv))
    for k in range(len(q)):
        for row, shift in enumerate((-SHIFT_S, SHIFT_S, 0.0)):
            data.qpos[:] = q[k] + shift * dq[k]
            mujoco.mj_kinematics(scene, data)
            mujoco.mj_comPos(scene, data)
            mujoco.mj_makeM(scene, data)
            mujoco.mj_mulM(scene, data, p[row], dq[k])
        data.qvel[:] = dq[k]
        mujoco.mj_comVel(scene, data)
        mujoco.mj_rne(scene, data, 0, out[1, k])
        out[0, k], out[1, k] = p[2], out[1, k] - (p[1] - p[0]) / (2 * SHIFT_S)
    return out


if __name__ == "__main__":
    main()
