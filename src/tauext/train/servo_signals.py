"""Which recorded signal of servos their torque should be computed from, by the false alarms of left-out recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tauext._core import Bundle
from tauext.data.servo import TORQUE_WORDS
from tauext.train.preparation import Job

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


def signal_limits(job: Job, bundle: Bundle, source: str) -> SignalLimits | None:
    """Limits of a finished training; None: they are not tested on left-out recordings, or a joint never moved."""
    other = job.facts.get("limits", {}).get("other_motion", {})
    if "factor" not in other:
        return None
    constants = np.array(job.constants.used) if job.constants is not None else 1.0
    size = np.abs(constants) * np.concatenate([recording.tau for recording in job.training]).std(axis=0)
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
    words = f"By {own.words}, limits from the other recordings raise {own.false} false alarms "
    words += f"(promised {own.promised:.2g})."
    if not others:
        return (
            f"{words} No other signal of the servos is recorded: record their current or duty too, name it in "
            "[signals.current] or [signals.duty], and training compares the signals."
        )
    for one in others:
        words += (
            f" By {one.words} they raise {one.false} (promised {one.promised:.2g}), and limits that keep the "
            f"promise there detect pushes {size_of_pushes(one, own):.2g} times as large."
        )
    better = [one for one in others if one.factor < own.factor and size_of_pushes(one, own) < 1]
    if not better:
        return f"{words} No other recorded signal is better."
    best = min(better, key=lambda one: size_of_pushes(one, own))
    return f'{words} For that, set torque_from = "{best.name}" in [servo] of arm.toml, and import again.'
