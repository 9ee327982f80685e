"""A fitted prior as quantities that an engineer can check against a data sheet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from tauext import _core
from tauext.fit.find_kinematics import Kinematics
from tauext.fit.prior_terms import PriorFit
from tauext.robot.inertial import PARAMETERS

Kind = _core.TermKind
WELL_DETERMINED = 0.9  # share that the data, and not the ridge, determine
UNITS = {"m": "kg", "h": "kg m", "I": "kg m2", "r": "kg m2"}


def prior_facts(fit: PriorFit, joints: Sequence[str]) -> dict:
    """Friction of every joint and implied errors of the model, as plain JSON; values that the data do not support are
    marked.

    Coulomb friction: sum of the terms that follow the sign of the motion in steady sliding, with its sign
    inverted, since r is minus the friction. A value is supported where the data determine it (and not the
    ridge) and it differs from zero by some standard errors.
    """
    facts: dict[str, Any] = {
        "ridge": fit.ridge,
        "error_nm": dict(zip(joints, fit.error_nm.tolist(), strict=True)),
        "friction": {},
    }
    facts["dropped_widths_mrad"] = {f"{1e3 * width:g}": reason for width, reason in fit.dropped_widths.items()}
    for j, name in enumerate(joints):
        own = [m for m, term in enumerate(fit.settings.terms) if term.a == j and term.kind not in SHARED]
        kinds = {kind: [m for m in own if fit.settings.terms[m].kind == kind] for kind in OWN}
        sliding = kinds[Kind.coulomb] + kinds[Kind.presliding]
        friction: dict[str, Any] = {
            "coulomb_nm": -float(fit.weights[j, sliding].sum()),
            "viscous_nm_s_rad": -float(fit.weights[j, kinds[Kind.viscous]].sum()),
            "constant_nm": -float(fit.weights[j, kinds[Kind.constant]].sum()),
        }
        cycles = sorted({fit.settings.terms[m].b for m in kinds[Kind.ripple]})
        friction["ripple"] = [
            {
                "cycles_a_turn": c,
                "amplitude_nm": math.hypot(*(fit.weights[j, m] for m in own if is_ripple(fit.settings.terms[m], c))),
            }
            for c in cycles
        ]
        unsupported = [m for m in kinds[Kind.viscous] + kinds[Kind.constant] if not supported(fit, j, m)]
        friction["not_supported"] = [fit.settings.terms[m].kind.name for m in unsupported]
        facts["friction"][name] = friction
    if fit.kinematics is not None:
        facts["arm"] = {name: joint for name, joint in zip(joints, arm_found(fit.kinematics), strict=True)}
    elif fit.corrections.size:
        facts["model"] = {name: corrections(fit, j) for j, name in enumerate(joints)}
        held = {name: [PARAMETERS[k] for k in np.flatnonzero(fit.corrections_held[j])] for j, name in enumerate(joints)}
        facts["held"] = {name: parameters for name, parameters in held.items() if parameters}
    return facts


def held_sentence(facts: dict[str, Any]) -> str:
    """Inertial parameters held at a physical bound against the motion, as text; empty: none."""
    held = "; ".join(f"{name} {', '.join(parameters)}" for name, parameters in facts.get("held", {}).items())
    if not held:
        return ""
    return (
        f"the motion does not determine these inertial parameters: {held}; they keep the robot file's value, or the "
        "nearest value that a link can have (a rotor inertia of 0)"
    )


def arm_found(kinematics: Kinematics) -> list[dict]:
    """Each joint's axis at q = 0, and its pose relative to the previous one, as in a Denavit-Hartenberg table."""
    facts = []
    for k, (axis, origin) in enumerate(zip(kinematics.axes, kinematics.origins, strict=True)):
        joint: dict = {"axis": axis.round(4).tolist()}
        if k:
            before, step = kinematics.axes[k - 1], origin - kinematics.origins[k - 1]
            across = np.cross(before, axis)
            sine = float(np.linalg.norm(across))
            parallel = sine < 1e-6
            distance = np.linalg.norm(np.cross(before, step)) if parallel else abs(step @ across) / sine
            joint["angle_deg"] = round(math.degrees(math.atan2(sine, float(before @ axis))), 2)
            joint["distance_m"] = round(float(distance), 4)
        facts.append(joint)
    return facts


def friction_nm(fit: PriorFit, speed_rad_s: float | np.ndarray) -> np.ndarray:
    """Size of the friction that the prior expects of each joint in steady sliding at this speed > 0: (n,), [N m].

    One speed for all joints, or one each, (n,), [rad/s].

    Coulomb and presliding terms (their states are 1 then) and the viscous one; not those that grow with the load.
    """
    terms, level = fit.settings.terms, np.zeros(len(fit.weights))
    speeds = np.broadcast_to(speed_rad_s, level.shape)
    value = {
        Kind.coulomb: lambda term: math.tanh(speeds[term.a] / term.speed),
        Kind.presliding: lambda term: 1.0,
        Kind.viscous: lambda term: speeds[term.a],
    }
    for m, term in enumerate(terms):
        if term.kind in value:
            level[term.a] += fit.weights[term.a, m] * value[term.kind](term)
    return np.abs(level)


SHARED = (Kind.gravity, Kind.quadratic, Kind.momentum)
OWN = [
    getattr(Kind, name)
    for name in ("constant", "viscous", "coulomb", "presliding", "load", "load_presliding", "ripple")
]


def is_ripple(term: _core.Term, cycles: int) -> bool:
    return term.kind == Kind.ripple and term.b == cycles


def supported(fit: PriorFit, joint: int, term: int) -> bool:
    """Whether the data determine this weight, and that it is not zero."""
    weight, error = fit.weights[joint, term], fit.standard_errors[joint, term]
    return bool(fit.determined[joint, term] > WELL_DETERMINED and abs(weight) > 3 * error)


def corrections(fit: PriorFit, link: int) -> dict:
    """How far each inertial parameter of a link lies from the robot file, where the data determine it."""
    facts: dict = {}
    for k, parameter in enumerate(PARAMETERS):
        value, error = fit.corrections[link, k], fit.correction_errors[link, k]
        determined = fit.corrections_determined[link, k] > WELL_DETERMINED and np.isfinite(error)
        facts[f"{parameter} [{UNITS[parameter[0]]}]"] = (
            {"by": float(value), "standard_error": float(error)} if determined else "not supported by the data"
        )
    return facts
