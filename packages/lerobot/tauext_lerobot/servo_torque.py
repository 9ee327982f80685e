"""What a servo arm's effort is: an unsigned supply current, a duty or load, a phase current, or a torque."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from tauext.check.finding import Check, Facts, Finding, Found, Plot, Plots
from tauext.check.sensors import step_of
from tauext.data.recording import Recording
from tauext_lerobot.drive_signal import LEAST_VISITS, RestLaw, motion_of, rest_law, unsigned_visits

Kind = Literal["torque", "phase current", "duty", "unsigned", "supply current", "sign bit", "goal"]
MADE_OF = {"phase_current": "current", "supply_current": "current", "duty": "duty"}
"""Signal from which a torque is computed, by [servo] torque_from."""
FOLLOWS = 0.9
"""Least share of a drive signal's variance in motion explained by position error and speed."""
BACK_EMF = 0.15
"""Ratio of the effects of speed and position error from which a signal contains back-EMF. At a third of the no-load
speed a servo's current has lost a third, a duty nothing."""
ROUND = (1.0, 100.0, 1000.0)
"""Full duty as a share, in per cent, or in thousandths of a load register."""
LEAST_STEP, MOST_STEP = 5e-4, 0.02
"""Steps of a duty's register, as shares of the full duty: Feetech's load counts thousandths, Dynamixel's PWM 1/885. A
stiff arm's torque also follows the position error, but with other steps or none."""
PILED = 20
"""Fewest rows at exactly the full duty for a saturated drive."""
SIGN_BIT, FULL = 1024, 1000
"""Feetech's Present_Load: bit 10 is the sign, the rest is 0 to 1000."""


@dataclass(frozen=True)
class Effort:
    """Kind of one joint's effort, and the evidence."""

    kind: Kind
    visits: int = 0
    """Number of visits of zero in motion without crossing it."""
    law: RestLaw | None = None
    speed_share: float = 0.0
    """Ratio of the effects of speed and position error in motion."""
    signed: bool = False
    full: float = 0.0
    """Value at which it saturates, in its unit; 0: none."""
    of: str | None = None
    """Joint from which the law was taken, if its own cannot be determined."""
    made_from: str | None = None
    """Signal from which tau was computed according to [servo] of arm.toml, described here; None: tau as recorded."""


def efforts_of(recordings: Sequence[Recording]) -> list[Effort]:
    """Determine the kind of each joint's tau, or of its source signal at import.

    Without goal positions a law at rest cannot be determined, and a duty resembles a torque unless it saturates. Only
    back-EMF distinguishes a phase current from a torque.
    """
    found = [_effort(recordings, j) for j in range(len(recordings[0].joints))]
    with_law = [j for j, one in enumerate(found) if one.law is not None and one.kind in ("unsigned", "supply current")]
    if not with_law:
        return found
    best = min(with_law, key=lambda j: found[j].law.exponent_error)  # type: ignore[union-attr]
    return [
        replace(one, kind=found[best].kind, law=found[best].law, of=recordings[0].joints[best])
        if one.kind == "unsigned" and one.law is None
        else one
        for one in found
    ]


def servo_findings(joints: Sequence[str], efforts: Sequence[Effort]) -> list[Finding]:
    """Findings of efforts that are no torque or not the declared signal, with the entry for arm.toml."""
    found = []
    for joint, effort in zip(joints, efforts, strict=True):
        if effort.kind in ("unsigned", "supply current") and effort.made_from != "supply_current":
            found.append(_unsigned(joint, effort))
        elif effort.kind == "sign bit":
            evidence = (
                f"whole numbers up to {FULL} and from {SIGN_BIT} to {SIGN_BIT + FULL}, none between: bit 10 is the sign"
            )
            advice = "a raw load register: above 1024, subtract 1024 and negate; and " + _DUTY
            found.append(Finding("load-sign-bit", "fault", joint, evidence, advice))
        elif effort.kind == "duty" and effort.made_from is None:
            found.append(Finding("effort-duty", "warning", joint, _duty_evidence(effort), _DUTY))
        elif (
            effort.made_from == "supply_current"
            and effort.kind in ("torque", "phase current", "duty")
            and effort.signed
        ):
            evidence = "it has both signs in motion, but a supply current is only drawn, not returned"
            advice = 'it is the current of the windings: set torque_from = "phase-current" in [servo] of arm.toml'
            found.append(Finding("current-signed", "warning", joint, evidence, advice))
    return found


_DUTY = 'set torque_from = "duty" in [servo] of arm.toml: in motion its back-EMF is then subtracted'


def with_sign(recordings: Sequence[Recording], efforts: Sequence[Effort]) -> tuple[Sequence[Recording], bool]:
    """Give unsigned efforts a sign and make them linear in torque, for the other checks.

    Returns:
        The recordings, and whether a joint's sign stays unknown.
    """
    turned = [j for j, e in enumerate(efforts) if e.kind in ("unsigned", "supply current") and e.made_from is None]
    if not turned:
        return recordings, False
    if any(r.q_des is None for r in recordings):
        return recordings, True
    out = []
    for r in recordings:
        tau = np.array(r.tau)
        for j in turned:
            size = np.abs(tau[:, j])
            tau[:, j] = np.sign(_goal(r)[:, j] - r.q[:, j]) * (np.sqrt(size) if _is_square(efforts[j]) else size)
        out.append(replace(r, tau=tau))
    return out, False


def _plot(recordings: Sequence[Recording], j: int, effort: Effort) -> Plot | None:
    """Effort at rest against goal minus position, with its law; None: it is a torque, or follows no law."""
    law = effort.law
    if law is None or effort.kind == "torque":
        return None
    name = MADE_OF.get(effort.made_from or "", "tau")
    rests = [motion_of(r, j)[1] for r in recordings]
    both = [
        np.stack([(_goal(r) - r.q)[rest, j], getattr(r, name)[rest, j]])
        for r, rest in zip(recordings, rests, strict=True)
        if r.q_des is not None
    ]
    points = np.concatenate(both, axis=1)
    error, measured = points[:, :: max(1, points.shape[1] // 5000)]
    line = np.linspace(error.min(), error.max(), 200)
    predicted = law.gain * np.abs(line) ** (2 if _is_square(effort) else 1) * (np.sign(line) if law.odd else 1.0)
    y_range = 1.1 * min(0.0, float(measured.min())), 1.1 * max(1e-9, float(measured.max()))
    return Plot((line, predicted), y_range, points=(error, measured))


def _plots(recordings: Sequence[Recording], efforts: Sequence[Effort]) -> Plots:
    plots = [_plot(recordings, j, effort) for j, effort in enumerate(efforts)]
    return Plots("effort at rest, and its law", "goal - position, rad", plots, any(plots))


def _facts(effort: Effort) -> Facts:
    fact: Facts = {"torque_is": effort.kind}
    if effort.made_from is not None:
        fact["torque_made_from"] = effort.made_from
    if effort.law is not None and effort.kind != "torque":
        fact["effort_per_rad2" if _is_square(effort) else "effort_per_rad"] = effort.law.gain
        fact["effort_exponent"] = effort.law.exponent
    if effort.full:
        fact["effort_full"] = effort.full
    return fact


def find_kind(recordings: Sequence[Recording]) -> Found:
    """Kind of each joint's effort: findings, facts, recordings with signed efforts, and the laws for a picture."""
    joints, efforts = recordings[0].joints, efforts_of(recordings)
    signed, unsigned = with_sign(recordings, efforts)
    no_torque = {
        joint
        for joint, effort in zip(joints, efforts, strict=True)
        if effort.made_from is None and effort.kind not in ("torque", "phase current")
    }
    return Found(
        servo_findings(joints, efforts),
        signed,
        [_facts(effort) for effort in efforts],
        unsigned=unsigned,
        drive=any(effort.kind != "torque" or effort.made_from is not None for effort in efforts),
        no_torque=frozenset(no_torque),
        plots=partial(_plots, recordings, efforts),
    )


def _goal(recording: Recording) -> np.ndarray:
    assert recording.q_des is not None  # the caller checked
    return recording.q_des


def _effort(recordings: Sequence[Recording], j: int) -> Effort:
    sources = {r.provenance.get("servo", {}).get("torque_from", "torque") for r in recordings}
    source = sources.pop() if len(sources) == 1 else "torque"
    if source == "goal":
        return Effort("goal", made_from="goal")
    if source not in MADE_OF:
        return _signal([r.tau[:, j] for r in recordings], recordings, j)
    columns = [getattr(r, MADE_OF[source]) for r in recordings]
    if any(column is None for column in columns):
        return Effort("torque", made_from=source)
    return replace(_signal([column[:, j] for column in columns], recordings, j), made_from=source)


def _signal(tau: Sequence[np.ndarray], recordings: Sequence[Recording], j: int) -> Effort:
    """Determine the kind of one joint's signal, (samples,) of each recording."""
    whole = np.concatenate(tau)
    if not whole.any():
        return Effort("torque")
    motion = [motion_of(r, j) for r in recordings]
    goals = all(r.q_des is not None for r in recordings)
    errors = [_goal(r)[:, j] - r.q[:, j] for r in recordings] if goals else []
    law = rest_law(tau, errors, [rest for _, rest in motion]) if goals else None
    if whole.min() >= 0 or whole.max() <= 0:
        if _has_sign_bit(whole):
            return Effort("sign bit")
        visits = sum(unsigned_visits(x, moves) for x, (moves, _) in zip(tau, motion, strict=True))
        if visits < LEAST_VISITS:
            return Effort("torque", visits)
        square = law is not None and law.exponent > 1.5  # the square of the duty, else the duty
        return Effort("supply current" if square else "unsigned", visits, law)
    full = next((f for f in ROUND if _piled(whole, f)), 0.0)
    if law is None or not (law.odd and 0.7 < law.exponent < 1.4):  # rounding of small values bends the line
        return Effort("duty" if full else "torque", signed=True, full=full)
    share, explained = _speed_share(tau, recordings, j, errors, [moves for moves, _ in motion])
    if full or (explained > FOLLOWS and share < BACK_EMF and _is_share(whole)):
        return Effort("duty", law=law, speed_share=share, signed=True, full=full)
    induces = explained > FOLLOWS and share >= BACK_EMF
    return Effort("phase current" if induces else "torque", law=law, speed_share=share, signed=True)


def _speed_share(
    tau: Sequence[np.ndarray],
    recordings: Sequence[Recording],
    j: int,
    errors: Sequence[np.ndarray],
    moving: Sequence[np.ndarray],
) -> tuple[float, float]:
    """Ratio of the effects of speed and position error on the effort, and the share of variance explained."""
    y = np.concatenate([x[moves] for x, moves in zip(tau, moving, strict=True)])
    e = np.concatenate([error[moves] for error, moves in zip(errors, moving, strict=True)])
    if len(y) < 100 or e.std() == 0:
        return 0.0, 0.0
    speed = np.concatenate(
        [np.gradient(r.q[:, j], r.time_s)[moves] for r, moves in zip(recordings, moving, strict=True)]
    )
    columns = np.column_stack([e, speed, np.ones(len(y))])
    weights, *_ = np.linalg.lstsq(columns, y, rcond=None)
    explained = 1 - float(np.var(y - columns @ weights) / max(np.var(y), 1e-30))
    return float(-weights[1] * speed.std() / max(abs(weights[0]) * e.std(), 1e-30)), explained


def _is_share(x: np.ndarray) -> bool:
    """Whether a signal may be a share of full duty: within 1, or in hundredths or thousandths."""
    top = float(np.abs(x).max())
    full = next((f for f in ROUND if top <= f), None)
    if full is None or full == 1.0:
        return full is not None
    step = step_of(x)
    return step is not None and LEAST_STEP < step / full < MOST_STEP


def _piled(x: np.ndarray, full: float) -> bool:
    """Whether a signal often reaches exactly the full duty and never exceeds it."""
    size = np.abs(x)
    return bool(size.max() == full and np.count_nonzero(size == full) >= PILED)


def _has_sign_bit(x: np.ndarray) -> bool:
    if x.max() <= SIGN_BIT or x.max() > SIGN_BIT + FULL or (x != np.round(x)).any():
        return False
    below, above = x <= FULL, x >= SIGN_BIT
    return bool((below | above).all() and min(below.mean(), above.mean()) > 0.01)


def _is_square(effort: Effort) -> bool:
    return effort.kind == "supply current"


def _unsigned(joint: str, effort: Effort) -> Finding:
    visits = f"it reaches zero {effort.visits} times in motion and never crosses it"
    if effort.law is None:
        advice = (
            "a magnitude without sign. Record the goal's positions ([signals.q_des]) or the duty, which have the "
            'sign; if it is the supply\'s current, set torque_from = "supply-current" in [servo] of '
            "arm.toml"
        )
        return Finding("unsigned-torque", "fault", joint, visits, advice)
    whose = f" (determined at '{effort.of}')" if effort.of else ""
    law = f"at rest it follows |goal - position|^{effort.law.exponent:.2f} ± {effort.law.exponent_error:.2f}{whose}"
    if _is_square(effort):
        evidence = f"{visits}; {law}: {effort.law.gain:.3g} a rad², the current of the supply, duty squared"
        advice = (
            'set torque_from = "supply-current" in [servo] of arm.toml: its root, with the sign of goal - position or '
            "of the duty, is proportional to torque"
        )
        return Finding("supply-current", "fault", joint, evidence, advice)
    advice = (
        "the magnitude of a duty or of a phase current: read its sign (on Feetech's servos bit 10 of the load, bit 15 "
        'of the current), or set torque_from = "goal" in [servo] of arm.toml'
    )
    return Finding("unsigned-torque", "fault", joint, f"{visits}; {law}", advice)


def _duty_evidence(effort: Effort) -> str:
    parts = []
    if effort.law is not None:
        parts.append(
            f"at rest and in motion it is {effort.law.gain:.4g} a rad of goal - position; speed reduces it by "
            f"{max(0.0, effort.speed_share):.0%}; a motor's current would lose its back-EMF"
        )
    if effort.full:
        parts.append(f"it saturates at exactly {effort.full:g}")
    return "; ".join(parts) + ": a duty, or a load register, and no torque"


CHECK = Check(
    {
        "current-signed": "a current declared as the supply's has a sign",
        "effort-duty": "the torque is the duty of a drive, or a load register",
        "load-sign-bit": "the torque is a load register with its sign still in a bit",
        "supply-current": "the torque is the current of a servo's supply, without a sign",
        "unsigned-torque": "the torque has no sign",
    },
    find_kind,
    corrected=False,
)
