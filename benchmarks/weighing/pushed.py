"""Pushes on an arm that carries something, and the same pushes on the same motion of the arm that carries nothing."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from unseen.arms import Maker, TrueArm, true_arm
from unseen.contacts import draw_contacts
from unseen.motions import draw_motion
from unseen.recordings import _peak, _write_csv, motor_temperature
from unseen.simulation import RATE_HZ, simulate

from tauext.robot.load import load_tree
from weighing.takes import WARM_S, carried, with_load

PAIRS = 8
"""Of the loads of the weighing trial, the first ones."""
LENGTH_S, CONTACTS = 60.0, 8
BARE, LOADED = "bare", "loaded"
RAN_AWAY = 2.0
"""Times a joint's most speed: so fast is no arm that its drive still holds, and real drives stop before."""


def pair_names(number: int) -> tuple[str, str]:
    """Of the recording without a load, and with one."""
    return f"pushed-{number}-{BARE}", f"pushed-{number}-{LOADED}"


def write_pair(maker: Maker, seed: int, number: int, folder: Path) -> None:
    """Simulate both and write NAME.csv and NAME.truth.json, contacts with their peak torques; not what is there."""
    if all((folder / f"{name}.truth.json").exists() for name in pair_names(number)):
        return
    bare = true_arm(maker, maker.random(seed, 0))
    loaded = replace(bare, tree=with_load(bare, carried(maker, seed)[f"load-{number:02d}"]))
    for trial in range(5):  # a heavy load far out may shake an arm whose drive knows nothing of it
        try:
            for name, arm in zip(pair_names(number), (bare, loaded), strict=True):
                write_pushed(maker, seed, arm, 5000 + 10 * number + trial, folder / name)
            return
        except RuntimeError:
            continue
    raise RuntimeError(f"{maker.name}: no motion of load {number} can be simulated")


def write_pushed(maker: Maker, seed: int, arm: TrueArm, stream: int, path: Path) -> None:
    """One recording; what is drawn depends on the stream alone."""
    rng = maker.random(seed, stream)
    contacts = draw_contacts(CONTACTS, LENGTH_S, len(maker.joints), rng)
    setpoints = draw_motion(maker, round(LENGTH_S * RATE_HZ), RATE_HZ, rng)
    known = load_tree(maker.model, maker.joints)
    run = simulate(arm, known, setpoints, maker.torque_nm, contacts, WARM_S)
    if (np.abs(np.diff(run.q, axis=0)) * RATE_HZ > RAN_AWAY * np.array(maker.speed_rad_s)).any():
        raise RuntimeError("the drive lost the arm")
    celsius = motor_temperature(arm, WARM_S, len(run.q), maker.random(seed, stream + 5))
    _write_csv(path.with_suffix(".csv"), maker, arm, run, contacts, rng, celsius)
    truth = [asdict(one) | {"peak_nm": _peak(run.tau_ext, one).tolist()} for one in contacts]
    path.with_suffix(".truth.json").write_text(json.dumps(truth, indent=1) + "\n")
