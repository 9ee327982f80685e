"""The table of checks, and the recordings that they examine: each check corrects what it finds for those after it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from tauext import _core
from tauext.check import (
    arrangement,
    causes,
    clock,
    contacts,
    drive,
    effort,
    motion,
    odd_motion,
    odd_torque,
    robot_file,
    sensors,
    torque_changes,
)
from tauext.check.drive import Effort, is_drive
from tauext.check.finding import Finding
from tauext.check.joint_fit import LEAST_ROWS, FitRows, JointFit, fit_joint, rows_of
from tauext.check.motion import DEGREES, Stretch, VelocityFit, stretches
from tauext.check.robot_file import RobotFile
from tauext.data.drive_signal import Play, play_of
from tauext.data.recording import Recording
from tauext.data.servo import derives_velocity, in_amperes, makes_torque, torque_unit

# --- The recordings under examination, as the checks so far have corrected them.


@dataclass
class Examination:
    """Recordings of one arm, corrected by the checks so far, and what follows from them."""

    recordings: Sequence[Recording]
    robot: Path | None = None
    gravity: Sequence[float] | None = None
    """Acceleration of free fall in the base frame; None: the robot file's."""
    called_free: Collection[str] = ()
    """Names of recordings declared free of contact."""
    torque_limits_nm: np.ndarray | None = None
    """(joints,), infinite where the robot file has none; None: no robot file."""
    found: dict[str, list[Finding]] = field(default_factory=dict)
    """Findings so far, by step."""
    spoiled: bool = False
    """Whether a fault of the signals may look like a contact."""
    file: RobotFile | None = None
    tree: _core.Tree | None = None
    recorded: Sequence[Recording] = ()
    """The recordings before corrections of their torque."""
    efforts: list[Effort] = field(default_factory=list)
    unsigned: bool = False
    """Whether a torque has no sign, so that no other check of it applies."""
    velocities: list[VelocityFit | None] = field(default_factory=list)
    lags: list[tuple[float, float, float]] = field(default_factory=list)
    """Lag of each joint's torque, see `effort.torque_lags`."""
    lag_s: float = 0.0
    """Delay of the torque, [s]."""
    plays: list[Play] = field(default_factory=list)

    @cached_property
    def motion(self) -> list[Stretch]:
        return stretches(self.recordings)

    @cached_property
    def rows(self) -> FitRows:
        """Rows of the fits, of a motion that is not empty."""
        return rows_of(self.motion, self.tree, self.lag_s)

    @cached_property
    def fits(self) -> list[JointFit]:
        return [fit_joint(self.rows, j) for j in range(self.rows.joints)]

    @property
    def joints(self) -> tuple[str, ...]:
        return self.recordings[0].joints

    @property
    def model(self) -> _core.Tree:
        """The tree, for checks that need one."""
        assert self.tree is not None
        return self.tree

    @property
    def unit(self) -> str:
        """Unit of the torque."""
        return torque_unit(self.recordings)

    @property
    def has_fit(self) -> bool:
        """Whether the torques can be fitted: the arm moves, for long enough."""
        stands = any(finding.code == "never-moves" for of_step in self.found.values() for finding in of_step)
        return not (stands or self.unsigned) and bool(self.motion) and len(self.rows.time_s) >= LEAST_ROWS

    @property
    def moves_long(self) -> bool:
        return effort.moving_s(self.motion) >= effort.SEARCH_S

    def correct(self, **corrected: Any) -> None:
        """Set corrected recordings, motion, tree or lag; what follows from them is computed again when needed."""
        for name in ("rows", "fits", *(["motion"] if "recordings" in corrected else [])):
            vars(self).pop(name, None)
        vars(self).update(corrected)

    def take(self, name: str, result: tuple[list[Finding], Any]) -> list[Finding]:
        """The findings of a result; if there are any, its second part is the corrected `name`."""
        found, corrected = result
        if found:
            self.correct(**{name: corrected})
        return found

    def leave_out(self, odd: list[Finding]) -> list[Finding]:
        """Leave out the recordings of these findings, and return the findings."""
        names = {finding.recording for finding in odd}
        if odd:
            self.correct(recordings=[r for r in self.recordings if r.name not in names])
        return odd


NEEDS: dict[str, Callable[[Examination], bool]] = {
    "robot file": lambda x: x.robot is not None,
    "model": lambda x: x.tree is not None,
    "no model": lambda x: x.tree is None,
    "motion": lambda x: bool(x.motion),
    "sign": lambda x: not x.unsigned,
    "fit": lambda x: x.has_fit,
    "no fit": lambda x: not x.has_fit,
    "half a minute": lambda x: x.moves_long,
    "measured torque": lambda x: not any(map(is_drive, x.efforts)),
}
"""What a check may need. A torque that is not measured is a drive's signal: it reverses before the joint leaves
stiction, and lags."""


@dataclass(frozen=True)
class Check:
    """One check, of tauext or of another package."""

    codes: Collection[str]
    """Codes of its findings; of another package: a mapping of codes to their meanings, as CODES is."""
    step: str
    """One of STEPS."""
    find: Callable[[Examination], list[Finding]]
    """Returns findings, and corrects in the examination what later checks could not bear."""
    needs: tuple[str, ...] = ()
    """Keys of NEEDS; without all of them the check is skipped."""
    quick: bool = False
    """Whether it runs on each recording of a training or calibration alone, too: it needs neither fit nor others."""
    spoils: bool = False
    """Whether its fault may look like a contact, so that contacts are not searched for."""


def run(checks: Iterable[Check], x: Examination, begin: Callable[[str], None]) -> list[Finding]:
    """Run the checks whose needs are met; `begin` is called with the step of each."""
    for check in checks:
        if all(NEEDS[need](x) for need in check.needs):
            begin(check.step)
            found = check.find(x)
            x.spoiled |= check.spoils and bool(found)
            x.found.setdefault(check.step, []).extend(found)
    return [finding for of_step in x.found.values() for finding in of_step]


# --- Checks that correct what they find.


def _open_model(x: Examination) -> list[Finding]:
    assert x.robot is not None
    x.file = robot_file.open_robot(x.robot, x.joints, x.gravity)
    x.tree, x.torque_limits_nm = x.file.tree, x.file.torque_limits_nm
    return x.file.findings + robot_file.changed_findings(x.recordings, x.robot)


def _signs_of_drives(x: Examination) -> list[Finding]:
    x.recorded, x.efforts = x.recordings, drive.efforts_of(x.recordings)
    recordings, unsigned = drive.with_sign(x.recordings, x.efforts)
    x.unsigned = bool(unsigned)
    x.correct(recordings=recordings)
    return [finding for finding in drive.servo_findings(x.joints, x.efforts) if finding.severity == "fault"]


def _kinds_of_drives(x: Examination) -> list[Finding]:
    return [finding for finding in drive.servo_findings(x.joints, x.efforts) if finding.severity != "fault"]


def _spikes(x: Examination) -> list[Finding]:
    normal = sensors.normal_ranges(x.recordings)
    spikes = [sensors.spikes_of(r, normal, x.torque_limits_nm) for r in x.recordings]
    found = [f for r, of in zip(x.recordings, spikes, strict=True) for f in sensors.spike_findings(r, of, normal)]
    x.correct(recordings=[sensors.without_spikes(r, of) for r, of in zip(x.recordings, spikes, strict=True)])
    return found


def _velocities(x: Examination) -> list[Finding]:
    found, x.velocities, factors = motion.velocity_findings(x.motion, x.joints)
    if (factors != 1).any():
        x.correct(recordings=[replace(r, q=r.q / factors) for r in x.recordings])
    if any(map(derives_velocity, x.recordings)):
        found = [finding for finding in found if finding.code != "velocity-delay"]  # that of the window is intended
    return found


def _degrees(x: Examination) -> list[Finding]:
    found = clock.degree_findings(x.recordings, x.motion, x.file.position_limits_rad if x.file else None)
    names = [finding.joint for finding in found]
    if found:
        by = np.array([DEGREES if None in names or joint in names else 1.0 for joint in x.joints])
        x.correct(recordings=[replace(r, q=r.q / by, dq=r.dq / by) for r in x.recordings])
    return found


def _odd_torques(x: Examination) -> list[Finding]:
    odd = odd_torque.odd_torques(x.rows, x.motion, x.tree, x.joints, [r.name for r in x.recordings], x.unit)
    return x.leave_out(of_servos(odd, x.recordings))


def of_servos(odd: list[Finding], recordings: Sequence[Recording]) -> list[Finding]:
    """Reduce findings to warnings where the torque was computed from servo signals. A position controller without
    integral action rests anywhere within its friction, so that recordings of few poses seem shifted, scaled or
    inverted."""
    made = {r.name for r in recordings if makes_torque(r)}
    return [replace(finding, severity="warning") if finding.recording in made else finding for finding in odd]


def _limits(x: Examination) -> list[Finding]:
    assert x.file is not None
    return robot_file.limit_findings(x.recordings, x.file)


def _exchanged_efforts(x: Examination) -> list[Finding]:
    found, column = arrangement.exchanged_efforts(x.rows, x.joints)
    if found:
        x.correct(motion=[replace(s, tau=np.ascontiguousarray(s.tau[:, column])) for s in x.motion])
    return found


def _signs(x: Examination) -> list[Finding]:
    votes = [effort.sign_vote(x.rows, j, fit) for j, fit in enumerate(x.fits)]
    found = effort.sign_findings(x.joints, votes, x.fits, x.unit)
    if found:
        signs = np.array([-1.0 if effort.inverted(vote) else 1.0 for vote in votes])
        x.correct(motion=[replace(s, tau=s.tau * signs) for s in x.motion])
    return found


def _delays(x: Examination) -> list[Finding]:
    x.lags = effort.torque_lags(x.motion, x.rows)
    return x.take("lag_s", effort.delay_findings(x.lags, x.joints, 1 / x.motion[0].rate_hz)) if x.moves_long else []


def _scales(x: Examination) -> list[Finding]:
    """Findings of a payload if it explains all factors of torque, else of the factors."""
    found, judged = effort.kind_findings(x.rows, x.joints, x.fits, effort.strong_joints(x.rows, x.fits))
    found += effort.far_findings(x.rows, x.joints, x.fits, x.unit)
    factors = effort.scale_findings(x.joints, x.fits, judged)
    if found or not judged:
        return found + factors
    payload, tree = arrangement.payload_of(x.motion, x.model, x.rows, x.joints, judged, x.unit)
    if not payload:
        return factors
    off, before = [x.joints.index(finding.joint or "") for finding in factors], x.tree
    x.correct(tree=tree)
    if effort.scale_findings(x.joints, x.fits, off):
        x.correct(tree=before)
        return factors
    return payload


def _units(x: Examination) -> list[Finding]:
    return [] if in_amperes(x.recordings) else effort.unit_findings(x.joints, x.fits)


def _other_robot(x: Examination) -> list[Finding]:
    assert x.file is not None
    if not x.rows.has_model:
        return []
    found = [finding for of_step in x.found.values() for finding in of_step]
    return causes.other_robot_findings(x.rows, x.joints, x.fits, found, x.file.position_limits_rad)


def _contacts(x: Examination) -> list[Finding]:
    faulty = any(finding.severity == "fault" for step in STEPS[2:] for finding in x.found.get(step, []))
    return [] if x.spoiled or faulty else contacts.unlabelled_findings(x.recordings, x.tree, x.lag_s)


def _plays(x: Examination) -> list[Finding]:
    x.plays = [play_of(x.recordings, j) for j in range(len(x.joints))]
    return drive.play_findings(x.joints, x.plays)


# --- The table.


SIGNALS, VELOCITIES, ORDER, PLACES, SIGNS, DELAYS, SCALES, CHANGES = STEPS = (
    "signals",
    "velocities",
    "order of the torques",
    "order and zero of the joints",
    "signs",
    "delays",
    "gravity, scale and payload",
    "drift and contacts",
)
"""Names of the steps, reported as progress: signals, then motion, then torque against model."""

CHECKS = [
    Check(("joint-names", "model-unusable", "inertia-impossible", "robot-file-changed"), SIGNALS, _open_model,
          ("robot file",)),
    Check(("contact-in-free-motion",), SIGNALS, lambda x: contacts.contact_findings(x.recordings, x.called_free)),
    Check(("time-unit",), SIGNALS, lambda x: x.take("recordings", clock.time_findings(x.recordings)), quick=True),
    Check(("position-wraps",), SIGNALS, lambda x: x.take("recordings", clock.wrap_findings(x.recordings)), quick=True),
    Check(("odd-recording",), SIGNALS, lambda x: x.leave_out(odd_motion.odd_rates(x.recordings))),
    Check(("supply-current", "unsigned-torque", "load-sign-bit"), SIGNALS, _signs_of_drives, quick=True),
    Check(("effort-duty", "current-signed"), SIGNALS, _kinds_of_drives),
    Check(("resolution",), SIGNALS, lambda x: sensors.coarse_velocities(x.recordings)),
    Check(("spike",), SIGNALS, _spikes, quick=True),
    Check(("odd-recording",), SIGNALS, lambda x: x.leave_out(odd_motion.odd_motions(x.recordings, x.motion))),
    Check(("rows-dropped",), SIGNALS, lambda x: clock.lost_findings(x.recordings), quick=True),
    Check(("clock-gaps",), SIGNALS, lambda x: clock.gap_findings(x.recordings), quick=True),
    Check(("clock-irregular",), SIGNALS, lambda x: clock.jitter_findings(x.recordings), quick=True, spoils=True),
    Check(("repeated-rows",), SIGNALS, lambda x: clock.repeat_findings(x.recordings), quick=True, spoils=True),
    Check(("saturated",), SIGNALS, lambda x: sensors.saturated_findings(x.recordings), spoils=True),
    Check(("stuck",), SIGNALS, lambda x: sensors.stuck_findings(x.recordings), quick=True, spoils=True),
    Check(("resolution",), SIGNALS, lambda x: sensors.coarse_torques(x.recordings), spoils=True),
    Check(("resolution",), SIGNALS, lambda x: sensors.smoothed_findings(x.recordings), spoils=True),
    Check(("degrees", "velocity-sign", "velocity-unit", "velocity-delay", "velocity-mismatch", "joint-order"),
          VELOCITIES, _velocities, ("motion",)),
    Check(("degrees",), VELOCITIES, _degrees, quick=True),
    Check(("odd-recording",), VELOCITIES, _odd_torques, ("motion", "sign")),
    Check(("never-moves", "excitation-low", "too-short"), VELOCITIES,
          lambda x: effort.excitation_findings(x.recordings, x.motion)),
    Check(("beyond-limit",), VELOCITIES, _limits, ("robot file",)),
    Check(("effort-sign",), VELOCITIES, lambda x: motion.pose_findings(x.recordings, x.model, x.joints),
          ("model", "sign", "no fit")),
    Check(("joint-order",), ORDER, _exchanged_efforts, ("fit", "half a minute")),
    Check(("joint-order", "joint-axis", "position-offset"), PLACES,
          lambda x: x.take("motion", arrangement.rearranged(x.motion, x.model, x.joints)),
          ("fit", "half a minute", "model")),
    Check(("effort-sign",), SIGNS, _signs, ("fit",)),
    Check(("torque-delay",), DELAYS, _delays, ("fit", "measured torque")),
    Check(("gravity-direction",), SCALES,
          lambda x: x.take("tree", arrangement.gravity_finding(x.motion, x.model, x.rows)), ("fit", "model")),
    Check(("effort-scale", "effort-motor-side", "effort-compensated", "payload"), SCALES, _scales, ("fit", "model")),
    Check(("effort-scale",), SCALES, _units, ("fit", "no model")),
    Check(("torque-changes",), CHANGES,
          lambda x: torque_changes.friction_findings(x.rows, x.joints, x.fits, x.recordings), ("fit",)),
    Check(("torque-changes",), CHANGES, lambda x: torque_changes.growth_findings(x.rows, x.joints, x.fits, x.unit),
          ("fit", "measured torque")),
    Check(("torque-changes",), CHANGES, lambda x: torque_changes.step_findings(x.rows, x.joints, x.fits, x.unit),
          ("fit", "measured torque")),
    Check(("contact-in-free-motion",), CHANGES, _contacts, ("fit", "model")),
    Check(("robot-file-other",), CHANGES, _other_robot, ("fit", "model", "measured torque")),
    Check(("backlash",), CHANGES, _plays),
]  # fmt: skip
"""All checks, in the order in which they run."""
