"""All checks of a set of recordings, and their findings as text and data."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePath

import numpy as np

from tauext import _core, plugins
from tauext.check.arrangement import (
    exchanged_efforts,
    fit_load,
    gravity_finding,
    loaded,
    payload_findings,
    rearranged,
    with_model,
)
from tauext.check.causes import causes_only, other_robot_findings
from tauext.check.clock import clock_findings, degree_findings, time_findings, wrap_findings
from tauext.check.contacts import contact_findings, spoils_contacts, unlabelled_findings
from tauext.check.effort import (
    SEARCH_S,
    delay_findings,
    drift_findings,
    excitation_findings,
    far_findings,
    growth_findings,
    inverted,
    kind_findings,
    moving_s,
    scale_findings,
    sign_findings,
    sign_vote,
    step_findings,
    strong_joints,
    torque_lags,
    unit_findings,
)
from tauext.check.finding import SEVERITIES, Facts, Finding, Found, Plots, run_added
from tauext.check.joint_fit import LEAST_ROWS, FitRows, JointFit, fit_joint, rows_of, torque_rows
from tauext.check.motion import DEGREES, Stretch, VelocityFit, pose_findings, stretches, velocity_findings
from tauext.check.odd_motion import odd_motions, odd_rates
from tauext.check.odd_torque import odd_torques
from tauext.check.robot_file import RobotFile, changed_findings, limit_findings, open_robot
from tauext.check.sensors import (
    coarse_findings,
    noise_nm,
    normal_ranges,
    sensor_findings,
    spike_findings,
    spikes_of,
    steps_of,
    torque_step_nm,
    without_spikes,
)
from tauext.data.dataset import ROBOT_FILES, load_dataset
from tauext.data.recording import Recording
from tauext.data.recording_file import describe, load_recording
from tauext.data.servo import derives_velocity, from_amperes, in_amperes, makes_torque, torque_unit
from tauext.errors import ConfigError
from tauext.files.kind import first_log, import_first
from tauext.files.plain_file import FORMAT
from tauext.progress import SILENT, Reporter
from tauext.robot.write import is_placeholder

# --- Measured quantities of every joint.


def facts_of(
    recordings: Sequence[Recording],
    added: Sequence[Found],
    measured: bool,
    velocities: Sequence[VelocityFit | None],
    rows: FitRows | None,
    fits: Sequence[JointFit],
    lags: Sequence[tuple[float, float, float]],
) -> list[Facts]:
    """Collect the measured quantities, one entry a joint.

    Args:
        recordings: as recorded.
        added: results of the checks of packages.
        measured: whether tau is measured, and no drive signal.
        rows: rows of the fits; None: no fits.
    """
    facts: list[Facts] = []
    noise = noise_nm(recordings)
    for j in range(len(recordings[0].joints)):
        fact: Facts = {
            "range_rad": max(float(np.ptp(r.q[:, j])) for r in recordings),
            "speed_rad_s": max(float(np.abs(r.dq[:, j]).max()) for r in recordings),
            "torque_nm": max(float(np.abs(r.tau[:, j]).max()) for r in recordings),
            "torque_noise_nm": float(noise[j]),
        }
        for one in added:
            fact |= one.facts[j] if one.facts else {}
        position_rad, velocity_rad_s = steps_of(recordings, j)
        steps = {"torque_step_nm": torque_step_nm(recordings, j)}
        steps |= {"position_step_rad": position_rad, "velocity_step_rad_s": velocity_rad_s}
        fact |= {name: step for name, step in steps.items() if step is not None}
        velocity = velocities[j]
        if velocity is not None:
            fact |= {"velocity_factor": velocity.factor, "velocity_delay_ms": velocity.lag_s * 1e3}
        if fits and rows is not None:
            fit = fits[j]
            fact |= {"torque_spread_nm": fit.torque_nm, "error_nm": fit.error_nm}
            if measured:
                fact["torque_delay_ms"] = lags[j][0] * 1e3
            if fit.gravity_factor[0]:
                fact |= {"gravity_factor": fit.gravity_factor[0], "gravity_factor_error": fit.gravity_factor[1]}
        facts.append(fact)
    return facts


# --- Order of the checks: signals, then motion, then torque against model. Faults are corrected for later checks.


STEPS = (
    "signals",
    "velocities",
    "order of the torques",
    "order and zero of the joints",
    "signs",
    "delays",
    "gravity, scale and payload",
    "drift and contacts",
)
"""Names of the steps, reported as progress."""

OF_TORQUES = ("effort-scale", "effort-motor-side", "effort-limit", "payload-missing", "payload-absent")
"""Codes of findings that apply only to a torque in N m."""
OF_CURRENTS = ("effort-scale", "effort-motor-side", "position-offset")
"""Faults of a torque that are warnings for a current."""


@dataclass(frozen=True)
class Diagnosis:
    """Findings, worst first, and measured quantities of every joint."""

    joints: tuple[str, ...]
    findings: list[Finding]
    facts: list[Facts]
    """Measured quantities of each joint, by names that contain their units."""
    rows: FitRows | None = None
    """Corrected data of the last fit; None: nothing moves."""
    fits: list[JointFit] = field(default_factory=list)
    tree: _core.Tree | None = None
    """The model, with corrected load or gravity; None: no model."""
    lag_s: float = 0.0
    """Delay of the torque, [s]."""
    plots: list[Callable[[], Plots]] = field(default_factory=list)
    """Of the checks of packages."""
    torque_unit: str = "Nm"
    """Unit of the recordings' tau: Nm or A."""

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

    Each fault is corrected before the next step (time, spikes, degrees, order, sign, delay, gravity, payload). A
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
    if missing := not_checked(recordings):
        report.say(missing)
    with report.progress("check") as show:
        diagnosis = _examine(
            recordings, robot, gravity, called_free, lambda step: show(STEPS.index(step), len(STEPS), step)
        )
        show(len(STEPS), len(STEPS), "steps")
    return diagnosis


def _examine(
    recordings: Sequence[Recording],
    robot: Path | None,
    gravity: Sequence[float] | None,
    called_free: Collection[str],
    begin: Callable[[str], None],
) -> Diagnosis:
    """Run the checks; `begin` is called with each of STEPS that applies."""
    begin("signals")
    joints = _same_joints(recordings)
    file = open_robot(robot, joints, gravity) if robot is not None else None
    found = [*(file.findings if file else []), *contact_findings(recordings, called_free)]
    found += changed_findings(recordings, robot) if robot is not None else []
    timed, recordings = time_findings(recordings)
    wraps, recordings = wrap_findings(recordings)
    recordings, odd = _alike(recordings, odd_rates(recordings))
    found += wraps + odd
    recorded, (added, recordings) = recordings, run_added(recordings, corrected=False)
    unsigned = any(one.unsigned for one in added)
    measured = not any(one.drive for one in added) and not any(map(makes_torque, recordings))
    found += [finding for one in added for finding in one.findings] + coarse_findings(recordings)
    spikes, recordings = _spikes(recordings, file)
    found += timed + spikes
    motion = stretches(recordings)
    recordings, odd = _alike(recordings, odd_motions(recordings, motion))
    motion = stretches(recordings) if odd else motion
    found += odd + clock_findings(recordings) + sensor_findings(recordings)

    begin("velocities")
    recordings, motion, velocities, units = _in_radians(recordings, motion, file)
    tree = file.tree if file else None
    names, unit = [r.name for r in recordings], torque_unit(recordings)
    rows = None if unsigned or not motion else rows_of(motion, tree)
    odd = [] if rows is None else of_servos(odd_torques(rows, motion, tree, joints, names, unit), recordings)
    recordings, odd = _alike(recordings, odd)
    if odd:
        motion = stretches(recordings)
        rows = rows_of(motion, tree) if motion else None
    if any(map(derives_velocity, recordings)):
        units = [finding for finding in units if finding.code != "velocity-delay"]  # an intended delay of the window
    found += units + odd + excitation_findings(recordings, motion)
    found += limit_findings(recordings, file) if file else []

    standing = any(finding.code == "never-moves" for finding in found)
    fits: list[JointFit] = []
    lags: list[tuple[float, float, float]] = []
    lag_s = 0.0
    if standing or rows is None or len(rows.time_s) < LEAST_ROWS:
        rows = None
    if unsigned:
        pass  # no further check applies to a torque without a sign
    elif rows is not None:
        torque_found, rows, fits, lags, tree, lag_s = _torque(
            rows, motion, tree, joints, recordings, found, measured, begin
        )
        torque_found = without_scale(torque_found, added)
        if rows is not None and rows.has_model and file is not None and measured:
            torque_found += other_robot_findings(rows, joints, fits, torque_found, file.position_limits_rad)
        unknown = in_amperes(recordings)
        found += _of_currents(torque_found, unknown) if unknown or from_amperes(recordings) else torque_found
    elif tree is not None:
        found += pose_findings(recordings, tree, joints)
    last, _ = run_added(recordings, corrected=True)
    found = causes_only([*found, *(finding for one in last for finding in one.findings)])
    facts = facts_of(recorded, [*added, *last], measured, velocities, rows, fits, lags)
    plots = [one.plots for one in (*added, *last) if one.plots is not None]
    return Diagnosis(joints, found, facts, rows, fits, tree, lag_s, plots, torque_unit(recorded))


def not_checked(recordings: Sequence[Recording]) -> str | None:
    """Sentence that names the package that checks what servos report; None: it is installed, or there are no servos."""
    how = plugins.how_to_add("servo-torque") if any(r.provenance.get("servo") for r in recordings) else None
    return how and f"the signals of the servos are not checked: {how}"


def _same_joints(recordings: Sequence[Recording]) -> tuple[str, ...]:
    if not recordings:
        raise ConfigError("there is no recording to check; give at least one")
    for r in recordings:
        if r.joints != recordings[0].joints:
            raise ConfigError(
                f"recording '{r.name}' has the joints {', '.join(r.joints)}, '{recordings[0].name}' "
                f"{', '.join(recordings[0].joints)}; recordings checked together must be of one arm"
            )
    return recordings[0].joints


def _spikes(recordings: Sequence[Recording], file: RobotFile | None) -> tuple[list[Finding], list[Recording]]:
    normal, limits = normal_ranges(recordings), file.torque_limits_nm if file else None
    found, corrected = [], []
    for r in recordings:
        spikes = spikes_of(r, normal, limits)
        found += spike_findings(r, spikes, normal)
        corrected.append(without_spikes(r, spikes))
    return found, corrected


def of_servos(odd: list[Finding], recordings: Sequence[Recording]) -> list[Finding]:
    """Reduce findings to warnings where the torque was computed from servo signals. A position controller without
    integral action rests anywhere within its friction, so that recordings of few poses seem shifted, scaled or
    inverted."""
    made = {r.name for r in recordings if makes_torque(r)}
    return [replace(finding, severity="warning") if finding.recording in made else finding for finding in odd]


def _alike(recordings: Sequence[Recording], odd: list[Finding]) -> tuple[list[Recording], list[Finding]]:
    """Recordings without findings, and the findings."""
    names = {finding.recording for finding in odd}
    return [r for r in recordings if r.name not in names], odd


def _in_radians(
    recordings: Sequence[Recording], motion: list[Stretch], file: RobotFile | None
) -> tuple[Sequence[Recording], list[Stretch], list[VelocityFit | None], list[Finding]]:
    joints = recordings[0].joints
    found, velocities, factors = velocity_findings(motion, joints) if motion else ([], [None] * len(joints), None)
    if factors is not None and (factors != 1).any():
        recordings = [replace(r, q=r.q / factors) for r in recordings]
        motion = stretches(recordings)
    degrees = degree_findings(recordings, motion, file.position_limits_rad if file else None)
    if degrees:
        names = [finding.joint for finding in degrees]
        by = np.array([DEGREES if None in names or joint in names else 1.0 for joint in joints])
        recordings = [replace(r, q=r.q / by, dq=r.dq / by) for r in recordings]
        motion = stretches(recordings)
    return recordings, motion, velocities, found + degrees


def _torque(
    rows: FitRows,
    motion: list[Stretch],
    tree: _core.Tree | None,
    joints: Sequence[str],
    recordings: Sequence[Recording],
    signal_findings: Sequence[Finding],
    measured: bool,
    begin: Callable[[str], None],
) -> tuple[list[Finding], FitRows, list[JointFit], list[tuple[float, float, float]], _core.Tree | None, float]:
    """Check order, axes, zeros, sign, gravity, delay, kind and payload, drift and contacts, each on the corrected data
    of the step before. Returns findings, the last rows and fits, the lags, the corrected model and the torque's lag.

    Args:
        rows: of this motion and tree.
        measured: whether tau is measured; that of a position controller lags, and rests anywhere within the friction.
    """
    n = len(joints)
    begin("order of the torques")
    found: list[Finding] = []
    arranged: list[Finding] = []
    long_enough = moving_s(motion) >= SEARCH_S
    if long_enough:
        found, column = exchanged_efforts(rows, joints)
    if found:
        motion = [replace(s, tau=np.ascontiguousarray(s.tau[:, column])) for s in motion]
    if long_enough and tree is not None:
        begin("order and zero of the joints")
        arranged, motion = rearranged(motion, tree, joints)
    begin("signs")
    if found or arranged:
        rows = rows_of(motion, tree)
    found += arranged
    fits = [fit_joint(rows, j) for j in range(n)]
    votes = [sign_vote(rows, j, fit) for j, fit in enumerate(fits)]
    found += sign_findings(joints, votes, fits, torque_unit(recordings))
    signs = np.array([-1.0 if inverted(vote) else 1.0 for vote in votes])
    if (signs < 0).any():
        motion = [replace(s, tau=s.tau * signs) for s in motion]
        rows = replace(rows, tau=torque_rows(motion, 0.0))

    begin("delays")
    lags = torque_lags(motion, rows)
    late, lag_s = delay_findings(lags, joints, 1 / motion[0].rate_hz) if long_enough and measured else ([], 0.0)
    found += late
    begin("gravity, scale and payload")
    if tree is not None:
        tilted, tree = gravity_finding(motion, tree, rows)
        found += tilted
        rows = with_model(rows, motion, tree) if tilted else rows
    rows = replace(rows, tau=torque_rows(motion, lag_s))
    fits = [fit_joint(rows, j) for j in range(n)]
    if tree is not None:
        scaled, heavier = _scale(motion, tree, rows, fits, joints, torque_unit(recordings))
        found += scaled
        if heavier is not tree:
            tree, rows = heavier, with_model(rows, motion, heavier)
            fits = [fit_joint(rows, j) for j in range(n)]
    elif not in_amperes(recordings):
        found += unit_findings(joints, fits, "Nm")
    begin("drift and contacts")
    found += drift_findings(rows, joints, fits, recordings)
    if measured:
        unit = torque_unit(recordings)
        found += growth_findings(rows, joints, fits, unit) + step_findings(rows, joints, fits, unit)
    if not spoils_contacts(signal_findings) and not any(f.severity == "fault" for f in found):
        found += unlabelled_findings(recordings, tree, lag_s)
    return found, rows, fits, lags, tree, lag_s


def without_scale(found: Sequence[Finding], added: Sequence[Found]) -> list[Finding]:
    """Remove findings that compare efforts with N m where a check found that the effort is no torque."""
    other = {joint for one in added for joint in one.no_torque}
    return [f for f in found if not (f.code in OF_TORQUES and (f.joint in other or (f.joint is None and other)))]


def _of_currents(found: Sequence[Finding], unknown: bool) -> list[Finding]:
    """Warnings instead of faults: training finds torque constants, and without them the size of gravity is weak
    evidence.

    Args:
        unknown: the import gave no torque constants.
    """

    def advice(finding: Finding) -> str:
        if not unknown:
            return f'the torque constant of the import is wrong ("unknown" lets `train` fit it); else {finding.advice}'
        if finding.code == "effort-scale":
            return (
                "no action is needed: `train` fits the torque constants. Factors that grow towards the tip may also be "
                "a payload that is not in the model"
            )
        return f"no action is needed if torque constants explain it, which `train` fits; else {finding.advice}"

    return [replace(f, severity="warning", advice=advice(f)) if f.code in OF_CURRENTS else f for f in found]


def _scale(
    motion: list[Stretch],
    tree: _core.Tree,
    rows: FitRows,
    fits: Sequence[JointFit],
    joints: Sequence[str],
    unit: str,
) -> tuple[list[Finding], _core.Tree]:
    """Findings of a payload if it explains all factors, else of the factors; and the tree with the payload."""
    found, judged = kind_findings(rows, joints, fits, strong_joints(rows, fits))
    found += far_findings(rows, joints, fits, unit)
    factors = scale_findings(joints, fits, judged)
    if found or not judged:
        return found + factors, tree
    load = fit_load(motion, tree, rows)
    payload = payload_findings(load, joints, judged, unit)
    if not payload:
        return factors, tree
    tree_with, off = loaded(tree, load), [joints.index(finding.joint or "") for finding in factors]
    then = with_model(rows, motion, tree_with)
    rest = scale_findings(joints, [fit_joint(then, j) for j in range(len(joints))], off)
    return (factors, tree) if rest else (payload, tree_with)


# --- The diagnosis as text for a terminal and as plain data for a script.


TORQUE = "unit of tau"
"""Unit of columns that have the unit of the recordings' torque."""
COLUMNS = (
    ("torque_is", "tau is", "", ""),
    ("range_rad", "range", "rad", ".2f"),
    ("speed_rad_s", "speed", "rad/s", ".2f"),
    ("torque_nm", "torque", TORQUE, ".3g"),
    ("torque_noise_nm", "noise", TORQUE, ".2g"),
    ("torque_step_nm", "tau step", "", ".3g"),
    ("position_step_rad", "q step", "rad", ".3g"),
    ("velocity_step_rad_s", "dq step", "rad/s", ".2g"),
    ("backlash_rad", "play", "rad", ".2g"),
    ("velocity_factor", "dq by dq/dt", "", ".3f"),
    ("velocity_delay_ms", "dq late", "ms", ".1f"),
    ("torque_delay_ms", "tau late", "ms", ".1f"),
    ("gravity_factor", "tau by g", "", ".3f"),
    ("error_nm", "unexplained", TORQUE, ".2g"),
)
"""Measured quantities of a joint: name, heading, unit and format."""


def as_text(diagnosis: Diagnosis) -> str:
    """Text for a terminal: findings grouped by code, evidence and advice, then a table of the measured quantities."""
    lines = []
    shown = grouped(diagnosis.findings)
    for finding, joints in shown:
        where = f" ({', '.join(joints)})" if joints else ""
        lines += [f"{finding.severity}: {finding.code}{where}"]
        for one in diagnosis.findings:
            if (one.code, one.severity) == (finding.code, finding.severity):
                lines.append(f"    {one.joint + ': ' if one.joint else ''}{one.evidence}")
        lines.append(f"    -> {finding.advice}")
    counts = [sum(finding.severity == severity for finding, _ in shown) for severity in SEVERITIES]
    summary = ", ".join(f"{n} {what}{'' if n == 1 else 's'}" for n, what in zip(counts, SEVERITIES, strict=True))
    return "\n".join([*lines, "" if lines else "nothing found", *_table(diagnosis), "", summary])


def as_files(diagnosis: Diagnosis, recordings: Iterable[str], without_model: bool) -> tuple[str, dict]:
    """Contents of check.txt and check.json.

    Args:
        recordings: names of the examined recordings.
        without_model: whether they were checked without a robot file.
    """
    text = as_text(diagnosis)
    if without_model:
        text = f"no robot model: order, scale, gravity and payload cannot be checked\n{text}"
    return text, as_data(diagnosis) | {"recordings": list(recordings)}


def grouped(findings: list[Finding]) -> list[tuple[Finding, list[str]]]:
    """The first finding of each code and severity, and the joints of all of them."""
    groups: dict[tuple[str, str], tuple[Finding, list[str]]] = {}
    for finding in findings:
        _, joints = groups.setdefault((finding.code, finding.severity), (finding, []))
        if finding.joint and finding.joint not in joints:
            joints.append(finding.joint)
    return list(groups.values())


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
    units = {TORQUE: diagnosis.torque_unit}
    head = ["joint", *(f"{title} {units.get(unit, unit)}".strip() for _, title, unit, _ in shown)]
    rows = [
        [joint, *(format(fact[key], form) if key in fact else "-" for key, _, _, form in shown)]
        for joint, fact in zip(diagnosis.joints, diagnosis.facts, strict=True)
    ]
    widths = [max(len(row[k]) for row in [head, *rows]) for k in range(len(head))]

    def line(row: list[str]) -> str:
        first, *others = zip(row, widths, strict=True)
        return "  ".join([first[0].ljust(first[1]), *(cell.rjust(width) for cell, width in others)])

    return [line(row) for row in [head, *rows]]


# --- Input: recordings of a dataset, a folder or by name, and the robot file beside them.


MOST_MINUTES = 30.0
"""Longest time examined, with recordings left out evenly; half an hour suffices to detect wrong units."""


def gather(
    data: tuple[Path, ...], robot: Path | None, report: Reporter = SILENT
) -> tuple[list[Recording], set[str], Path | None]:
    """Load recordings, up to MOST_MINUTES; also returns names of those in free sets, and the robot file.

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
    return _evenly(files, report), free, robot_file


def _evenly(files: list[Path], report: Reporter) -> list[Recording]:
    """Load the recordings; of too many, every second or third."""
    heads = [describe(file) for file in files]
    minutes = sum(head.samples / head.rate_hz for head in heads) / 60
    stride = max(1, -int(-minutes // MOST_MINUTES))
    chosen, recordings = files[::stride], []
    with report.progress("read") as show:
        for file in chosen:
            recordings.append(load_recording(file))
            show(len(recordings), len(chosen), "recordings")
    return recordings


# --- Quick checks of every recording: without fits, and for contacts with one fit.


OF_ALL = ("quantised", "smoothed", "saturated")
"""Codes decided on all recordings together: a joint may rest, or hold one torque, in a single recording."""


def quick_checks(recording: Recording, torque_limits_nm: np.ndarray | None) -> list[Finding]:
    """Check one recording for unsigned efforts, clock, spikes, stuck and saturated signals, degrees and unit of time.

    Args:
        torque_limits_nm: (joints,), infinite where the robot file has none; None: no robot file.
    """
    found, (corrected,) = time_findings([recording])
    wraps, (corrected,) = wrap_findings([corrected])
    found += wraps
    added, (corrected,) = run_added([corrected], corrected=False)
    found += [f for one in added for f in one.findings if f.severity == "fault"]
    normal = normal_ranges([corrected])
    spikes = spikes_of(corrected, normal, torque_limits_nm)
    found += spike_findings(corrected, spikes, normal)
    corrected = without_spikes(corrected, spikes)
    found += clock_findings([corrected])
    found += [f for f in sensor_findings([corrected]) if f.code not in OF_ALL]
    found += degree_findings([corrected], stretches([corrected]))
    return sorted((replace(f, recording=recording.name) for f in found), key=lambda f: SEVERITIES.index(f.severity))


def unlabelled_contacts(recordings: Sequence[Recording], diagnosis: Diagnosis) -> list[Finding]:
    """Find contacts without a label, as examine() does, on all of the recordings.

    Args:
        recordings: of the same joints.
        diagnosis: of a share of them, without a fault.
    """
    normal = normal_ranges(recordings)
    corrected = [without_spikes(r, spikes_of(r, normal)) for r in recordings]
    return unlabelled_findings(corrected, diagnosis.tree, diagnosis.lag_s)
