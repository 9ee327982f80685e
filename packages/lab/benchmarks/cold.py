"""How the monitor follows friction that changes: over a shift, at a cold start, after hours of rest, with temperature.

    python packages/lab/benchmarks/cold.py MODELS OUT [--arms rig ur5 ...] [--limits 1 1.5]

MODELS: folder of ur5_robot.urdf, panda.urdf and kinova.urdf. Each arm is trained warm (recipe prior) and then works
with other friction, with the same motion and the same contacts in every row. rig: the simulated rig, four minutes of
training; other names: arms of unseen, twelve minutes of training. OUT/ARM keeps recordings and bundle, which a later
run uses again: run the script in two checkouts to compare them. OUT/cold.md gets the table.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import arguments, collisions_begin, head, in_parallel, table_row, tauext, trained, write_tables
from tauext_lab.sim.collect import simulate_recording
from tauext_lab.sim.config import RigConfig
from unseen.arms import Maker, TrueArm, arm_of, fresh_makers, makers
from unseen.recordings import TAKES, logged, make_dataset, told_constants
from unseen.simulation import RATE_HZ, draw_contacts, draw_motion, simulate

from tauext import _core
from tauext.config import DriftConfig
from tauext.robot.read import load_tree

PIECE_S, BREAK_S, REST_S = 45.0, 1.0, 3 * 3600.0
CONTACTS = 2
"""In a piece."""
REGIONS = ("sliding_limit_nm", "near_stiction_limit_nm")
LIMITS = (*REGIONS, *(f"contact_{region}" for region in REGIONS))
AFTER_S = 1.0
"""After a contact, in which an alarm is no false one."""


@dataclass(frozen=True)
class Friction:
    """Of a piece, as shares of the friction that the arm was trained with."""

    coulomb: float = 1.0
    viscous: float = 1.0
    static: float = 1.0
    """Beside that of Coulomb's friction."""
    rested: bool = False
    """The arm stood for REST_S before, and the monitor ran on."""


def both(share: float) -> Friction:
    return Friction(share, share)


def greased(k: int) -> Friction:
    """The k-th piece after hours of rest: it breaks away harder, and its grease is stiff for some minutes."""
    left = float(np.exp(-k * PIECE_S / 90))
    return Friction(1 + 0.1 * left, 1 + 0.3 * left, 1 + 0.4 * left, rested=k == 0)


LONG, SHORT = 40, 14
COLDER = Friction(1.08, 1.25)
THERMOMETER = "the same, with a thermometer and its true coefficients"
REFERENCE_C, COLD_C = 22.0, 12.0
CHANGES: dict[str, list[Friction]] = {
    "none": [both(1.0)] * LONG,
    "falls to 85 % in 30 minutes": [both(share) for share in np.linspace(1, 0.85, LONG)],
    "115 % at the start, falls within 5 minutes": [both(1 + 0.15 * np.exp(-k * PIECE_S / 300)) for k in range(SHORT)],
    "half from the start": [both(0.5)] * SHORT,
    "double from the start": [both(2.0)] * SHORT,
    "3 h of rest: static 140 %, viscous 130 %": [both(1.0)] * 4 + [greased(k) for k in range(SHORT - 4)],
    "10 °C colder: Coulomb 108 %, viscous 125 %": [COLDER] * SHORT,
    THERMOMETER: [COLDER] * SHORT,
}


@dataclass(frozen=True)
class Work:
    """Signals of an arm with the true contacts."""

    t_ns: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    tau: np.ndarray
    contacts: np.ndarray
    """Begin and end, [ns], (contacts, 2)."""


def main() -> None:
    parser = arguments(__doc__, "models", "out", arms=("rig", "ur5"), workers=os.cpu_count() or 1)
    parser.add_argument("--limits", type=float, nargs="+", default=[1.0, 1.5], help="factors on all limits")
    parser.add_argument("--changes", nargs="+", default=list(CHANGES))
    options = parser.parse_args()
    columns = "".join(f" | false, limits x {f:g} | hits | last false" for f in options.limits)
    lines = head(f"arm | friction | hours | RMSE, in limits{columns}")
    print("\n".join(lines))
    for name in options.arms:
        folder = options.out / name
        bundle = rig_bundle(folder) if name == "rig" else arm_bundle(options.models, name, folder)
        works = in_parallel(options.workers, work, [(options.models, name, folder, one) for one in options.changes])
        for change, made in zip(options.changes, works, strict=True):
            lines.append(judged(name, change, bundle, made, options.limits))
            print(lines[-1], flush=True)
    write_tables(options.out, lines, name="cold")


def judged(name: str, change: str, bundle: Path, made: Work, factors: list[float]) -> str:
    """The row of one change, for each factor on the limits."""
    cells: list[str] = []
    hours = (made.t_ns[-1] - made.t_ns[0] - REST_S * 1e9 * ("rest" in change)) / 3.6e12
    rmse = ""
    for factor in factors:
        one = _core.Bundle.load(str(bundle))
        one.drift.friction_share = DriftConfig().friction_share  # of this version, whatever made the bundle
        for limit in LIMITS:
            setattr(one, limit, (factor * np.array(getattr(one, limit))).tolist())
        celsius = with_thermometer(one, made) if change == THERMOMETER else None
        found = _core.estimate(one, made.t_ns, made.q, made.dq, made.tau, 1, temperature=celsius)
        begun = collisions_begin(found["held_alarm"], made.t_ns)
        near = (begun[:, None] >= made.contacts[:, 0]) & (begun[:, None] <= made.contacts[:, 1] + AFTER_S * 1e9)
        false = begun[~near.any(axis=1)]
        begin, end = np.searchsorted(made.t_ns, made.contacts.T + np.array([[0], [2e8]]))
        held = np.concatenate([[0], np.cumsum(found["held_alarm"] == 2)])
        hits = int((held[end] > held[begin]).sum())
        last = f"{(false[-1] - made.t_ns[0]) / 1e9:.0f} s" if len(false) else "–"
        cells += [f"{len(false)}", f"{hits}/{len(made.contacts)}", last]
        if not rmse:
            free = np.ones(len(made.t_ns), dtype=bool)
            for b, e in zip(*np.searchsorted(made.t_ns, made.contacts.T + np.array([[-1e8], [1e9]])), strict=True):
                free[b:e] = False
            rows = free & (found["health"] == 1)
            ratio = np.sqrt((found["tau_ext"][rows] ** 2).mean(axis=0)) / np.array(one.sliding_limit_nm)
            rmse = "/".join(f"{r:.2f}" for r in ratio)
    return table_row(name, change, f"{hours:.2f}", rmse, *cells)


def with_thermometer(bundle: _core.Bundle, made: Work) -> np.ndarray:
    """Temperatures of the colder arm; the bundle gets what they do to its friction."""
    joints, prior = bundle.joints, bundle.prior
    temperature = prior.temperature
    temperature.reference_c, temperature.reach_k = [REFERENCE_C] * joints, [20.0] * joints
    temperature.coulomb_per_10k = [1 - COLDER.coulomb] * joints
    temperature.viscous_per_10k = [1 - COLDER.viscous] * joints
    prior.temperature, bundle.prior = temperature, prior
    return np.full(made.q.shape, COLD_C)


def work(models: Path, name: str, folder: Path, change: str) -> Work:
    """The arm's work with this change; kept in the folder."""
    kept = folder / f"work-{list(CHANGES).index(change)}.npz"
    if not kept.exists():
        make = rig_piece if name == "rig" else arm_pieces(models, name)
        pieces, start = [], 0
        for k, friction in enumerate(CHANGES[change]):
            start += round(REST_S * 1e9) if friction.rested else 0
            piece = make(friction, k)
            pieces.append(piece | {"t_ns": piece["t_ns"] + start, "contacts": piece["contacts"] + start})
            start = int(pieces[-1]["t_ns"][-1]) + round(BREAK_S * 1e9)
        folder.mkdir(parents=True, exist_ok=True)
        joined: dict[str, Any] = {key: np.concatenate([piece[key] for piece in pieces]) for key in pieces[0]}
        np.savez(kept, **joined)
    with np.load(kept) as file:
        return Work(**{key: np.ascontiguousarray(file[key]) for key in file.files})


# --- The paper's rig.


def rig_bundle(folder: Path) -> Path:
    data = folder / "data"
    if not (data / "split.json").exists():
        hours = ("--calibration-hours", "0.1", "--test-hours", "0.1")
        tauext("simulate", "--out", data, "--minutes", "6", "--collision-recordings", "2", *hours)
    return trained(data, folder / "bundle.tauext")


def rig_piece(friction: Friction, k: int) -> dict[str, np.ndarray]:
    joints = tuple(
        replace(
            one,
            coulomb_nm=friction.coulomb * one.coulomb_nm,
            load_share=friction.coulomb * one.load_share,
            static_nm=friction.static * friction.coulomb * one.static_nm,
            viscous_nm_s_rad=friction.viscous * one.viscous_nm_s_rad,
        )
        for one in RigConfig().friction
    )
    config = replace(RigConfig(), friction=joints, collisions_per_recording=CONTACTS)
    made = simulate_recording(config, "pulses", PIECE_S, 7, k)
    signals = {name: getattr(made, name) for name in ("t_ns", "q", "dq", "tau")}
    return signals | {"contacts": spans(made.contact, made.t_ns)}


def spans(touched: np.ndarray | None, t_ns: np.ndarray) -> np.ndarray:
    """Begin and end of each contact, (contacts, 2), [ns]."""
    assert touched is not None
    edges = np.flatnonzero(np.diff(np.concatenate([[0], touched, [0]])))
    return t_ns[np.minimum(edges, len(t_ns) - 1)].reshape(-1, 2)


# --- Arms with motor currents.


def maker_of(models: Path, name: str) -> Maker:
    return (makers(models) | fresh_makers())[name]


def arm_bundle(models: Path, name: str, folder: Path) -> Path:
    data = make_dataset(maker_of(models, name), 0, folder, TAKES, 1)
    return trained(data, folder / "bundle.tauext")


TRAINED_WARMTH = 0.7
"""Of the warming up that training contains, at its middle."""


def arm_pieces(models: Path, name: str) -> Callable[[Friction, int], dict[str, np.ndarray]]:
    maker = maker_of(models, name)
    arm, known = arm_of(maker, 0), load_tree(maker.model, maker.joints)
    constants = told_constants(maker, 0, True)
    true = arm.nm_per_ampere if isinstance(constants, str) else np.array(constants)

    def make(friction: Friction, k: int) -> dict[str, np.ndarray]:
        rng = np.random.default_rng([31, k])
        run = simulate(
            changed(arm, friction),
            known,
            draw_motion(maker, round(PIECE_S * RATE_HZ), RATE_HZ, rng),
            maker.torque_nm,
            contacts := draw_contacts(CONTACTS, PIECE_S, len(maker.joints), rng),
            0.0,
        )
        kept = logged(maker, arm, run, 1.0 if isinstance(constants, str) else true, rng)
        return kept | {"contacts": np.array([[one.start_s * 1e9, one.end_s * 1e9] for one in contacts], dtype=np.int64)}

    return make


def changed(arm: TrueArm, friction: Friction) -> TrueArm:
    """The arm in the middle of its training, with this friction and nothing that warms up."""
    warm = 1 - TRAINED_WARMTH * arm.warm_drop
    return replace(
        arm,
        coulomb_nm=friction.coulomb * warm * arm.coulomb_nm,
        load_share=friction.coulomb * arm.load_share,
        static_share=friction.static * arm.static_share,
        presliding_rad=friction.static * friction.coulomb * warm * arm.presliding_rad,
        viscous_nm_s_rad=friction.viscous * warm * arm.viscous_nm_s_rad,
        warm_drop=np.zeros_like(arm.warm_drop),
    )


if __name__ == "__main__":
    main()
