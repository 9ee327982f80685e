"""All checks of a set of recordings, and their findings as text and data."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePath

import numpy as np

from tauext import _core, plugins
from tauext.check.checks import CHECKS, OF_CURRENTS, STEPS, causes_only, run
from tauext.check.examination import Examination
from tauext.check.finding import SEVERITIES, Facts, Finding, Found, Plots, Severity
from tauext.check.joint_fit import FitRows, JointFit
from tauext.check.sensors import noise_nm, steps_of, torque_step_nm
from tauext.check.spikes import normal_ranges, spikes_of, without_spikes
from tauext.check.torque_changes import unlabelled_findings
from tauext.data.dataset import ROBOT_FILES, load_dataset
from tauext.data.recording import Recording
from tauext.data.recording_file import describe, load_recording
from tauext.data.servo import from_amperes, in_amperes, torque_unit
from tauext.errors import ConfigError
from tauext.files.kind import first_log, import_first
from tauext.files.plain_file import FORMAT
from tauext.progress import SILENT, Reporter, aligned
from tauext.robot.write import is_placeholder

# --- The diagnosis: findings, and measured quantities of every joint.


@dataclass(frozen=True)
class Diagnosis:
    """Findings, worst first, and measured quantities of every joint."""

    joints: tuple[str, ...]
    findings: list[Finding]
    facts: list[Facts]  # measured quantities of each joint, by names that contain their units
    rows: FitRows | None = None  # corrected data of the last fit; None: nothing moves
    fits: list[JointFit] = field(default_factory=list)
    tree: _core.Tree | None = None  # the model, with corrected load or gravity; None: no model
    lag_s: float = 0.0  # delay of the torque, [s]
    plots: list[Callable[[], Plots]] = field(default_factory=list)  # of the checks of packages
    torque_unit: str = "Nm"  # unit of the recordings' tau: Nm or A
    spoiled: bool = False  # whether a fault of the signals may look like a contact, so that none were searched for

    @property
    def faulty(self) -> bool:
        return any(finding.severity == "fault" for finding in self.findings)


def examine(
    recordings: Sequence[Recording],
    robot: Path | None = None,
    gravity: Sequence[float] | None = None,
    called_free: Collection[str] = (),
    report: Reporter = SILENT,
) -> Diagnosis:
    """Run all checks on recordings of one arm in free motion.

    Each fault is corrected before the next check (time, spikes, degrees, order, sign, delay, gravity, payload). A
    recording that disagrees with the others is left out. So one fault gives one finding. Each check's module defines
    its thresholds, with reasons.

    Args:
        recordings: of the same joints; labelled contacts are left out of fits.
        robot: URDF or MJCF; None: skip checks that need a model.
        gravity: acceleration of free fall in the base frame; None: the file's.
        called_free: names of recordings declared free of contact.
        report: receives the progress.

    Raises:
        ConfigError: no recording, or recordings of different joints.
        RobotError: the robot file is missing."""
    _expect_one_arm(recordings)
    if missing := not_checked(recordings):
        report.say(missing)
    x = Examination(recordings, robot, gravity, called_free)
    with report.progress("check") as show:
        found = run(CHECKS, x, lambda step: show(STEPS.index(step), len(STEPS), step))
        show(len(STEPS), len(STEPS), "steps")
    found = _of_currents(without_scale(found, x.added), x.recordings)
    rows, fits = (x.rows, x.fits) if x.has_fit else (None, [])
    plots, unit = [one.plots for one in x.added if one.plots is not None], torque_unit(x.recorded)
    return Diagnosis(x.joints, causes_only(found), facts_of(x), rows, fits, x.tree, x.lag_s, plots, unit, x.spoiled)


def not_checked(recordings: Sequence[Recording]) -> str | None:
    """Sentence that names the package that checks what servos report; None: it is installed, or there are no servos."""
    how = plugins.how_to_add("servo-torque") if any(r.provenance.get("servo") for r in recordings) else None
    return how and f"the signals of the servos are not checked: {how}"


def _expect_one_arm(recordings: Sequence[Recording]) -> None:
    if not recordings:
        raise ConfigError("there is no recording to check; give at least one")
    for r in recordings:
        if r.joints != recordings[0].joints:
            raise ConfigError(
                f"recording '{r.name}' has the joints {', '.join(r.joints)}, '{recordings[0].name}' "
                f"{', '.join(recordings[0].joints)}; recordings checked together must be of one arm"
            )


def without_scale(found: Sequence[Finding], added: Sequence[Found]) -> list[Finding]:
    """Remove findings that compare efforts with N m where a check found that the effort is no torque."""
    codes, other = ("effort-scale", "effort-motor-side", "payload"), {joint for one in added for joint in one.no_torque}
    return [f for f in found if not (f.code in codes and (f.joint in other or (f.joint is None and other)))]


def _of_currents(found: list[Finding], recordings: Sequence[Recording]) -> list[Finding]:
    """Warnings instead of faults for recordings of currents: training finds torque constants, and without them the size
    of gravity is weak evidence."""
    unknown = in_amperes(recordings)
    if not (unknown or from_amperes(recordings)):
        return found

    def advice(finding: Finding) -> str:
        if not unknown:
            return f'the torque constant of the import is wrong ("unknown" lets `train` fit it); else {finding.advice}'
        if finding.code == "effort-scale":
            return (
                "no action is needed: `train` fits the torque constants. Factors that grow towards the tip may also be "
                "a payload that is not in the model"
            )
        return f"no action is needed if torque constants explain it, which `train` fits; else {finding.advice}"

    return [replace(f, severity="warning", advice=advice(f)) if f.code in OF_CURRENTS and f.joint else f for f in found]


def facts_of(x: Examination) -> list[Facts]:
    """Measured quantities of every joint, once the checks have run."""
    recorded, noise = x.recorded, noise_nm(x.recorded)
    facts: list[Facts] = []
    for j in range(len(x.joints)):
        fact: Facts = {
            "range_rad": max(float(np.ptp(r.q[:, j])) for r in recorded),
            "speed_rad_s": max(float(np.abs(r.dq[:, j]).max()) for r in recorded),
            "torque_nm": max(float(np.abs(r.tau[:, j]).max()) for r in recorded),
            "torque_noise_nm": float(noise[j]),
        }
        for one in x.added:
            fact |= one.facts[j] if one.facts else {}
        position_rad, velocity_rad_s = steps_of(recorded, j)
        steps = {"torque_step_nm": torque_step_nm(recorded, j)}
        steps |= {"position_step_rad": position_rad, "velocity_step_rad_s": velocity_rad_s}
        fact |= {name: step for name, step in steps.items() if step is not None}
        velocity = x.velocities[j] if x.velocities else None
        if velocity is not None:
            fact |= {"velocity_factor": velocity.factor, "velocity_delay_ms": velocity.lag_s * 1e3}
        if x.has_fit:
            fit = x.fits[j]
            fact |= {"torque_spread_nm": fit.torque_nm, "error_nm": fit.error_nm}
            if x.lags:
                fact["torque_delay_ms"] = x.lags[j][0] * 1e3
            if fit.gravity_factor[0]:
                fact |= {"gravity_factor": fit.gravity_factor[0], "gravity_factor_error": fit.gravity_factor[1]}
        facts.append(fact)
    return facts


# --- The diagnosis as text for a terminal and as plain data for a script.


UNSEEN = "contacts without a label are only found where all joints rest"
"""What the checks miss without a robot model."""

COLUMNS = (
    ("torque_is", "tau is", "", ""),
    ("range_rad", "range", "rad", ".2f"),
    ("speed_rad_s", "speed", "rad/s", ".2f"),
    ("torque_nm", "torque", None, ".3g"),
    ("torque_noise_nm", "noise", None, ".2g"),
    ("torque_step_nm", "tau step", "", ".3g"),
    ("position_step_rad", "q step", "rad", ".3g"),
    ("velocity_step_rad_s", "dq step", "rad/s", ".2g"),
    ("backlash_rad", "play", "rad", ".2g"),
    ("velocity_factor", "dq by dq/dt", "", ".3f"),
    ("velocity_delay_ms", "dq late", "ms", ".1f"),
    ("torque_delay_ms", "tau late", "ms", ".1f"),
    ("gravity_factor", "tau by g", "", ".3f"),
    ("error_nm", "unexplained", None, ".2g"),
)
"""Measured quantities of a joint: name, heading, unit, None: that of the recordings' tau, and format."""


def as_text(diagnosis: Diagnosis) -> str:
    """Text for a terminal: findings grouped by code, evidence and advice, then a table of the measured quantities."""
    lines: list[str] = []
    groups: dict[tuple[Severity, str], list[Finding]] = {}
    for finding in diagnosis.findings:
        groups.setdefault((finding.severity, finding.code), []).append(finding)
    for (severity, code), same in groups.items():
        joints = ", ".join(dict.fromkeys(one.joint for one in same if one.joint))
        lines.append(f"{severity}: {code}{f' ({joints})' if joints else ''}")
        lines += [f"    {one.joint + ': ' if one.joint else ''}{one.evidence}" for one in same]
        lines += [f"    -> {advice}" for advice in dict.fromkeys(one.advice for one in same)]
    counts = [sum(of == severity for of, _ in groups) for severity in SEVERITIES]
    summary = ", ".join(f"{n} {what}{'' if n == 1 else 's'}" for n, what in zip(counts, SEVERITIES, strict=True))
    return "\n".join([*lines, "" if lines else "nothing found", *_table(diagnosis), "", summary])


def as_files(diagnosis: Diagnosis, recordings: Iterable[str], without_model: bool) -> tuple[str, dict]:
    """Contents of check.txt and check.json, of recordings of these names."""
    text = as_text(diagnosis)
    if without_model:
        text = f"no robot model: order, scale, gravity and payload cannot be checked, and {UNSEEN}\n{text}"
    return text, as_data(diagnosis) | {"recordings": list(recordings)}


def as_data(diagnosis: Diagnosis) -> dict:
    """JSON-ready: joints, findings, facts by joint, faulty."""
    return {
        "format": FORMAT,
        "joints": list(diagnosis.joints),
        "faulty": diagnosis.faulty,
        "findings": [asdict(finding) for finding in diagnosis.findings],
        "facts": dict(zip(diagnosis.joints, diagnosis.facts, strict=True)),
    }


def _table(diagnosis: Diagnosis) -> list[str]:
    shown = [c for c in COLUMNS if any(c[0] in fact for fact in diagnosis.facts)]
    own = diagnosis.torque_unit
    head = ["joint", *(f"{title} {own if unit is None else unit}".strip() for _, title, unit, _ in shown)]
    rows = [
        [joint, *(format(fact[key], form) if key in fact else "-" for key, _, _, form in shown)]
        for joint, fact in zip(diagnosis.joints, diagnosis.facts, strict=True)
    ]
    return aligned([head, *rows])


# --- Input: recordings of a dataset, a folder or by name, and the robot file beside them.


def gather(
    data: tuple[Path, ...], robot: Path | None, report: Reporter = SILENT, most_minutes: float = 30.0
) -> tuple[list[Recording], set[str], Path | None]:
    """Load recordings, of many every second or third; also returns names of those in free sets, and the robot file.

    Args:
        most_minutes: longest time that is loaded; half an hour suffices to detect wrong units.

    Raises:
        ConfigError: nothing to check.
    """
    files: list[Path] = []
    free: set[str] = set()
    for path in data:
        if not path.is_dir():
            files.append(path)
            continue
        if (path / "split.json").is_file():
            split = load_dataset(path).split
            names = [*split.train, *split.validation, *split.test]
            free |= {PurePath(name).stem for name in names}
            files += [path / name for name in names]
        else:
            files += sorted(path.glob("*.parquet"))
        robot = robot or next((path / name for name in ROBOT_FILES if (path / name).is_file()), None)
    robot_file = None if robot is None or is_placeholder(robot) else robot
    if not files:
        log = next((log for path in data if path.is_dir() and (log := first_log(path))), None)
        remedy = f"; {import_first(log)}" if log is not None else ""
        raise ConfigError(f"{', '.join(map(str, data)) or 'data'}: no recording (*.parquet) to check{remedy}")
    heads = [describe(file) for file in files]
    minutes = sum(head.samples / head.rate_hz for head in heads) / 60
    chosen, recordings = files[:: max(1, -int(-minutes // most_minutes))], []
    with report.progress("read") as show:
        for file in chosen:
            recordings.append(load_recording(file))
            show(len(recordings), len(chosen), "recordings")
    return recordings, free, robot_file


# --- Checks of the whole of a training's recordings, of which only a share is examined.


def quick_checks(recording: Recording, torque_limits_nm: np.ndarray | None) -> list[Finding]:
    """Check one recording for unsigned efforts, clock, spikes, stuck signals, degrees and unit of time."""
    x = Examination([recording], torque_limits_nm=torque_limits_nm)
    found = run((check for check in CHECKS if check.quick), x, lambda step: None)
    return sorted((replace(f, recording=recording.name) for f in found), key=lambda f: SEVERITIES.index(f.severity))


def unlabelled_contacts(recordings: Sequence[Recording], diagnosis: Diagnosis) -> list[Finding]:
    """Find contacts without a label, as examine() does, on all recordings of a share of which the diagnosis is."""
    normal = normal_ranges(recordings)
    corrected = [without_spikes(r, spikes_of(r, normal)) for r in recordings]
    return unlabelled_findings(corrected, diagnosis.tree, diagnosis.lag_s)
