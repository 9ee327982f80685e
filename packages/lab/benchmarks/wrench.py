"""Errors of forces at the flange: pushes of 20 N and more on simulated arms, with bundles as users have them.

    python packages/lab/benchmarks/wrench.py MODELS UNSEEN OUT [--arms panda ur5 ...] [--pushes 120] [--draw 1]

MODELS: folder of ur5_robot.urdf, panda.urdf and kinova.urdf. UNSEEN: what unseen_arms.py wrote, whose datasets bundles
are trained on here: `own`, whose torque constants training found, and `true`, which is given the true ones. OUT gets
the bundles, wrench.json and wrench.md. The method was fixed on pushes of draw 0 on the Panda; some of the UR5 were
inspected.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import arguments, estimates, head, save_json, short, table_row, trained, write_tables
from scipy.stats import chi2
from unseen.arms import Maker, arm_of, direction, fresh_makers, makers
from unseen.recordings import logged, nm_per_given
from unseen.simulation import RATE_HZ, Contact, draw_motion, simulate, touched_point

from tauext import _core
from tauext.robot.read import load_tree

ARMS = ("panda", "ur5", "seven_axis", "kinova", "offset_wrist", "light_arm")
"""The last two are arms that no method was fixed on."""
SLOT_S, FIRST_S, PUSH_S, LOOK_S = 4.0, 8.0, 1.0, 0.6
"""One push a slot, evaluated LOOK_S after it begins: five times 1/K0 after it has risen."""
KDL_FILTER = 0.5
"""Of a sample, kept from the one before: the default of KDL's ChainExternalWrenchEstimator."""


def main() -> None:
    parser = arguments(__doc__, "models", "unseen", "out", arms=ARMS, seed=0)
    parser.add_argument("--pushes", type=int, default=120, help="an arm")
    parser.add_argument("--draw", type=int, default=1, help="of the pushes")
    options = parser.parse_args()
    rows: list[dict] = []
    for name in options.arms:
        rows += judged((makers(options.models) | fresh_makers())[name], options)
        save_json(short(rows), options.out / "wrench.json")
    write_tables(options.out, tables(rows), name="wrench")


def bundle_of(maker: Maker, options: argparse.Namespace, which: str) -> _core.Bundle:
    """Of recipe prior, with constants that training found or the true ones; not where it is there."""
    words: list[str | Path] = []
    path = options.out / maker.name / f"{which}.tauext"
    if which == "true":
        settings = path.with_suffix(".toml")
        settings.parent.mkdir(parents=True, exist_ok=True)
        settings.write_text("torque_share = 0.005\n")
        factors = nm_per_given(maker, options.seed)
        words += ["--torque-constants", *(f"{one:.6g}" for one in factors), "--config", settings]
    return _core.Bundle.load(str(trained(options.unseen / maker.name / "urdf", path, *words)))


def judged(maker: Maker, options: argparse.Namespace) -> list[dict]:
    """One row a push and bundle: the estimate LOOK_S after it began, against the truth; not where there is none."""
    arm, rng = arm_of(maker, options.seed), maker.random(options.seed, 700 + options.draw)
    contacts = [
        pushed(len(maker.joints) - 1, FIRST_S + k * SLOT_S + rng.uniform(0, 2), rng) for k in range(options.pushes)
    ]
    setpoints = draw_motion(maker, round((FIRST_S + options.pushes * SLOT_S) * RATE_HZ), RATE_HZ, rng)
    run = simulate(arm, load_tree(maker.model, maker.joints), setpoints, maker.torque_nm, contacts, 660.0)
    constants = arm.nm_per_ampere / nm_per_given(maker, options.seed)
    made = argparse.Namespace(**logged(maker, arm, run, constants, rng), temperature=None)
    rows = []
    for which in ("own", "true"):
        bundle = bundle_of(maker, options, which)
        said = estimates(bundle, made)
        plain = low_pass_kept(said["residual"])
        for contact in contacts:
            at = int(np.searchsorted(made.t_ns, round((contact.start_s + LOOK_S) * 1e9)))
            if np.isfinite(said["tau_ext"][at]).all() and np.isfinite(said["sigma_nm"][at]).all():
                point = touched_point(arm.tree, contact).tolist()
                row = row_at(bundle, contact, point, made, said, plain[at], at)
                rows.append({"arm": maker.name, "bundle": which} | row)
    return rows


def pushed(link: int, start_s: float, rng: np.random.Generator) -> Contact:
    """On the last link, anywhere on its length, in any direction; more force takes small drives to their limits."""
    unit, end, share = tuple(direction(rng).tolist()), start_s + PUSH_S, rng.uniform(0.2, 1.0)
    return Contact("push", start_s, end, link, share, unit, float(rng.uniform(20.0, 45.0)), (start_s, end))


def low_pass_kept(residual: np.ndarray) -> np.ndarray:
    """KDL's filter of its estimate, every sample."""
    out, now = np.empty_like(residual), np.zeros(residual.shape[1])
    for k, row in enumerate(residual):
        out[k] = now = KDL_FILTER * now + (1 - KDL_FILTER) * np.nan_to_num(row)
    return out


def row_at(
    bundle: _core.Bundle,
    contact: Contact,
    point: list,
    made: argparse.Namespace,
    said: dict,
    plain: np.ndarray,
    at: int,
) -> dict:
    """The estimate of one push at a sample."""
    model, joint, q = _core.WrenchModel(bundle), bundle.links[contact.link].joint_name, made.q[at].tolist()
    truth = contact.peak_n * np.array(contact.direction)
    sample = (made.q[at : at + 1], *(said[name][at : at + 1] for name in ("tau_ext", "sigma_nm")))
    jacobian = model.columns(joint, q)
    rotation = jacobian[3:] @ np.linalg.pinv(model.columns(joint, q, axes=_core.WrenchAxes.frame)[3:])
    whole = np.r_[truth, np.cross(rotation @ point, truth)]
    moved = np.abs(np.diff(made.q[at - 20 : at + 1], axis=0)).max()
    row: dict = {"force_n": contact.peak_n, "moving": bool(moved > 1e-4)}
    for kind, where, wanted in (("force", point, truth), ("wrench", None, whole)):
        columns = model.wrenches(
            joint, *sample, where, contact_sigma_nm=said["contact_sigma_nm"][at : at + 1], dq=made.dq[at : at + 1]
        )
        found = {name: column[0] for name, column in columns.items()}
        off = np.r_[found["force"], found["moment"]][: len(wanted)] - wanted
        distance = float(off @ np.linalg.solve(found["covariance"], off))
        spread = np.sqrt(np.linalg.eigvalsh(found["covariance"][:3, :3]))
        row[kind] = error_of(found["force"], truth) | {
            "distance": distance,
            "held": bool(distance <= chi2.ppf(0.95, len(wanted))),
            "beyond_3": bool(distance > chi2.ppf(0.9973, len(wanted))),
            "blind": int(found["blind"]),
            "sigma_n": float(np.exp(np.log(spread).mean())),
            "consistent": float(found["consistent"]),
        }
    row["kdl"] = error_of((np.linalg.pinv(jacobian.T, rcond=1e-5) @ plain)[:3], truth)
    return row


def error_of(found: np.ndarray, truth: np.ndarray) -> dict:
    """Newtons and degrees."""
    size = np.linalg.norm(found) * np.linalg.norm(truth)
    angle = float(np.degrees(np.arccos(np.clip(found @ truth / max(size, 1e-9), -1, 1))))
    return {"off_n": float(np.linalg.norm(found - truth)), "off_deg": angle}


def tables(rows: list[dict]) -> list[str]:
    """By arm, then by whether the arm moves."""
    lines = head(
        "arm | constants | reported as | pushes | error, N | error, deg | in 95 % | sigma, N | blind "
        "| beyond 3 sigma, not blind"
    )
    groups = [(arm, [row for row in rows if row["arm"] == arm]) for arm in dict.fromkeys(row["arm"] for row in rows)]
    groups += [("**all**", rows), ("moving", [row for row in rows if row["moving"]])]
    for name, of in [*groups, ("standing", [row for row in rows if not row["moving"]])]:
        for which in dict.fromkeys(row["bundle"] for row in of):
            some = [row for row in of if row["bundle"] == which]
            for kind, words in (("force", "force at the point"), ("wrench", "wrench"), ("kdl", "KDL")):
                lines.append(table_row(name, which, words, len(some), *cells([row[kind] for row in some])))
    return lines


def cells(said: list[dict]) -> list[str]:
    found = [f"{np.median([one[name] for one in said]):.1f}" for name in ("off_n", "off_deg")]
    if "held" not in said[0]:
        return [*found, "", "", "", ""]
    held, blind = (f"{np.mean([bool(one[name]) for one in said]):.0%}" for name in ("held", "blind"))
    beyond = sum(one["beyond_3"] and not one["blind"] for one in said)
    return [*found, held, f"{np.median([one['sigma_n'] for one in said]):.1f}", blind, str(beyond)]


if __name__ == "__main__":
    main()
