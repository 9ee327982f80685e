"""Findings, their codes, and the checks that packages add."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

from tauext import plugins
from tauext.data.importers.raw import short_list
from tauext.data.recording import Recording

Severity = Literal["fault", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("fault", "warning", "note")

CODES = {
    "beyond-limit": "a position or torque exceeds the robot file's limit",
    "clock-gaps": "samples are missing",
    "clock-irregular": "the steps between samples differ",
    "contact-in-free-motion": "contacts in a recording that is marked free, labelled or found in the torque",
    "contact-unknown": "time of which it is unknown whether something touched the arm",
    "dead-band": "the torque is 0 below a threshold",
    "degrees": "positions, or positions and velocities, are in degrees",
    "effort-compensated": "gravity or the whole model is already subtracted from the torque",
    "effort-motor-side": "the torque is that of the motor, before the gear",
    "effort-scale": "the torque has another unit, or is the model's times a constant",
    "effort-sign": "the torque is positive where it pushes in the negative direction",
    "excitation-low": "a joint moves too little",
    "gravity-direction": "gravity has another direction than in the robot file",
    "inertia-impossible": "a link of the robot file has a mass or inertia that no body can have",
    "joint-axis": "an axis is opposite to the robot file's",
    "joint-names": "joints are named otherwise than in the robot file",
    "joint-order": "joints are in another order",
    "limit-fine": "the threshold of a training is below the step of the torque",
    "limit-wide": "the threshold of a training is a large share of the joint's torque",
    "model-unusable": "the robot file cannot be used",
    "never-moves": "no joint moves",
    "odd-recording": "a recording disagrees with the others in unit, sign, order, zero, scale or load",
    "payload": "the arm carries another payload than the model",
    "position-offset": "a joint's zero position differs from the robot file's",
    "position-wraps": "a position jumps by whole turns",
    "promise-worse": "the recordings prove only a higher false alarm rate than the bundle's",
    "refresh-slow": "a signal is refreshed more slowly than the others",
    "repeated-rows": "rows repeat the row before",
    "resolution": "a signal has coarse steps, or less noise than a measurement can have",
    "robot-file-changed": "the robot file differs from the one recorded with",
    "robot-file-other": "the robot file seems to be of another arm",
    "rows-dropped": "an import left out or sorted many rows",
    "saturated": "many samples have one extreme value",
    "spike": "a few samples lie far beyond their neighbours",
    "stuck": "a signal is constant while its joint moves, or until it jumps",
    "time-unit": "the time stamps are in another unit",
    "too-short": "the recordings are short",
    "torque-changes": "the torque changes with time: its zero, in steps, or its friction",
    "torque-delay": "the torque is late or early relative to the motion",
    "velocity-delay": "the velocity is late relative to the position",
    "velocity-mismatch": "the velocity is not the derivative of the position",
    "velocity-sign": "the velocity has the opposite sign",
    "velocity-unit": "the velocity is the derivative of the position times a constant",
}
"""Codes of the core's findings and their meaning; stable, scripts may rely on them."""


@dataclass(frozen=True)
class Finding:
    """One fault, warning or note about data or robot file."""

    code: str  # key of codes()
    severity: Severity
    """fault: a bundle trained on these data is wrong. warning: it may be wrong or inaccurate. note: information."""
    joint: str | None  # joint concerned; None: all joints, or no single one
    evidence: str  # measured evidence, in numbers
    advice: str  # the remedy
    recording: str | None = None  # name of the recording concerned; None: all, or several

    def __post_init__(self) -> None:
        assert self.code in codes() and self.severity in SEVERITIES


def by_code(findings: Iterable[Finding]) -> dict[str, list[Finding]]:
    """Group findings by code, in order of first occurrence."""
    found: dict[str, list[Finding]] = {}
    for finding in findings:
        found.setdefault(finding.code, []).append(finding)
    return found


def finding_lines(findings: Iterable[Finding], most: int = 8) -> list[str]:
    """Lines for the terminal: code, joints, recordings and evidence, at most so many, and the remedy once a code."""
    lines = []
    for code, same in by_code(findings).items():
        joints = list(dict.fromkeys(f.joint for f in same if f.joint))
        recordings = list(dict.fromkeys(f.recording for f in same if f.recording))
        named = [f"joint{'s' * (len(joints) > 1)} {', '.join(joints)}"] if joints else []
        named += [f"recording{'s' * (len(recordings) > 1)} {short_list(recordings, most)}"] if recordings else []
        about = f" ({'; '.join(named)})" if named else ""
        lines.append(f"  {code}{about}: {codes()[code]}")
        lines += [f"      {f'{finding.joint}: ' if finding.joint else ''}{finding.evidence}" for finding in same[:most]]
        lines += [f"      and {len(same) - most} more"] if len(same) > most else []
        lines += [f"      -> {advice}" for advice in dict.fromkeys(f.advice for f in same)]
    return lines


# --- Checks that packages add.


Facts = dict[str, float | str]
"""Measured quantities of one joint, by names with units."""


@dataclass(frozen=True)
class Plot:
    """One joint's plot in the picture of the checks."""

    line: tuple[np.ndarray, np.ndarray]  # measured curve, x and y; the predicted one, if there are points
    y_range: tuple[float, float]
    points: tuple[np.ndarray, np.ndarray] | None = None  # measured points, x and y
    shaded: float | None = None  # x up to which the plot is shaded, from 0
    mark: float | None = None  # x of an upright line


@dataclass(frozen=True)
class Plots:
    """A column of plots in the picture of the checks."""

    title: str
    x_label: str
    of_joints: Sequence[Plot | None]
    notable: bool  # whether the picture is drawn for these


@dataclass(frozen=True)
class Found:
    """Findings of a check, and what the checks after it have to know."""

    findings: Sequence[Finding] = ()
    recordings: Sequence[Recording] | None = None
    """The recordings, corrected for the checks that follow; None: unchanged."""
    facts: Sequence[Facts] = ()  # measured quantities of each joint; empty: none
    unsigned: bool = False  # whether a joint's tau has no known sign. Then the torque is not compared with anything
    drive: bool = False
    """Whether a joint's tau is a drive signal, which reverses before the joint leaves stiction and shows no delay."""
    no_torque: frozenset[str] = frozenset()
    """Joints whose tau is not in N m. Then it is not compared with the model's size."""
    plots: Callable[[], Plots] | None = None  # called if a picture is drawn


@dataclass(frozen=True)
class Check:
    """A check of recordings of one arm. Packages add theirs as entry points of the group tauext.checks."""

    codes: Mapping[str, str]  # codes of its findings and their meaning, as in CODES
    find: Callable[[Sequence[Recording]], Found]
    """A function that checks recordings of the same joints, at least one. Findings are cached until a file beside the
    function's changes."""
    corrected: bool = True
    """Whether it runs last, on recordings that all other checks have corrected. False: it runs before the checks of
    signals, on recorded values; also on each recording alone, of which faults count."""


@cache
def added() -> dict[str, Check]:
    """The checks of packages by name; ConfigError: one cannot be loaded."""
    return plugins.every(plugins.CHECKS, Check)


def codes() -> dict[str, str]:
    """All codes of findings and their meaning, in alphabetical order."""
    return dict(sorted((CODES | {code: text for one in added().values() for code, text in one.codes.items()}).items()))


def run_added(recordings: Sequence[Recording], corrected: bool) -> tuple[list[Found], Sequence[Recording]]:
    """Run the checks of packages that want corrected recordings, or the others; each corrects for the next."""
    results = []
    for check in added().values():
        if check.corrected == corrected:
            results.append(check.find(recordings))
            recordings = recordings if results[-1].recordings is None else results[-1].recordings
    return results, recordings
