"""Which recorded signal of servos their torque should be computed from, by the false alarms of left-out recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tauext._core import Bundle
from tauext.data.recording import Recording
from tauext.data.servo import (
    OF_GOAL,
    RAW_SIGNALS,
    TORQUE_WORDS,
    makes_torque,
    servo_of,
    servo_of_recordings,
    velocity_and_torque,
)
from tauext.errors import TauextError
from tauext.progress import SILENT
from tauext.train.fitting import assemble, observe, with_fit
from tauext.train.preparation import TrainingInput, TrainingRun, prepare
from tauext.train.stage import complete, fit_with_gain

# --- Limits by each signal, and what a person reads of them.


LEAST_RECORDINGS = 10
"""Fewest recordings for a comparison. Among five, one recording decides: of three comparisons on a real SO-101, one was
right."""


@dataclass(frozen=True)
class SignalLimits:
    """Limits of a training with the torque from one signal, and their test on left-out recordings."""

    source: str
    """Name in TorqueFrom."""
    false: int
    """False alarms in recordings whose limits follow from the others."""
    promised: float
    """Of them the budget of the limits allows so many."""
    kept_by: float
    """Factor on the limits that would have kept the promise there."""
    shares: tuple[float, ...]
    """Each joint's limit in usual motion as a share of its torque's standard deviation, since the scale of a servo's
    torque differs from signal to signal."""

    @property
    def name(self) -> str:
        """Name in arm.toml."""
        return self.source.replace("_", "-")

    @property
    def words(self) -> str:
        """The signal in words."""
        return f"the {TORQUE_WORDS[self.name]}"

    @property
    def factor(self) -> float:
        """Ratio of false alarms to promised ones."""
        return self.false / self.promised

    def facts(self) -> dict:
        """All of it for JSON."""
        return {
            "torque_from": self.source,
            "false": self.false,
            "promised": self.promised,
            "kept_by": self.kept_by,
            "limit_shares": [round(one, 4) for one in self.shares],
        }


def signal_limits(run: TrainingRun, bundle: Bundle, source: str) -> SignalLimits | None:
    """Limits of a finished training; None: they are not tested on left-out recordings, or a joint never moved."""
    other = run.facts.get("limits", {}).get("other_motion", {})
    if "factor" not in other:
        return None
    constants = np.array(run.constants.used) if run.constants is not None else 1.0
    size = np.abs(constants) * np.concatenate([recording.tau for recording in run.training]).std(axis=0)
    watched = np.array(bundle.monitored)
    if not (size[watched] > 0).all():
        return None
    shares = tuple((np.array(bundle.sliding_limit_nm) / size)[watched].tolist())
    return SignalLimits(source, sum(other["false"].values()), other["promised"], other["kept_by"], shares)


def size_of_pushes(one: SignalLimits, other: SignalLimits) -> float:
    """Ratio of the pushes that both detect if their limits keep the promise in left-out recordings: one by other.

    The median over the joints.
    """
    ratio = np.array(one.shares) / np.array(other.shares)
    return float(np.median(ratio)) * one.kept_by / other.kept_by


def not_compared(recordings: int) -> str:
    """Text for the user where there are too few recordings for a comparison."""
    return (
        f"The servos' other recorded signals are not compared: {recordings} recordings show little of other motion; "
        f"{LEAST_RECORDINGS} or more do."
    )


def comparison_sentence(own: SignalLimits, others: Sequence[SignalLimits]) -> str:
    """Text for the user: what the signals raise and detect, and the line of arm.toml that changes the signal.

    Args:
        others: other recorded signals; empty: there are none.
    """
    words = f"By {own.words}, thresholds from the other recordings raise {own.false} false alarms "
    words += f"(target {own.promised:.2g})."
    if not others:
        return (
            f"{words} No other signal of the servos is recorded: record their current or duty too, name it in "
            "[signals.current] or [signals.duty], and training compares the signals."
        )
    for one in others:
        words += (
            f" By {one.words} they raise {one.false} (target {one.promised:.2g}), and thresholds that keep the "
            f"target there detect pushes {size_of_pushes(one, own):.2g} times as large."
        )
    better = [one for one in others if one.factor < own.factor and size_of_pushes(one, own) < 1]
    if not better:
        return f"{words} No other recorded signal is better."
    best = min(better, key=lambda one: size_of_pushes(one, own))
    return f'{words} For that, set torque_from = "{best.name}" in [servo] of arm.toml, and import again.'


# --- The same recordings with the torque from another signal.


def other_sources(recordings: Sequence[Recording]) -> list[str]:
    """Other signals that the torque of servos could be computed from in all of these recordings; names of TorqueFrom.

    A current with both signs is that of the windings.
    """
    if not recordings or not all(map(makes_torque, recordings)):
        return []
    settings = servo_of_recordings(recordings)
    found = []
    if all(r.q_des is not None for r in recordings) and all(one.duty_per_rad > 0 for one in settings.joints):
        found.append("goal")
    if all(r.current is not None for r in recordings):
        signed = any((r.current < 0).any() for r in recordings if r.current is not None)
        found.append("phase_current" if signed else "supply_current")
    if all(r.duty is not None for r in recordings):
        found.append("duty")
    # An unsigned current gets its sign from the duty or the goal.
    if "supply_current" in found and not {"goal", "duty"} & {*found}:
        found.remove("supply_current")
    return [name for name in found if name != settings.torque_from.name]


def made_from(recording: Recording, source: str) -> Recording:
    """The recording with velocity and torque computed again, the torque from this signal of other_sources()."""
    facts = dict(recording.provenance["servo"])
    if facts["torque_from"] not in OF_GOAL:  # nothing was stated about goals
        facts["goal_delay_ns"] = facts["sample_period_ns"]
    facts["torque_from"] = source
    signals = {name: getattr(recording, name) for name in ("dq", *RAW_SIGNALS)}
    dq, tau = velocity_and_torque(servo_of(facts), recording.t_ns, recording.q, signals)
    return replace(recording, dq=dq, tau=tau, provenance=recording.provenance | {"servo": facts})


# --- The comparison, after a training.


def compare_signals(run: TrainingRun, bundle: Bundle, given: TrainingInput) -> None:
    """Note which signal of servos keeps the promise best, if limits of this training do not keep it in left-out motion.

    Each other signal that all recordings hold is trained with, and its limits are found and tested in the same way.

    Args:
        given: with suspected touches: each signal would suspect other moments, those of its own errors among them.
    """
    own_source = servo_of_recordings(run.training).torque_from.name
    own = signal_limits(run, bundle, own_source)
    if own is None or own.factor <= 1:
        return
    sources = other_sources([*given.training, *given.validation])
    if sources and len(given.training) < LEAST_RECORDINGS:
        run.facts["limits"]["signals"] = {"sentence": not_compared(len(given.training))}
        run.notes.append(run.facts["limits"]["signals"]["sentence"])
        return
    found: dict[str, SignalLimits | None] = {own_source: own}
    for source in ([own_source] if sources and run.suspects else []) + sources:
        words = TORQUE_WORDS[source.replace("_", "-")]
        run.say(f"training with the torque from the {words}, to compare")
        try:
            found[source] = limits_by(source, given, run)
        except TauextError as error:
            run.notes.append(f"torque from the {words} cannot be compared: {error}")
    own, others = found.pop(own_source), [one for one in found.values() if one is not None]
    if own is None or (sources and not others):
        return
    words = comparison_sentence(own, others)
    run.facts["limits"]["signals"] = {"compared": [one.facts() for one in (own, *others)], "sentence": words}
    run.notes.append(words)


def limits_by(source: str, given: TrainingInput, run: TrainingRun) -> SignalLimits | None:
    """Limits of a training on these recordings with the torque from this signal, by the settings of a run."""
    training, validation = ([made_from(one, source) for one in some] for some in (given.training, given.validation))
    other = replace(given, training=training, validation=validation)
    trained = prepare(other, run.config, run.out, SILENT)
    setup, fit = fit_with_gain(trained, observe(trained))
    bundle = assemble(trained, with_fit(setup, fit))
    complete(trained, bundle, setup, fit)
    return signal_limits(trained, bundle, source)
