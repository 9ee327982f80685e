"""Errors of forces at the flange: pushes of 20 N and more on simulated arms, with bundles as users have them.

    python benchmarks/wrench.py MODELS UNSEEN OUT [--arms panda ur5 ...] [--pushes 120] [--seed 0] [--draw 1]

MODELS: folder of ur5_robot.urdf, panda.urdf and kinova.urdf. UNSEEN: what `benchmarks/unseen_arms.py` wrote, whose
datasets bundles are trained on here: `own`, whose torque constants training found, and `true`, which is given the true
ones. OUT gets the bundles, wrench.json and wrench.md. The method was fixed on pushes of draw 0 on the Panda; some of
the UR5 were inspected.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from common import arguments, head, save_json, trained, write_tables
from scipy.stats import chi2
from tauext_lab.sim.rig import velocity
from unseen.arms import Maker, TrueArm, arm_of, direction, fresh_makers, makers
from unseen.recordings import DRIVE_VELOCITY_RAD_S, readings, told_constants
from unseen.simulation import RATE_HZ, Contact, Run, draw_motion, simulate, touched_point

from tauext import _core
from tauext.robot.read import load_tree

ARMS = ("panda", "ur5", "seven_axis", "kinova", "offset_wrist", "light_arm")
"""The last two are arms that no method was fixed on."""
FORCES_N = (20.0, 45.0)
"""Larger forces take the drives of the smaller wrists to their limits."""
SLOT_S, FIRST_S, PUSH_S, LOOK_S = 4.0, 8.0, 1.0, 0.6
"""One push a slot, evaluated LOOK_S after it begins: five times 1/K0 after it has risen."""
WARM_S = 660.0
KDL_FILTER = 0.5
"""Of a sample, kept from the one before: the default of KDL's ChainExternalWrenchEstimator."""
STREAM = 700
HELD, THREE_SIGMA = 0.95, 0.9973


def main() -> None:
    parser = arguments(__doc__, "models", "unseen", "out", arms=ARMS, seed=0)
    parser.add_argument("--pushes", type=int, default=120, help="an arm")
    parser.add_argument("--draw", type=int, default=1, help="of the pushes")
    options = parser.parse_args()
    rows: list[dict] = []
    for name in options.arms:
        maker = (makers(options.models) | fresh_makers())[name]
        bundles = {which: bundle_of(maker, options, which) for which in ("own", "true")}
        rows += judged(maker, bundles, options)
        save_json(short(rows), options.out / "wrench.json")
    write_tables(options.out, tables(rows), name="wrench")


def bundle_of(maker: Maker, options: argparse.Namespace, which: str) -> _core.Bundle:
    """Of recipe prior, with constants that training found or the true ones; not where it is there."""
    words: list[str | Path] = []
    path = options.out / maker.name / f"{which}.tauext"
    if which == "true":
        factors = arm_of(maker, options.seed).nm_per_ampere / told(maker, options.seed)
        settings = path.with_suffix(".toml")
        settings.parent.mkdir(parents=True, exist_ok=True)
        settings.write_text("torque_share = 0.005\n")
        words += ["--torque-constants", *(f"{one:.6g}" for one in factors), "--config", settings]
    return _core.Bundle.load(str(trained(options.unseen / maker.name / "urdf", path, *words)))


def told(maker: Maker, seed: int) -> np.ndarray:
    """What currents of a recording are multiplied by when it is imported."""
    constants = told_constants(maker, seed, True)
    return np.ones(len(maker.joints)) if constants == "unknown" else np.array(constants, dtype=float)


def judged(maker: Maker, bundles: dict[str, _core.Bundle], options: argparse.Namespace) -> list[dict]:
    """One row a push and bundle."""
    arm, rng = arm_of(maker, options.seed), maker.random(options.seed, STREAM + options.draw)
    contacts, signals = pushes_of(maker, arm, options.pushes, told(maker, options.seed), rng, WARM_S)
    rows = []
    for which, bundle in bundles.items():
        said = _core.estimate(bundle, *signals, 1)
        found = told_of(bundle, arm, contacts, signals, said, low_pass_kept(said["residual"]))
        rows += [{"arm": maker.name, "bundle": which} | one for one in found]
    return rows


def pushes_of(
    maker: Maker, arm: TrueArm, count: int, constants: np.ndarray, rng: np.random.Generator, warm_s: float
) -> tuple[list[Contact], tuple[np.ndarray, ...]]:
    """So many pushes on the last link, and t_ns, q, dq, tau."""
    contacts = [pushed(len(maker.joints) - 1, FIRST_S + k * SLOT_S + rng.uniform(0, 2), rng) for k in range(count)]
    setpoints = draw_motion(maker, round((FIRST_S + count * SLOT_S) * RATE_HZ), RATE_HZ, rng)
    known = load_tree(maker.model, maker.joints)
    run = simulate(arm, known, setpoints, maker.torque_nm, contacts, warm_s)
    return contacts, logged(maker, arm, run, constants, rng)


def pushed(link: int, start_s: float, rng: np.random.Generator) -> Contact:
    """On the last link, anywhere on its length, in any direction."""
    unit, end, share = tuple(direction(rng).tolist()), start_s + PUSH_S, rng.uniform(0.2, 1.0)
    return Contact("push", start_s, end, link, share, unit, float(rng.uniform(*FORCES_N)), (start_s, end))


def logged(
    maker: Maker, arm: TrueArm, run: Run, constants: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, ...]:
    """t_ns, q, dq, tau at the controller's rate, as an import would have them; stamps do not jitter."""
    q, ampere = readings(maker, arm, run, rng)
    keep = slice(0, None, RATE_HZ // maker.rate_hz)
    t_ns = (np.arange(len(q), dtype=np.int64) * (1_000_000_000 // RATE_HZ))[keep]
    dq = velocity(q, DRIVE_VELOCITY_RAD_S, 1 / RATE_HZ)
    return t_ns, *(np.ascontiguousarray(signal[keep]) for signal in (q, dq, ampere * constants))


def low_pass_kept(residual: np.ndarray) -> np.ndarray:
    """KDL's filter of its estimate, every sample."""
    out, now = np.empty_like(residual), np.zeros(residual.shape[1])
    for k, row in enumerate(residual):
        now = KDL_FILTER * now + (1 - KDL_FILTER) * np.nan_to_num(row)
        out[k] = now
    return out


def told_of(
    bundle: _core.Bundle, arm: TrueArm, contacts: list[Contact], signals: tuple, said: dict, plain: np.ndarray
) -> list[dict]:
    """The estimate of each push, LOOK_S after it began, against the truth; not where there is no estimate."""
    rows, (t_ns, q, dq, _) = [], signals
    for contact in contacts:
        at = int(np.searchsorted(t_ns, round((contact.start_s + LOOK_S) * 1e9)))
        if np.isfinite(said["tau_ext"][at]).all() and np.isfinite(said["sigma_nm"][at]).all():
            rows.append(told_at(bundle, arm, contact, q, dq, said, plain, at))
    return rows


def told_at(bundle: _core.Bundle, arm, contact: Contact, q, dq, said: dict, plain: np.ndarray, at: int) -> dict:
    """The estimate of one push at a sample."""
    model, joint = _core.WrenchModel(bundle), bundle.links[contact.link].joint_name
    point = touched_point(arm.tree, contact).tolist()
    truth = contact.peak_n * np.array(contact.direction)
    sample = (q[at : at + 1], *(said[name][at : at + 1] for name in ("tau_ext", "sigma_nm")))
    sigma, speed = said["contact_sigma_nm"][at : at + 1], dq[at : at + 1]
    turned = model.columns(joint, q[at].tolist(), axes=_core.WrenchAxes.frame)[3:]
    rotation = model.columns(joint, q[at].tolist())[3:] @ np.linalg.pinv(turned)  # base from frame
    whole = np.r_[truth, np.cross(rotation @ point, truth)]
    row: dict = {"force_n": contact.peak_n, "moving": bool(np.abs(np.diff(q[at - 20 : at + 1], axis=0)).max() > 1e-4)}
    for kind, where, wanted in (("force", point, truth), ("wrench", None, whole)):
        found = {
            name: column[0]
            for name, column in model.wrenches(joint, *sample, where, contact_sigma_nm=sigma, dq=speed).items()
        }
        off = np.r_[found["force"], found["moment"]][: len(wanted)] - wanted
        distance = float(off @ np.linalg.solve(found["covariance"], off))
        spread = np.sqrt(np.linalg.eigvalsh(found["covariance"][:3, :3]))
        row[kind] = error_of(found["force"], truth) | {
            "distance": distance,
            "held": bool(distance <= chi2.ppf(HELD, len(wanted))),
            "beyond_3": bool(distance > chi2.ppf(THREE_SIGMA, len(wanted))),
            "blind": int(found["blind"]),
            "sigma_n": float(np.exp(np.log(spread).mean())),
            "consistent": float(found["consistent"]),
        }
    jacobian = model.columns(joint, q[at].tolist())
    row["kdl"] = error_of((np.linalg.pinv(jacobian.T, rcond=1e-5) @ plain[at])[:3], truth)
    return row


def short(value: Any) -> Any:
    """The same content with numbers to four digits."""
    if isinstance(value, dict):
        return {name: short(one) for name, one in value.items()}
    if isinstance(value, list):
        return [short(one) for one in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value


def error_of(found: np.ndarray, truth: np.ndarray) -> dict:
    """Newtons and degrees."""
    size = np.linalg.norm(found) * np.linalg.norm(truth)
    angle = float(np.degrees(np.arccos(np.clip(found @ truth / max(size, 1e-9), -1, 1))))
    return {"off_n": float(np.linalg.norm(found - truth)), "off_deg": angle}


KINDS = {"force": "force at the point", "wrench": "wrench", "kdl": "KDL"}
COLUMNS = (
    "constants | reported as | pushes | error, N | error, deg | in 95 % | sigma, N | blind | beyond 3 sigma, not blind"
)


def tables(rows: list[dict]) -> list[str]:
    """By arm, then by whether the arm moves."""
    lines = head(f"arm | {COLUMNS}")
    for arm in [*dict.fromkeys(row["arm"] for row in rows), None]:
        for which in ("own", "true"):
            some = [row for row in rows if row["bundle"] == which and arm in (None, row["arm"])]
            lines += [line(arm or "**all**", which, kind, [row[kind] for row in some]) for kind in KINDS]
    lines += ["", *head(f"arm is | {COLUMNS}")]
    for moving in (True, False):
        for which in ("own", "true"):
            some = [row for row in rows if row["bundle"] == which and row["moving"] == moving]
            name = "moving" if moving else "standing"
            lines += [line(name, which, kind, [row[kind] for row in some]) for kind in ("force", "wrench") if some]
    return lines


def line(arm: str, which: str, kind: str, said: list[dict]) -> str:
    """Of the table."""
    off, angle = (np.median([one[name] for one in said]) for name in ("off_n", "off_deg"))
    start = f"| {arm} | {which} | {KINDS[kind]} | {len(said)} | {off:.1f} | {angle:.1f} "
    if kind == "kdl":
        return f"{start}| | | | |"
    held, blind = (np.mean([bool(one[name]) for one in said]) for name in ("held", "blind"))
    silent = sum(one["beyond_3"] and not one["blind"] for one in said)
    size = np.median([one["sigma_n"] for one in said])
    return f"{start}| {held:.0%} | {size:.1f} | {blind:.0%} | {silent} ({silent / len(said):.1%}) |"


if __name__ == "__main__":
    main()
