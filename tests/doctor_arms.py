"""Arms, drives and clocks on which the doctor must find nothing where nothing is wrong."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from made_motion import Drive
from trees import Part, planar_rig, seven_axis, six_axis

UP, ACROSS = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])


def scara() -> list[Part]:
    """Two upright axes, a horizontal arm, and a wrist that tilts and turns a tool: gravity acts on the tilt alone."""
    return [
        _rod("column", None, 0.0, UP, 12.0, 0.35, 0.5),
        _rod("elbow", "column", 0.35, UP, 6.0, 0.3, 0.3),
        _rod("tilt", "elbow", 0.3, ACROSS, 3.0, 0.2, 0.05),
        _rod("turn", "tilt", 0.2, np.array([1.0, 0.0, 0.0]), 1.0, 0.1, 0.02),
    ]


def parallel() -> list[Part]:
    """Four links in one vertical plane."""
    names, masses = ("lift", "reach", "pitch", "tip"), (9.0, 6.0, 3.0, 1.0)
    before = (None, *names)
    return [
        _rod(name, before[k], 0.35 if k else 0.0, ACROSS, mass, 0.35, 0.3 / (k + 1))
        for k, (name, mass) in enumerate(zip(names, masses, strict=True))
    ]


def _rod(name: str, parent: str | None, along: float, axis: np.ndarray, kg: float, length: float, rotor: float) -> Part:
    inertia = kg * length**2 / 12 * np.diag([0.1, 1.0, 1.0])
    com = np.array([0.45 * length, 0.0, 0.05])
    return Part(name, parent, "revolute", np.array([along, 0, 0]), np.zeros(3), axis, kg, com, np.zeros(3), inertia,
                rotor)  # fmt: skip


def scaled(parts: list[Part], masses: float) -> list[Part]:
    return [replace(part, mass=masses * part.mass, inertia=masses * part.inertia) for part in parts]


@dataclass(frozen=True)
class Setting:
    """One arm as it may stand in a laboratory."""

    name: str
    parts: list[Part]
    rate_hz: float = 100.0
    drive: Drive = Drive()


CURRENT = Drive(nm_per_a=(13.0, 13.0, 9.4, 4.6, 4.6, 4.5), step=0.02, presliding_rad=2e-3, load=0.05, pause_s=2.0)

SETTINGS = [
    Setting("six, half as heavy, little friction", scaled(six_axis(), 0.5), 250.0, Drive(friction=0.2)),
    Setting("six, twice as heavy, much friction", scaled(six_axis(), 2.0), 125.0, Drive(friction=3.0, noise=0.05)),
    Setting("seven, 50 Hz, no velocity filter", seven_axis(), 50.0, Drive(velocity_filter_s=0.0)),
    Setting("seven, 500 Hz, quiet", seven_axis(), 500.0, Drive(noise=0.003, velocity_filter_s=0.005)),
    Setting("seven, 200 Hz, noisy", seven_axis(), 200.0, Drive(noise=0.15, velocity_filter_s=0.01, friction=2.0)),
    Setting("scara, quintic", scara(), 250.0, Drive(friction=0.5)),
    Setting("scara, trapezoids and pauses", scara(), 100.0,
            Drive(profile="trapezoid", pause_s=3.0, presliding_rad=1e-3, noise=0.03)),
    Setting("parallel, 1 kHz", parallel(), 1000.0, Drive(friction=0.3, noise=0.05, velocity_filter_s=0.002)),
    Setting("parallel, presliding and pauses", parallel(), 100.0,
            Drive(presliding_rad=5e-3, pause_s=3.0, load=0.1, profile="trapezoid")),
    Setting("planar rig, trapezoids", planar_rig(), 500.0, Drive(profile="trapezoid", pause_s=2.0, noise=0.03)),
    Setting("six, presliding, load, warming by 8 %", six_axis(), 100.0,
            Drive(presliding_rad=3e-3, load=0.1, warming=0.08, pause_s=2.0, profile="trapezoid", noise=0.02)),
]  # fmt: skip
"""Good data: effort is a torque, signs and order are right."""

CURRENTS = [
    Setting("six, currents, 125 Hz, trapezoids", six_axis(), 125.0, replace(CURRENT, profile="trapezoid")),
    Setting("six, currents, 250 Hz, warming", six_axis(), 250.0, replace(CURRENT, warming=0.3, step=0.01)),
    Setting("seven, currents, 100 Hz", seven_axis(), 100.0, replace(CURRENT, step=0.03, noise=0.05)),
    Setting("seven, motor side, 500 Hz", seven_axis(), 500.0,
            replace(CURRENT, nm_per_a=(100.0, 100.0, 80.0, 80.0, 50.0, 50.0, 50.0), step=0.001)),
]  # fmt: skip
"""Efforts that are currents or torques before the gear: without a model nothing is wrong with them."""
