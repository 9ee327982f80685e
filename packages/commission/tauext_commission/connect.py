"""A live stream checked before and while it is recorded: facts of the arm, and findings in words."""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from tauext._core import ServoConstants
from tauext.check.effort import HIGH, LOW
from tauext.check.examination import SEARCH_S
from tauext.check.examine import Diagnosis, examine
from tauext.check.finding import Finding, codes
from tauext.check.motion import MOVING_RAD_S
from tauext.data.dataset import ROBOT_FILES
from tauext.data.description import Arm, load_arm, parse_arm
from tauext.data.recording import Recording, TorqueTiming, fitted_period_ns, lost_samples
from tauext.data.servo import AMPERES, FROM_AMPERES, RAW_SIGNALS, derives_velocity, servo_facts, servo_of
from tauext.data.servo_types import SERVO_TYPES
from tauext.errors import AwayError, ConfigError, TauextError
from tauext.files.atomic_write import atomic_write
from tauext.files.plain_file import read_json
from tauext.monitor.monitored_time import LATE_S, PARTLY, Monitored, MonitoredTime, percent
from tauext.monitor.source import Block, Describes, Sample, ServoStage, Source, SourceFacts, SourceSettings
from tauext.monitor.turns import Turns
from tauext.robot.capsules import SHAPES_FILE, write_shapes
from tauext.robot.read import load_tree
from tauext.robot.write import is_placeholder, write_placeholder, write_robot
from tauext.robot.xml_file import read_xml
from tauext.sources.describing import why_another
from tauext_commission.folder import CommissionFolder, Segment

# --- Findings about a live stream.


@dataclass(frozen=True)
class Remark:
    """One line about the stream, for a person; a plain dict of it is an entry of findings.json."""

    code: str
    """Key of check.finding.codes(), or of TOPICS."""
    severity: Literal["fault", "warning", "note", "good"]
    """fault: what is learned from this stream is wrong. good: checked, and as it should be."""
    joint: str | None
    words: str
    remedy: str
    """What a person can do; empty: nothing is to be done."""
    waits: bool = False
    """Whether this cannot be judged until the arm has moved more."""


TOPICS = {
    "joints": ("joint-names", "joint-order", "joint-axis", "stuck", "model-unusable", "not-measured"),
    "rate": ("wrong-rate", "clock-gaps", "repeated-rows"),
    "clock": ("clock-irregular", "time-unit", "spike"),
    "units": ("degrees", "velocity-unit", "velocity-mismatch", "velocity-sign", "velocity-delay", "beyond-limit"),
    "sign": ("effort-sign", "unsigned-torque", "load-sign-bit"),
    "signal": (
        "effort-duty", "effort-compensated", "beyond-limit", "effort-motor-side", "effort-scale", "supply-current",
        "current-signed", "saturated", "resolution", "torque-delay",
    ),
    "robot-file": (
        "gravity-direction", "inertia-impossible", "payload", "position-offset", "joint-names", "model-unusable",
    ),
}  # fmt: skip
"""What is checked, and the codes that speak against it. A topic without a finding is good, or waits for motion."""
WAITING = {"too-short": "", "never-moves": "", "excitation-low": ""}
"""Codes that mean too little motion so far, which is no fault of a stream."""
HARMLESS = {
    "contact-in-free-motion": "no action is needed: such motion is left out of training; if nothing touched the arm, "
    "its torque jumps",
    "torque-changes": "no action is needed: the monitor follows friction that changes slowly",
}
"""Remedies of what commissioning handles by itself: such warnings are notes."""
REMEDIES = {
    "effort-sign": "reverse this joint's effort in the driver: it must be positive where the motor drives the joint in "
    "its positive direction",
    "time-unit": "let the driver send stamps in seconds and nanoseconds",
    "repeated-rows": "let the driver send each measurement once, or lower its rate to that of the robot's state",
    "spike": "no action is needed while it is rare: a lost or mixed-up message, or a glitch of a sensor",
    "joint-names": "give the robot file of this arm (--robot), or name the joints in the driver as the file does",
    "effort-scale": "for a current, no action is needed: training finds the torque constants; for another unit, let "
    "the driver send N m; if the arm carries a payload, add it to the robot file",
}
"""Remedies that differ from those of `tauext check`, which are about an import."""
MOVE = "let the arm run its program"


def judge(recordings: Sequence[Recording], robot: Path | None, facts: SourceFacts) -> list[Remark]:
    """All checks of `tauext check` on what was received so far, in words for a live stream; worst first.

    Args:
        recordings: of the same joints, in order of time; may be empty.
        robot: robot file; None or a placeholder: there is no model.
    """
    robot = None if robot is None or is_placeholder(robot) else robot
    if not recordings:
        return [_waiting(topic, f"{name}: no sample yet", "") for topic, name in NAMES.items()]
    try:
        diagnosis = examine(recordings, robot)
    except TauextError as error:
        return [Remark("joints", "fault", None, str(error), "")]
    low = {finding.joint for finding in diagnosis.findings if finding.code == "excitation-low"}
    early = {*TOPICS["sign"], *TOPICS["signal"]}
    lives = [
        as_live(finding)
        for finding in diagnosis.findings
        if finding.code not in WAITING
        and not (finding.code in early and finding.joint in low)  # a torque is judged by the joint's motion
        and not (finding.code == "repeated-rows" and derives_velocity(recordings[0]))  # servos stand between two counts
    ]
    lives += _rates(recordings, facts.settings)
    against = {live.code for live in lives if live.severity in ("fault", "warning")}
    lives += [_topic(topic, diagnosis, recordings, robot, facts) for topic in TOPICS if not against & {*TOPICS[topic]}]
    lives += _still(diagnosis, low)
    order = ("fault", "warning", "note", "good")
    return sorted(lives, key=lambda live: (order.index(live.severity), live.waits))


def as_live(finding: Finding) -> Remark:
    """A finding of `tauext check` in words for a live stream."""
    if finding.code in HARMLESS and finding.severity != "fault":
        return Remark(finding.code, "note", finding.joint, _words(finding), HARMLESS[finding.code])
    remedy = REMEDIES.get(finding.code) or re.sub(
        r",? at import( and in the monitor)?", " in the driver", finding.advice
    )
    return Remark(finding.code, finding.severity, finding.joint, _words(finding), remedy)


def _words(finding: Finding) -> str:
    return f"{codes()[finding.code]}: {finding.evidence}"


def _still(diagnosis: Diagnosis, low: Collection[str | None]) -> list[Remark]:
    """What cannot be judged yet of single joints."""
    if any(finding.code == "never-moves" for finding in diagnosis.findings):
        return []  # the topics contain this
    words = "it moves too little so far: its friction and weight cannot be judged"
    remedy = "let it move by at least 0.2 rad, both ways, slowly and fast"
    return [
        Remark("excitation-low", "note", joint, words, remedy, waits=True) for joint in diagnosis.joints if joint in low
    ]


NAMES = {
    "joints": "joints",
    "rate": "sample rate",
    "clock": "clock",
    "units": "position and velocity",
    "sign": "sign of the torque",
    "signal": "kind of the torque signal",
    "robot-file": "match with the robot file",
}


def _topic(
    topic: str, diagnosis: Diagnosis, recordings: Sequence[Recording], robot: Path | None, facts: SourceFacts
) -> Remark:
    """What is good about a topic, or that it must wait for motion."""
    moved_s = sum(_moved_s(recording) for recording in recordings)
    joints, settings, name = ", ".join(diagnosis.joints), facts.settings, NAMES[topic]
    judged = [fact for fact in diagnosis.facts if "gravity_factor" in fact]
    if topic == "joints":
        return _good(topic, f"{len(diagnosis.joints)} joints: {joints}")
    if topic == "rate":
        return _good(topic, f"{1e9 / settings.period_ns:g} samples a second")
    if topic == "clock":
        return _good(topic, "the time stamps are evenly spaced")
    if topic == "units" and any("velocity_factor" in fact for fact in diagnosis.facts):
        return _good(topic, f"{name}: the velocity is the derivative of the position")
    if topic == "sign" and diagnosis.fits:
        witness = "friction and inertia" if robot is None else "friction, inertia and gravity"
        low = {finding.joint for finding in diagnosis.findings if finding.code == "excitation-low"}
        of = f" of {', '.join(joint for joint in diagnosis.joints if joint not in low)}" if low else ""
        return _good(topic, f"{name}{of}: agrees with {witness} after {moved_s:.0f} s of motion")
    if topic == "signal" and diagnosis.fits:
        return _signal(judged, diagnosis, robot, facts)
    if topic == "robot-file" and robot is None:
        words = "no robot file: the order of joints, the direction of gravity and a payload cannot be checked"
        return Remark(
            topic, "note", None, words, "a robot file (--robot, and a new --out) makes the thresholds narrower"
        )
    if topic == "robot-file" and judged and moved_s >= SEARCH_S:
        return _good(topic, f"{robot.name if robot else ''} fits the measured torques")
    needs = f" (needs {SEARCH_S:g} s of motion, {moved_s:.0f} s so far)" if topic == "robot-file" else ""
    return _waiting(topic, f"{name}: cannot be judged until the arm moves{needs}", MOVE)


def _signal(
    judged: Sequence[Mapping[str, Any]], diagnosis: Diagnosis, robot: Path | None, facts: SourceFacts
) -> Remark:
    unit, name = facts.settings.torque_units[0], NAMES["signal"]
    if "A" in facts.settings.torque_units:
        return _good("signal", f"{name}: a motor current or duty; training finds the torque constants")
    factors = sorted(float(fact["gravity_factor"]) for fact in judged)
    inside = [factor for factor in factors if LOW <= factor <= HIGH]
    if robot is not None and inside:
        return _good("signal", f"{name}: a torque in {unit}, {inside[0]:.2f} to {inside[-1]:.2f} times the model's")
    if facts.signal == "unknown" and robot is not None:
        words = f"{name}: taken as a torque in N m; gravity has loaded the joints too little to confirm it"
        return _waiting("signal", words, MOVE)
    if facts.signal == "unknown":
        words = f"{name}: taken as a torque in N m, which only a robot file can confirm"
        return Remark("signal", "note", None, words, "--robot FILE; or make sure that the driver sends N m")
    return _good(
        "signal", f"{name}: {'a torque' if facts.signal == 'torque' else f'made of the {facts.signal}'} in {unit}"
    )


def _good(topic: str, words: str) -> Remark:
    return Remark(topic, "good", None, words, "")


def _waiting(topic: str, words: str, remedy: str) -> Remark:
    return Remark(topic, "note", None, words, remedy, waits=True)


def _moved_s(recording: Recording) -> float:
    return float((np.abs(recording.dq) > MOVING_RAD_S).any(axis=1).sum()) / recording.rate_hz


LOST_SHARE = 0.005
"""Share of lost samples from which it is a fault: the monitor restarts its observer at each longer gap."""


def _rates(recordings: Sequence[Recording], settings: SourceSettings) -> list[Remark]:
    """Another rate than the one described, and lost samples."""
    long = [recording for recording in recordings if recording.samples > 20]
    if not long:
        return []
    period_ns = float(np.median([fitted_period_ns(recording.t_ns) for recording in long]))
    if abs(period_ns / settings.period_ns - 1) > settings.rate_tolerance:
        words = f"{1e9 / period_ns:.4g} samples a second came, {1e9 / settings.period_ns:.4g} were described"
        return [Remark("wrong-rate", "fault", None, words, "set the driver's rate, or use another --out for this rate")]
    lost, came = sum(float(lost_samples(one.t_ns).sum()) for one in long), sum(one.samples for one in long)
    if lost <= LOST_SHARE * (lost + came):
        return []
    words = f"{lost / (lost + came):.1%} of the samples are lost on their way"
    return [Remark("clock-gaps", "warning", None, words, "use a cable instead of radio, or a less busy computer")]


# --- The first look at a source, before anything is recorded.


LOOK_S = 3.0
WAIT_S = 10.0


@dataclass(frozen=True)
class Connected:
    """How a source describes itself, and what its first samples show."""

    facts: SourceFacts
    lives: list[Remark]


def connect(
    make: Callable[[], Source],
    robot: Path | None = None,
    wait_s: float = WAIT_S,
    check: Callable[[SourceFacts], None] = lambda facts: None,
    remedy: str = "",
) -> Connected:
    """Describe a source, take samples for LOOK_S, judge them, and close it.

    Args:
        make: makes a source that is not open; the loop then opens another one.
        check: called with the description, before the first sample; may raise a TauextError.
        remedy: what a person can do if this computer takes samples too late.

    Raises:
        AwayError: the arm does not answer or sends nothing; the caller may try again.
        TauextError: the arm, the robot file and the options do not fit each other.
    """
    source = make()
    try:
        if not isinstance(source, Describes):
            raise ConfigError(f"{source.name} cannot describe itself")
        facts = source.describe(wait_s, robot)
        check(facts)
        source.open(facts.settings)
        samples, until = list[Sample](), time.monotonic() + wait_s
        period_s, watched = facts.settings.period_ns * 1e-9, MonitoredTime(3 * facts.settings.period_ns * 1e-9)
        while time.monotonic() < until and not source.ended:
            if (sample := source.next_sample(0.1)) is None:
                continue
            now_ns = time.monotonic_ns()
            watched.add(now_ns, now_ns - sample.received_ns <= LATE_S * 1e9)
            if not samples:
                until = min(until, time.monotonic() + LOOK_S)
            samples.append(sample)
            if sample.t_ns - samples[0].t_ns >= LOOK_S * 1e9:
                break
        if not samples:
            raise AwayError(
                f"{source.name}: no sample within {wait_s:g} s: {'; '.join(source.notes()) or 'it is silent'}"
            )
    finally:
        source.close()
    recording, lives = recording_of(samples, facts)
    notes = [Remark("assumed", "note", None, note, "") for note in facts.notes]
    lives += held_rate(watched.second(), 1 / period_s, remedy)
    return Connected(facts, [*lives, *judge([recording] if recording is not None else [], robot, facts), *notes])


HELD = "computer"
"""Code of the finding about this computer, which later checks of the recordings keep."""


def held_rate(watched: Monitored, rate_hz: float, remedy: str) -> list[Remark]:
    """Whether this computer took the first samples in time; nothing where too few came."""
    if watched.of_seconds < LOOK_S / 2:
        return []
    share = watched.seconds / watched.of_seconds
    if share >= PARTLY:
        return [_good(HELD, f"this computer holds the rate of {rate_hz:g} samples a second")]
    words = f"this computer took the samples in time for only {percent(share)} of the first {watched.of_seconds:.0f} s"
    return [Remark(HELD, "warning", None, f"{words}; touches in the rest are detected late or not at all", remedy)]


def recording_of(samples: Sequence[Sample], facts: SourceFacts) -> tuple[Recording | None, list[Remark]]:
    """Samples of a source as a recording, without those that are not usable, and what is missing in those.

    Returns: the recording, None without two usable samples in a row; what was left out, in words.
    """
    settings = facts.settings
    stage = ServoStage(settings.servo) if settings.servo is not None and settings.servo.on else None
    turns = Turns(settings)
    if not samples:
        return None, []
    made = turns.made(Block.of(samples))
    made = made if stage is None else stage.made(made)
    names = ["q", "dq", "tau", *(name for name in RAW_SIGNALS if getattr(made, name) is not None)]
    signals = {name: getattr(made, name) for name in names}
    first = 1 if stage is not None else 0  # a derived velocity begins with the second sample
    missing = [
        Remark(
            "not-measured", "fault", joint, f"its {what} is not a number in {share:.0%} of the samples", _measure(what)
        )
        for what, name in (("position", "q"), ("velocity", "dq"), ("torque", "tau"))
        if len(made) > first
        for joint, share in zip(settings.joints, np.mean(~np.isfinite(signals[name][first:]), axis=0), strict=True)
        if share > 0.05
    ]
    finite = np.all([np.isfinite(values).all(axis=1) for values in signals.values()], axis=0)
    rows, newest = [], None
    for row in np.flatnonzero(finite).tolist():
        if newest is None or made.t_ns[row] > newest:
            rows.append(row)
            newest = made.t_ns[row]
    late = 1 - len(rows) / max(1, int(finite.sum()))
    if late > 0.1:
        words = f"the time stamps stood still or went back in {late:.0%} of the samples"
        remedy = "let the driver stamp each sample with the time of its measurement, by a clock that nothing sets"
        missing.append(Remark("clock-irregular", "fault", None, words, remedy))
    if len(rows) < 2:
        return None, missing
    try:
        recording = Recording(
            name="live",
            joints=settings.joints,
            t_ns=made.t_ns[rows],
            rate_hz=1e9 / settings.period_ns,
            torque_timing=cast(TorqueTiming, settings.torque_timing),
            source="live",
            robot_sha256="",
            provenance=provenance_of(facts),
            **{name: values[rows] for name, values in signals.items()},
        )
    except TauextError:  # another rate by a fifth or more
        steps = np.diff(made.t_ns)
        came_hz = 1e9 / float(np.median(steps[steps > 0]))
        words = f"{came_hz:.4g} samples a second came, {1e9 / settings.period_ns:.4g} were described"
        return None, [*missing, Remark("wrong-rate", "fault", None, words, "set the driver's rate")]
    return recording, missing


def _measure(what: str) -> str:
    return f"let the driver send the {what} of this joint, or give a robot file without the joint"


# --- Facts: as JSON, as provenance of recordings, as an arm.toml, and what contradicts them later.


def as_data(facts: SourceFacts) -> dict[str, Any]:
    """The facts as plain JSON."""
    servo = facts.settings.servo
    settings = {key: value for key, value in vars(facts.settings).items() if key != "servo"}
    return {
        **settings,
        "servo": servo_facts(servo) if servo is not None and servo.on else None,
        "signal": facts.signal,
        "temperature": facts.temperature,
        "notes": list(facts.notes),
    }


def facts_of_data(data: Mapping[str, Any]) -> SourceFacts:
    """The facts from as_data(), also after JSON.

    Raises:
        ConfigError: something is missing, or of the wrong type.
    """
    try:
        settings = SourceSettings(
            tuple(map(str, data["joints"])),
            int(data["period_ns"]),
            tuple(map(str, data["torque_units"])),
            str(data["torque_timing"]),
            None if data["servo"] is None else servo_of(data["servo"]),
            float(data["rate_tolerance"]),
        )
        return SourceFacts(settings, data["signal"], bool(data["temperature"]), tuple(map(str, data["notes"])))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(f"the description of the arm is damaged ({type(error).__name__}: {error})") from error


def known_arm(folder: CommissionFolder) -> SourceFacts | None:
    """The arm that the folder describes; None: it is not described yet, or the description is damaged."""
    with suppress(ConfigError):
        return facts_of_data(folder.facts["arm"]) if "arm" in folder.facts else None
    return None


def provenance_of(facts: SourceFacts) -> dict[str, Any]:
    """Entries of a recording's provenance that training needs: unit of the torque, and servo settings."""
    servo = facts.settings.servo
    torque = AMPERES if "A" in facts.settings.torque_units else FROM_AMPERES
    made = {"torque": torque} if facts.signal in ("current", "duty", "goal") or torque == AMPERES else {}
    return made | ({"servo": servo_facts(servo)} if servo is not None and servo.on else {})


def another_arm(known: SourceFacts, now: SourceFacts) -> Remark | None:
    """The fault of a source that is not the arm of this folder; None: it is."""
    why = why_another(known, now)
    if not why:
        return None
    remedy = "restore it, or use another --out"
    return Remark("another-arm", "fault", None, f"the source does not match this folder: {why}", remedy)


def settled(facts: SourceFacts, lives: Collection[Remark]) -> SourceFacts:
    """The facts after motion has shown that an unknown effort is a current or has another unit: training then fits
    a constant for each joint. Recordings made before and after may be used together."""
    if facts.signal != "unknown" or not any(live.code == "effort-scale" for live in lives):
        return facts
    settings = replace(facts.settings, torque_units=("A",) * len(facts.settings.joints))
    return replace(facts, settings=settings, signal="current")


def write_arm(facts: SourceFacts, robot: Path | None, folder: Path) -> Arm:
    """Write arm.toml, and before it the robot file with its shapes, or a placeholder; an existing arm.toml stays.

    Raises:
        TauextError: the robot file is missing, cannot be read, or lacks a joint; the folder is as before.
    """
    path, joints = folder / "arm.toml", facts.settings.joints
    if path.exists():
        return load_arm(path)
    made = [one for name in ("robot.urdf", "robot.xml", SHAPES_FILE) if not (one := folder / name).exists()]
    try:
        if robot is None:
            write_placeholder(joints, folder)
        else:
            load_tree(robot, joints=joints)
            written = write_robot(robot, folder, {})
            load_tree(written, joints=joints)
            write_shapes(robot, folder)
        content = description(facts, "" if robot is None else written.name)
        arm = parse_arm(content, path)
    except BaseException:  # the next attempt may bring another robot file
        for one in made:
            one.unlink(missing_ok=True)
        raise
    with atomic_write(path) as part:
        part.write_text(content, encoding="utf-8")
    return arm


ARM_FILES = ("arm.toml", SHAPES_FILE, *ROBOT_FILES)
"""Files of write_arm(), which the journal of the folder keeps, too."""


def restore_arm(folder: CommissionFolder) -> None:
    """Write files of write_arm() again that are missing or damaged."""
    folder.restore(ARM_CHECKS)


ARM_CHECKS: dict[str, Callable[[Path], object]] = {
    "arm.toml": load_arm,
    SHAPES_FILE: read_json,
    **dict.fromkeys(ROBOT_FILES, read_xml),
}


def free_arm(folder: CommissionFolder) -> None:
    """Set aside what write_arm() would find damaged, where no journal has the files."""
    for name, check in ARM_CHECKS.items():
        if os.path.lexists(path := folder.path / name):
            try:
                check(path)
            except (OSError, TauextError) as error:
                folder.set_aside(path, str(error))
    if (folder.path / "arm.toml").exists() and not any((folder.path / name).exists() for name in ROBOT_FILES):
        folder.set_aside(folder.path / "arm.toml", "the robot file is missing")


def description(facts: SourceFacts, model: str) -> str:
    """Text of an arm.toml about the recordings of a live source, which hold every signal as its column."""
    settings, servo = facts.settings, facts.settings.servo
    lines = ["# Written by `tauext commission` from the description that the source gives of itself.", "", "[robot]"]
    lines += [f"model = {json.dumps(model)}", f"joints = {json.dumps(list(settings.joints))}", ""]
    lines += ["[time]", 'column = "t_ns"', 'unit = "ns"', f"rate_hz = {1e9 / settings.period_ns!r}"]
    made = servo is not None and servo.on and servo.torque_from.name != "torque"
    columns = ["q"] if servo is not None and made and servo.velocity_steps else ["q", "dq"]
    columns += RAW_SIGNALS if made else ["tau"]
    for name in columns:
        lines += ["", f"[signals.{name}]", f'columns = "{name}_{{joint}}"']
        if name == "tau":
            amperes = "A" in settings.torque_units
            lines += [f'unit = "{"A" if amperes else "Nm"}"', f'timing = "{settings.torque_timing}"']
            lines += ['torque_constant = "unknown"'] if amperes else []
    if made:
        lines += ["", *_servo_table(settings)]
    return "\n".join(lines) + "\n"


def _servo_table(settings: SourceSettings) -> list[str]:
    servo = settings.servo
    assert servo is not None
    unknown = "A" in settings.torque_units

    def each(name: str, scale: Callable[[float], float] = float) -> str:
        return json.dumps([scale(getattr(joint, name)) for joint in servo.joints])

    rate_hz = 1e9 / settings.period_ns
    types = [servo_type(joint) for joint in servo.joints]
    return [
        "[servo]",
        *([f"type = {json.dumps(types)}"] if all(types) else []),
        f'torque_from = "{servo.torque_from.name.replace("_", "-")}"',
        f'timing = "{settings.torque_timing}"',
        f"voltage_v = {each('volts')}",
        f"ohm = {each('ohm')}",
        f"back_emf_v_s = {each('back_emf_v_s')}",
        f"most_duty = {each('most_duty')}",
        *([f"duty_per_rad = {each('duty_per_rad')}"] if all(joint.duty_per_rad > 0 for joint in servo.joints) else []),
        f"counts_a_turn = {each('count_rad', lambda step: 2 * np.pi / step)}",
        f"torque_constant = {json.dumps('unknown') if unknown else each('nm_per_ampere')}",
        f"velocity_window_s = {servo.velocity_steps / rate_hz!r}",
        f"goal_delay_s = {servo.goal_delay_ns * 1e-9!r}",
    ]


def servo_type(joint: ServoConstants) -> str:
    """Name in SERVO_TYPES of a servo with these constants; empty: there is none."""
    constants = (joint.volts, joint.ohm, joint.back_emf_v_s)
    fits = (name for name, one in SERVO_TYPES.items() if (one.volts, one.ohm, one.back_emf_v_s) == constants)
    return next(fits, "")


def sentence_of(live: Remark) -> str:
    """One line for the terminal."""
    joint, remedy = f"{live.joint}: " if live.joint else "", f"; {live.remedy}" if live.remedy else ""
    return f"{live.severity}: {joint}{live.words}{remedy}"


def as_entries(lives: Iterable[Remark]) -> list[dict[str, Any]]:
    """Entries of findings.json."""
    return [asdict(live) for live in lives]


def load_known(folder: CommissionFolder, segments: Sequence[Segment]) -> list[Recording]:
    """Load recordings with their labels, and with the settled unit and timing of the torque."""
    recordings, arm = folder.load(segments), folder.facts.get("arm")
    known = {} if arm is None else provenance_of(facts_of_data(arm))
    return [replace(one, provenance=one.provenance | known) for one in recordings] if known else recordings
