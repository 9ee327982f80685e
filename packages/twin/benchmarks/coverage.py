"""Do a twin's intervals hold the truth? Friction, rotor inertia and masses of simulated arms, whose truth is known.

    python packages/twin/benchmarks/coverage.py MODELS OUT [--arms ur5 ...] [--seeds 0 1] [--lag-ms 15]

Each arm, drawn by its seed, is recorded for twelve minutes as an integrator would, and trained by recipe prior.
The true friction is what the simulation applied, projected on viscous and Coulomb friction as a twin's is: least
squares over the same motion behind the same observer. MODELS: folder of ur5_robot.urdf, panda.urdf and kinova.urdf.
OUT/tables.md gets the table, OUT/coverage.json each parameter; recordings and bundles in OUT are used again.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import arguments, checkpoint, head, save_json, table_row, trained, write_tables
from tauext_lab.sim.rig import velocity
from tauext_twin.arm import Arm, read_arm
from tauext_twin.held_out import sliding_friction
from tauext_twin.posterior import VALUES, find_posterior
from unseen.arms import Maker, arm_of, fresh_makers, makers
from unseen.recordings import TAKES, make_dataset
from unseen.simulation import RATE_HZ, draw_contacts, draw_motion, simulate

from tauext import _core
from tauext.check.joint_fit import delayed
from tauext.robot.model_case import empty
from tauext.robot.read import load_tree

USED = [take for take in TAKES if take.part != "collisions"]
ARMS = ("ur5", "kinova", "seven_axis", "panda", "palletizer", "offset_wrist", "light_arm")


def main() -> None:
    parser = arguments(__doc__, "models", "out", arms=ARMS)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="draw the arms, default: 0")
    parser.add_argument("--lag-ms", type=int, default=0, help="by which torques lag behind the motion, default: 0")
    options = parser.parse_args()
    name_of = f"coverage-{options.lag_ms}-ms" if options.lag_ms else "coverage"
    known = makers(options.models) | fresh_makers()
    found = []
    for seed in options.seeds:
        for name in options.arms:
            file = options.out / f"{name}-{seed}" / f"{name_of}.json"
            found.append(checkpoint(file, lambda: judged(known[name], seed, file.parent, options.lag_ms)))  # noqa: B023
    save_json(found, options.out / f"{name_of}.json")
    write_tables(options.out, table(found))


def judged(maker: Maker, seed: int, folder: Path, lag_ms: int) -> dict[str, Any]:
    """Each parameter of an arm: value, standard error, truth."""
    data = make_dataset(maker, seed, folder, USED)
    arm = read_arm(trained(data, folder / "prior.tauext"), maker.model, data, {})
    late = [replace(one, tau=delayed(one.tau, -1e-3 * lag_ms, one.rate_hz)) for one in arm.training]
    posterior = find_posterior(replace(arm, training=late))
    values, errors = posterior.values(posterior.mean), posterior.standard_errors(seed)
    true, truth = arm_of(maker, seed), np.full(values.shape, np.nan)
    truth[:, :2] = true_friction(maker, seed, arm)
    for j, link in enumerate(true.tree.links):
        truth[j, 2:7] = link.rotor_inertia, link.mass, *link.com
    rows = {what: [values[:, k].tolist(), errors[:, k].tolist(), truth[:, k].tolist()] for k, what in enumerate(VALUES)}
    return {"arm": maker.name, "seed": seed, "fresh": maker.fresh, "values": rows}


def true_friction(maker: Maker, seed: int, known: Arm) -> np.ndarray:
    """Damping and frictionloss that come closest to the friction which acted in training, (n, 2)."""
    arm, n, observer = arm_of(maker, seed), len(maker.joints), known.setup.observer
    plain = _core.ObserverSettings(
        gain_per_s=observer.gain_per_s, timing=observer.timing, sample_period_ns=observer.sample_period_ns,
        network_stride=observer.network_stride,
    )  # fmt: skip
    settings = sliding_friction(np.zeros(n), np.zeros(n), known.speed)
    tree = load_tree(maker.model, maker.joints)
    squares, moments, none = np.zeros((n, 2, 2)), np.zeros((n, 2)), empty(tree)
    for number, take in enumerate(USED):
        if take.part != "train":
            continue
        rng, samples = maker.random(seed, 1 + number), round(take.minutes * 60 * RATE_HZ)
        contacts = draw_contacts(take.contacts, take.minutes * 60, n, rng)  # in the order of write_take
        run = simulate(
            arm, tree, draw_motion(maker, samples, RATE_HZ, rng), maker.torque_nm, contacts, take.warm_from_s
        )
        keep = slice(0, None, RATE_HZ // maker.rate_hz)
        t_ns = np.arange(samples, dtype=np.int64)[keep] * (1_000_000_000 // RATE_HZ)
        q, dq, tau = (
            np.ascontiguousarray(one[keep]) for one in (run.q, velocity(run.q, 200.0, 1 / RATE_HZ), run.friction_nm)
        )
        seen = _core.observe(none, plain, t_ns, q, dq, tau, _core.PriorSettings())
        rows = np.flatnonzero(seen.warm)[:: plain.network_stride]
        X = _core.prior_regressors(none, plain, settings, t_ns, q, dq, tau, rows)
        for j in range(n):
            own = X[:, 2 * j : 2 * j + 2]
            squares[j] += own.T @ own
            moments[j] -= own.T @ seen.residual[rows, j]
    return np.array([np.linalg.solve(a, b) for a, b in zip(squares, moments, strict=True)])


GROUPS = {"damping": ("damping",), "frictionloss": ("frictionloss",), "armature": ("armature",), "mass": ("mass",),
          "centre of mass": ("com_x", "com_y", "com_z")}  # fmt: skip


def table(found: Sequence[dict[str, Any]]) -> list[str]:
    """Share of parameters within two standard errors of the truth, and the median standard error as a share of it."""
    lines = head("arm | seed | " + " | ".join(GROUPS))
    runs = [*((one["arm"], str(one["seed"]), [one]) for one in found)]
    runs += [(f"**all, {word}**", "", some) for word, some in groups(found)]
    for name, seed, some in runs:
        cells = []
        for parts in GROUPS.values():
            value, error, truth = (
                np.concatenate([one["values"][part][k] for one in some for part in parts]) for k in range(3)
            )
            within = np.abs(value - truth) <= 2 * error
            size = "" if parts[0].startswith("com") else f", ± {np.median(error / np.abs(truth)):.0%}"
            cells.append(f"{within.sum()} of {len(within)}{size}")
        lines.append(table_row(name, seed, *cells))
    return lines


def groups(found: Sequence[dict[str, Any]]) -> list[tuple[str, list[dict[str, Any]]]]:
    """Arms that methods were fixed on, and those that are run once."""
    parts = [
        ("development", [one for one in found if not one["fresh"]]),
        ("run once", [one for one in found if one["fresh"]]),
    ]
    return [(word, some) for word, some in parts if some]


if __name__ == "__main__":
    main()
