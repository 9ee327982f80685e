"""Convert raw signals and a description of the arm to recordings; their provenance lists every conversion."""

from __future__ import annotations

import difflib
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from tauext.data.clock import RowRules, Table, expect_clock
from tauext.data.description import NORMALISED, SIGNALS, Arm, SignalTable
from tauext.data.importers.raw import RawRecording, short_list
from tauext.data.mixed_rows import MixedRules, alternating, joined
from tauext.data.raw_rows import Columns, Piece, RowReader
from tauext.data.recording import (
    BRIDGE_STEPS,
    RATE_TOLERANCE,
    REPEATED,
    REQUIRED_SIGNALS,
    TURN,
    Recording,
    fitted_period_ns,
    fresh,
    lost_samples,
    ordered,
    unwrapped,
)
from tauext.data.servo import AMPERES, FROM_AMPERES, TORQUE_WORDS, servo_facts, servo_settings, velocity_and_torque
from tauext.data.unmeasured import UNMEASURED, unmeasured
from tauext.errors import ConfigError, RecordingError

# --- Columns of a raw recording that each signal uses, joint by joint.


def find_columns(arm: Arm, raw: RawRecording) -> Columns:
    """Resolve every column that the description names; joints keep its order, by name where the file names them.

    A signal's name may be a column pattern with {joint} (name in the recording), {index} (from 0) or {number} (from 1).
    It may also be an array; elements are used by joint name, or by index if their number is that of the joints.

    Raises:
        ConfigError: a column or topic is missing; the message lists similar names.
    """
    there = raw.streams
    wanted: dict[str, dict[str, None]] = {}
    found: dict[str, tuple[str, tuple[str, ...]]] = {}
    for name, signal in arm.signals.items():
        if signal.columns:
            stream = _stream(arm, raw, there, signal.topic, f"signals.{name}")
            found[name] = (stream, _resolved(arm, raw, f"signals.{name}", signal.columns, there[stream]))
    if arm.contact.column:
        stream = _stream(arm, raw, there, arm.contact.topic, "contact")
        found["contact"] = (stream, _exact(arm, raw, "contact", (arm.contact.column,), there[stream]))
    if arm.time.column and arm.time.column not in raw.clocks:
        for stream in dict.fromkeys(stream for stream, _ in found.values()):
            found["time"] = (stream, _exact(arm, raw, "time", (arm.time.column,), there[stream]))
    for stream, names in found.values():
        wanted.setdefault(stream, {}).update(dict.fromkeys(names))
    streams = {stream: tuple(names) for stream, names in wanted.items()}
    indices = {name: (stream, [streams[stream].index(n) for n in names]) for name, (stream, names) in found.items()}
    return Columns(streams, indices)


def logged_joints(arm: Arm, raw: RawRecording) -> tuple[str, ...]:
    """Joints that a raw recording names in the columns of position and torque; those that it numbers, if more are there
    than in use, by column; empty where columns are listed one by one.
    """
    there = raw.streams
    named: list[dict[str, None]] = []
    for key in ("q", "tau"):
        signal = arm.signals[key]
        if len(signal.columns) != 1:
            continue
        (pattern,) = signal.columns
        names = there[_stream(arm, raw, there, signal.topic, f"signals.{key}")]
        keys = [key for key in ("joint", "index", "number") if f"{{{key}}}" in pattern]
        if keys == ["joint"]:
            before, after = (re.escape(part) for part in pattern.split("{joint}", 1))
            matches = {name: re.fullmatch(f"{before}(.+){after}", name) for name in names}
            named.append(dict.fromkeys(match[1] for match in matches.values() if match))
        elif keys:
            return ()
        else:
            elements = [n.removeprefix(f"{pattern}[")[:-1] for n in names if n.startswith(f"{pattern}[")]
            if all(element.isdigit() for element in elements):
                return ()
            named.append(dict.fromkeys(elements))
    return tuple(name for name in named[0] if all(name in other for other in named[1:])) if named else ()


def _stream(arm: Arm, raw: RawRecording, there: Mapping[str, Sequence[str]], topic: str, table: str) -> str:
    if topic in there:
        return topic
    if topic:
        raise ConfigError(f"{arm.path}: [{table}] topic = '{topic}' has no messages in {raw.path.name}")
    if not there:
        raise ConfigError(f"{raw.path.name}: it has no messages to read [{table}] from")
    if len(there) > 1:
        listed = ", ".join(sorted(there))
        raise ConfigError(f"{arm.path}: [{table}] topic must be named, since {raw.path.name} has several: {listed}")
    return next(iter(there))


def _resolved(
    arm: Arm, raw: RawRecording, table: str, columns: tuple[str, ...], there: Sequence[str]
) -> tuple[str, ...]:
    one = columns[0]
    if len(columns) == 1 and re.search(r"\{(joint|index|number)\}", one):
        columns = tuple(
            one.replace("{joint}", name).replace("{index}", str(k)).replace("{number}", str(k + 1))
            for k, name in enumerate(arm.names)
        )
        return _exact(arm, raw, table, columns, there)
    elements = [name for name in there if name.startswith(f"{one}[")]
    if len(columns) == 1 != len(arm.names) and not elements:
        raise _missing(arm, raw, table, one, there)
    if len(columns) > 1 or not elements:
        return _exact(arm, raw, table, columns, there)
    by_name, by_index = (tuple(f"{one}[{label}]" for label in labels) for labels in (arm.names, range(len(arm.names))))
    if all(name in elements for name in by_name):
        return by_name
    if set(elements) == set(by_index):
        return by_index
    listed = short_list([name.removeprefix(f"{one}[").removesuffix("]") for name in elements], 16)
    raise ConfigError(
        f"{arm.path}: [{table}] columns = '{one}': in {raw.path.name} its elements are {listed}; [robot] names (or "
        f'joints) are {", ".join(arm.names)}: name them as the recording does, or by "{one}'
        f'[{{index}}]"{"".join(f"; {note}" for note in raw.notes)}'
    )


def _exact(arm: Arm, raw: RawRecording, table: str, names: tuple[str, ...], there: Sequence[str]) -> tuple[str, ...]:
    for name in names:
        if name not in there:
            raise _missing(arm, raw, table, name, there)
    return names


def _missing(arm: Arm, raw: RawRecording, table: str, name: str, there: Sequence[str]) -> ConfigError:
    bases = list(dict.fromkeys(column.split("[")[0] for column in there))
    near = difflib.get_close_matches(name, dict.fromkeys([*there, *bases]), 3, 0.3)
    hint = f"similar: {', '.join(near)}; " if near else ""
    left_out = "".join(f"; {note}" for note in raw.notes)  # arrays of another length are missing
    derive = '; columns = "" derives the velocity from the position' if table == "signals.dq" else ""
    held = f"it has {short_list(bases, 20)}{left_out}{derive}"
    return ConfigError(f"{arm.path}: [{table}] '{name}' is not in {raw.path.name}; {hint}{held}")


# --- Conversion from the recording's units to rad, rad/s and N m at the joint, and its description.


def in_si(key: str, signal: SignalTable, values: np.ndarray, arm: Arm) -> np.ndarray:
    """Convert to SI at the joint: sign · unit · (torque constant) · gear, plus a position's offset (rad if
    normalised)."""
    if signal.unit == NORMALISED:
        values = arm.radians_of_normalised(values, key == "q_des")
    factor = np.full(len(arm.robot.joints), SIGNALS[key].units[signal.unit])
    if signal.torque_constant and signal.torque_constant != "unknown":
        factor *= signal.torque_constant
    if signal.side == "motor":
        gear = np.array(arm.gear_ratio)
        factor = factor * gear if key == "tau" else factor / gear
    if signal.sign:
        factor = factor * signal.sign
    converted = values * factor
    return converted + np.array(signal.offset) * SIGNALS[key].units[signal.unit] if signal.offset else converted


def conversions(arm: Arm) -> list[str]:
    """Sentences that list the conversions of in_si()."""
    lines = []
    for key, signal in arm.signals.items():
        is_current = signal.is_current and key == "tau"
        plain = SIGNALS[key].units[signal.unit] == 1 and signal.unit != NORMALISED and not is_current
        done = [] if plain else [f"from {signal.unit}"]
        if is_current:
            known = signal.torque_constant != "unknown"
            done.append(f"times {', '.join(f'{k:g}' for k in signal.torque_constant)} Nm/A" if known else "left in A")
        if signal.side == "motor":
            done.append(f"{'times' if key == 'tau' else 'divided by'} gear ratio")
        if any(s < 0 for s in signal.sign):
            all_of_them = all(s < 0 for s in signal.sign)
            names = [joint for joint, s in zip(arm.robot.joints, signal.sign, strict=True) if s < 0]
            done.append("sign turned" + ("" if all_of_them else f" of {', '.join(names)}"))
        if any(signal.offset):
            done.append(f"offset {', '.join(f'{o:g}' for o in signal.offset)} {signal.unit} added")
        if done:
            lines.append(f"{key}: {', '.join(done)}")
    return lines


def constant_unknown(arm: Arm) -> bool:
    """Whether the torque stays in amperes, since the motor's constant is unknown."""
    return arm.signals["tau"].torque_constant == "unknown"


# --- Signals of several clocks, merged onto the stamps of one.


def base_stream(tables: Mapping[str, Table], torque: str, essential: Sequence[str]) -> str:
    """The stream to whose stamps all others are interpolated: the torque's, or a slower essential one.

    Interpolating a slow signal onto fast stamps would invent samples. Slower means a sample period over 1.5 times as
    long.
    """
    steps = {name: fitted_period_ns(tables[name][0]) if len(tables[name][0]) > 1 else 0.0 for name in essential}
    slowest = max(essential, key=lambda name: steps[name])
    return slowest if steps[slowest] > 1.5 * steps[torque] else torque


def interpolated(t_ns: np.ndarray, table: Table, counts: Counter[str], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate values (samples, columns) of another clock linearly at these times; also returns where they are
    known.

    Values are unknown (false) before the first and after the last sample, and in steps of more than 2.5 sample periods.
    """
    times, values = table
    if len(times) < 2:
        return np.repeat(values[:1], len(t_ns), axis=0), np.isin(t_ns, times)
    after = np.clip(np.searchsorted(times, t_ns), 1, len(times) - 1)
    left, right = times[after - 1], times[after]
    share = ((t_ns - left) / (right - left))[:, None]
    mixed = values[after - 1] * (1 - share) + values[after] * share
    inside = (t_ns >= times[0]) & (t_ns <= times[-1])
    near = (right - left <= BRIDGE_STEPS * fitted_period_ns(times)) | (t_ns == left) | (t_ns == right)
    counts[f"samples dropped: no {name} within its time range, or in a gap of it"] += int((~(inside & near)).sum())
    return mixed, inside & near


def held(t_ns: np.ndarray, table: Table, unknown: float) -> np.ndarray:
    """Last values (samples, columns) of another clock at or before these times; `unknown` before its first."""
    times, values = table
    before = np.searchsorted(times, t_ns, side="right") - 1
    return np.where((before >= 0)[:, None], values[np.maximum(before, 0)], unknown)


# --- Causal velocity from position, as in a control loop.


def derived_velocity(t_ns: np.ndarray, q: np.ndarray, low_pass_hz: float) -> np.ndarray:
    r"""Backward difference behind a first-order low-pass, (samples, joints), [rad/s].

    .. math:: dq_k = a\,dq_{k-1} + (1-a)\,(q_k - q_{k-1})/\Delta t, \quad a = e^{-2\pi f \Delta t}

    It lags the true velocity by half a step plus 1/(2 pi f). It uses no future samples, so a monitor that derives it
    the same way gets the same values. A step of more than 2.5 median steps restarts the filter; a first sample uses the
    next difference.

    Args:
        t_ns: (samples,), increasing, [ns].
        q: (samples, joints), [rad].
        low_pass_hz: cut-off f, [Hz]; 0: no low-pass.
    """
    velocity = np.zeros_like(q)
    if len(q) < 2:
        return velocity
    steps_s = np.diff(t_ns) * 1e-9
    velocity[1:] = np.diff(q, axis=0) / steps_s[:, None]
    begins = np.r_[True, steps_s > BRIDGE_STEPS * np.median(steps_s)]
    followed = np.flatnonzero(begins[:-1] & ~begins[1:])
    velocity[begins] = 0.0
    velocity[followed] = velocity[followed + 1]
    if low_pass_hz:
        keep = np.r_[0.0, np.exp(-2 * math.pi * low_pass_hz * steps_s)]
        keep[begins] = 0.0
        for k in range(1, len(q)):
            velocity[k] += keep[k] * (velocity[k - 1] - velocity[k])
    return velocity


# --- Raw signals and a robot description to recordings; provenance lists every change of the numbers.


def assemble(
    raw: RawRecording, arm: Arm, robot_sha256: str = "", rate_hz: float = 0.0, rules: RowRules = RowRules()
) -> Iterator[Recording]:
    """Convert a raw recording to recordings in order of time.

    A clock that begins again begins another recording, and a long recording gives several (RowRules). Each is sorted,
    merged onto one clock and converted to rad, rad/s and N m at the joint. Its provenance lists the changes (`done`:
    sentences; `counts`: numbers), and `start_s`, the time from the first sample of the file; runs whose clock begins
    again follow each other without a pause.

    Args:
        rate_hz: nominal rate of other recordings, where the stamps agree with it; else the description's or that of the
            fitted sample period.

    Raises:
        ConfigError: a column that the description names is missing.
        RecordingError: the file is damaged, its clocks cannot be used, too many rows are left out, or its content makes
            no valid recording.
    """
    columns = find_columns(arm, raw)
    reader = RowReader(raw, arm, columns, rules)
    rate_hz = rate_hz or arm.time.rate_hz
    start_ns: int | None = None
    number, run, end_ns = 0, 0, 0
    turns = _Turns(arm, columns)
    try:
        for piece in _stretches(raw, arm, columns, reader.pieces()):
            counts = Counter(raw.counts)
            raw.counts.clear()
            if start_ns is not None and piece.run > run and piece.begin_ns <= end_ns:
                start_ns += piece.begin_ns - end_ns - round(1e9 / rate_hz)
            if piece.run > run or piece.joined:
                run, turns = piece.run, _Turns(arm, columns)
            recording = _piece(raw, arm, columns, piece.tables, counts, start_ns, rate_hz, reader.remedy, turns)
            if start_ns is None:
                start_ns = int(recording.t_ns[0])
                reader.expect_rates(recording.t_ns)
            name = raw.name if piece.last and not number and not piece.joined else f"{raw.name}-{number:02d}"
            yield reader.with_losses(replace(recording, name=name, robot_sha256=robot_sha256), counts)
            end_ns, rate_hz = int(recording.t_ns[-1]), recording.rate_hz
            number += 1
        reader.expect_enough()
    except RecordingError as error:
        raise RecordingError(f"{raw.path}: {str(error).removeprefix(f'{raw.path}: ')}") from error
    if not number:
        raise RecordingError(f"{raw.path}: it has no samples")


def _stretches(raw: RawRecording, arm: Arm, columns: Columns, pieces: Iterable[Piece]) -> Iterator[Piece]:
    """The pieces; one of stretches that were joined becomes a piece a stretch."""
    for piece in pieces:
        found = None
        if len(piece.tables) == 1 and arm.signals["q"].unit != NORMALISED:
            ((stream, (t_ns, values)),) = piece.tables.items()
            period = fitted_period_ns(t_ns) if len(t_ns) > 2 and (np.diff(t_ns) > 0).all() else 0.0
            if period > 0:
                found = joined(_radians(arm, columns, values), np.round((t_ns - t_ns[0]) / period).astype(np.int64))
        if found is None:
            yield piece
            continue
        lengths = np.diff([0, *found.begins, len(t_ns)])
        of = f"{found.rows}" if found.rows else f"{lengths.min()} to {lengths.max()}"
        stretches = f"stretches of {of} rows"
        raw.notes.append(
            f"{stretches} were joined: positions jump at {found.jumps} of their ends, by up to "
            f"{found.largest_rad:.2g} rad; each stretch is a recording"
        )
        ends = [0, *found.begins.tolist(), len(t_ns)]
        parts = [(a, b) for a, b in pairwise(ends) if b - a >= MixedRules().least_rows]
        for a, b in parts:
            last = piece.last and b == parts[-1][1]
            yield Piece({stream: (t_ns[a:b], values[a:b])}, piece.run, last, joined=True)


def _radians(arm: Arm, columns: Columns, values: np.ndarray) -> np.ndarray:
    """Positions in a table's values, (samples, joints), [rad] at the joint or the motor."""
    return values[:, columns.signals["q"][1]] * SIGNALS["q"].units[arm.signals["q"].unit]


def _piece(
    raw: RawRecording,
    arm: Arm,
    columns: Columns,
    tables: dict[str, Table],
    counts: Counter[str],
    start_ns: int | None,
    rate_hz: float,
    remedy: str,
    turns: _Turns,
) -> Recording:
    """Make one recording; rate 0 means that of the fitted period.

    Args:
        remedy: what to do where stamps are no clock.
        turns: of the run; takes out the jumps of whole turns.
    """
    facts: dict[str, Any] = {}
    tables = {stream: _cleaned(stream, table, arm, columns, counts, remedy) for stream, table in tables.items()}
    tables = {stream: turns.taken_out(stream, table) for stream, table in tables.items()}
    t_ns, taken = _merged(tables, columns, counts, facts)
    if not len(t_ns):
        raise RecordingError(f"no sample is left of {sum(len(t) for t, _ in tables.values())}; {_sentences(counts)}")
    signals = {key: in_si(key, arm.signals[key], values, arm) for key, values in taken.items() if key != "contact"}
    if turns.joints and "q_des" in signals:
        signals["q_des"] += TURN * np.round((signals["q"] - signals["q_des"]) / TURN)
    own = np.ones(len(t_ns), bool)
    if arm.servo is None:  # servos count so coarsely that equal rows need not be repeats
        own = fresh(t_ns, np.hstack([signals["q"], signals["tau"]]), True, Counter())
    if not own.all():
        # samples lost in gaps are reported separately
        facts["measured_hz"] = round(_nominal_rate(t_ns) * float(own.mean()), 3)
    start_ns = int(t_ns[0]) if start_ns is None else start_ns
    facts["rate"] = "stated" if rate_hz else "fitted"
    if rate_hz and not arm.time.rate_hz and abs(_nominal_rate(t_ns) / rate_hz - 1) > RATE_TOLERANCE / 2:
        rate_hz = 0.0  # of the recordings before this one
    rate_hz = rate_hz or _nominal_rate(t_ns)
    if arm.servo is not None:
        _make_torque(arm, t_ns, rate_hz, signals, facts)
    elif "dq" not in signals:
        _derive_velocity(arm, t_ns, own, signals, facts)
    _count_losses(t_ns, counts, facts)
    facts["start_s"] = round((int(t_ns[0]) - start_ns) * 1e-9, 9)
    measured = FROM_AMPERES if arm.signals["tau"].is_current else "N m"
    facts["torque"] = AMPERES if constant_unknown(arm) else measured
    if turns.joints:
        facts["unwrapped"] = list(turns.joints)
    counts = Counter({text: n for text, n in counts.items() if n})
    done = _done(raw, arm, counts, facts, _nominal_rate(t_ns))
    provenance = {"command": "tauext import", "file": raw.path.name, "format": raw.format} | facts
    return Recording(
        name=raw.name,
        joints=arm.robot.joints,
        t_ns=t_ns,
        rate_hz=rate_hz,
        torque_timing=arm.signals["tau"].timing,
        source=f"{raw.path.name} ({raw.format})",
        robot_sha256="",
        contact=_contact(arm, raw, t_ns, start_ns, taken.get("contact")),
        provenance=provenance | {"done": done, "counts": dict(counts)},
        **signals,
    )


def _derive_velocity(
    arm: Arm, t_ns: np.ndarray, own: np.ndarray, signals: dict[str, np.ndarray], facts: dict[str, Any]
) -> None:
    """Differencing held positions would give 0, then twice the speed; a held one keeps its measurement's speed."""
    low_pass = arm.signals["dq"].low_pass_hz
    signals["dq"] = derived_velocity(t_ns[own], signals["q"][own], low_pass)[np.cumsum(own) - 1]
    facts["velocity"] = f"derived from the position, low-pass {low_pass:g} Hz" if low_pass else "derived, no low-pass"


def _count_losses(t_ns: np.ndarray, counts: Counter[str], facts: dict[str, Any]) -> None:
    lost = lost_samples(t_ns)
    counts["gaps: steps of two sample periods or more"] += int((lost > 0).sum())
    facts["longest_step_s"] = round(float(np.diff(t_ns).max(initial=0)) * 1e-9, 6)
    facts["lost_share"] = round(float(lost.sum() / (lost.sum() + len(t_ns))), 6)


def _done(
    raw: RawRecording, arm: Arm, counts: Mapping[str, int], facts: dict[str, Any], nominal_hz: float
) -> list[str]:
    """What was changed on the way to a recording, a sentence each."""
    done = [*raw.notes, *(f"{n} {text}" for text, n in counts.items()), *conversions(arm)]
    if "measured_hz" in facts:
        done.append(f"{facts['measured_hz']:.4g} samples a second are new measurements, the others repeat them")
    if facts["lost_share"] >= 1e-3:
        done.append(f"{facts['lost_share']:.1%} of the samples at {nominal_hz:.4g} Hz are missing: gaps")
    if "unwrapped" in facts:
        done.append(f"position unwrapped: it jumped by whole turns ({', '.join(facts['unwrapped'])})")
    if "velocity" in facts:
        done.append(f"velocity {facts['velocity']}")
    return done + [facts[key] for key in ("made", "merged") if key in facts]


def _make_torque(
    arm: Arm, t_ns: np.ndarray, rate_hz: float, signals: dict[str, np.ndarray], facts: dict[str, Any]
) -> None:
    """Compute velocity and torque of servos."""
    settings = servo_settings(arm, rate_hz, signals["q"])
    signals["dq"], signals["tau"] = velocity_and_torque(settings, t_ns, signals["q"], signals)
    facts["servo"] = servo_facts(settings)
    assert arm.servo is not None
    if settings.velocity_steps:
        facts["velocity"] = f"derived from the position, over {settings.velocity_steps} samples at most"
    if arm.makes_torque:
        facts["made"] = f"torque made of the {TORQUE_WORDS[arm.servo.torque_from]}"


class _Turns:
    """Takes jumps of whole turns out of the positions of one run, piece by piece, before streams are merged."""

    def __init__(self, arm: Arm, columns: Columns):
        self._joints = arm.robot.joints
        self._columns = {
            key: (*columns.signals[key], TURN / SIGNALS[key].units[arm.signals[key].unit])
            for key in ("q", "q_des")
            if key in columns.signals and arm.signals[key].unit != NORMALISED
        }
        self._before: dict[str, np.ndarray] = {}
        self.joints: tuple[str, ...] = ()
        """Joints whose position jumped, so far."""

    def taken_out(self, stream: str, table: Table) -> Table:
        """The rows with continuous positions."""
        t_ns, values = table
        for key, (at, indices, turn) in self._columns.items():
            if at != stream or not len(values):
                continue
            before = self._before.get(key, values[:1, indices])
            q, counts = unwrapped(np.vstack([before, values[:, indices]]) * (TURN / turn))
            jumped = np.flatnonzero(counts)
            if len(jumped):
                values = values.copy()
                values[:, [indices[j] for j in jumped]] = q[1:, jumped] * (turn / TURN)
                if key == "q":
                    found = {*self.joints, *(self._joints[j] for j in jumped)}
                    self.joints = tuple(joint for joint in self._joints if joint in found)
            self._before[key] = values[-1:, indices]
        return t_ns, values


def _cleaned(stream: str, table: Table, arm: Arm, columns: Columns, counts: Counter[str], remedy: str) -> Table:
    """Sort the rows, refuse stamps that are no clock, and keep or drop repeated measurements."""
    before = counts[REPEATED]
    if "q" in columns.signals and columns.signals["q"][0] == stream and arm.signals["q"].unit != NORMALISED:
        if mixed := alternating(_radians(arm, columns, table[1])):
            raise RecordingError(f"{mixed}; keep the rows of the arm's own writer, and record its topic alone")
    t_ns, values = ordered(*table, counts)
    expect_clock(table[0], counts[REPEATED] - before, remedy)
    signals = [columns.signals[key] for key in REQUIRED_SIGNALS if key in columns.signals]
    measured = [k for at, indices in signals if at == stream for k in indices]
    if measured and len(t_ns):
        here = {key: columns.signals[key] for key in ("q", "tau") if key in columns.signals}
        own = {key: indices for key, (at, indices) in here.items() if at == stream}
        unit = arm.signals["q"].unit
        bad = unmeasured(
            t_ns,
            values[:, own.get("q", [])],
            values[:, own.get("tau", []) if arm.servo is None else []],
            None if unit == NORMALISED else TURN / SIGNALS["q"].units[unit],
        )
        counts[UNMEASURED] += int(bad.sum())
        t_ns, values = t_ns[~bad], values[~bad]
        keep = fresh(t_ns, values[:, measured], arm.time.repeats == "drop", counts)
        t_ns, values = t_ns[keep], values[keep]
    return t_ns, values


def _merged(
    tables: dict[str, Table], columns: Columns, counts: Counter[str], facts: dict[str, Any]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Merge every signal onto the stamps of one stream, (samples, joints) each."""
    signals = {key: at for key, at in columns.signals.items() if key != "time"}
    essential = list(dict.fromkeys(signals[key][0] for key in REQUIRED_SIGNALS if key in signals))
    leading = signals["tau" if "tau" in signals else "q"][0]
    base = base_stream(tables, leading, essential)
    t_ns = tables[base][0]
    known = np.ones(len(t_ns), bool)
    values = {}
    for key, (stream, indices) in signals.items():
        here = (tables[stream][0], tables[stream][1][:, indices])
        if stream == base:
            values[key] = here[1]
        elif key == "contact":
            values[key] = held(t_ns, here, np.nan)
        elif key == "temperature":
            values[key] = held(t_ns, here, float(here[1][0, 0]))
        else:
            values[key], there = interpolated(t_ns, here, counts, f"{key} ({stream})")
            known &= there
    others = [stream for stream in tables if stream != base]
    if others:
        why = "the torque's" if base == leading else "the slowest"
        facts["merged"] = f"{', '.join(others)} brought to the stamps of {base} ({why}), linear in between"
    return t_ns[known], {key: value[known] for key, value in values.items()}


def _nominal_rate(t_ns: np.ndarray) -> float:
    """Rate of the fitted period, rounded to a whole number of Hz within 1 %."""
    if len(t_ns) < 2:
        raise RecordingError("a single sample has no rate: give it in arm.toml ([time] rate_hz)")
    rate_hz = 1e9 / fitted_period_ns(t_ns)
    return float(round(rate_hz)) if abs(round(rate_hz) / rate_hz - 1) < 0.01 else rate_hz


def _contact(
    arm: Arm, raw: RawRecording, t_ns: np.ndarray, start_ns: int, label: np.ndarray | None
) -> np.ndarray | None:
    """Contact flags 1, 0 or -1 from the label's values; given intervals are 1, and without a label the rest is 0."""
    spans = arm.contact.intervals.get(raw.path.name, arm.contact.intervals.get(raw.name))
    if label is None and spans is None:
        return None
    contact = np.zeros(len(t_ns), np.int8)
    if label is not None:
        contact[:] = -1
        contact[np.isin(label[:, 0], arm.contact.free_values)] = 0
        contact[np.isin(label[:, 0], arm.contact.contact_values)] = 1
    time_s = (t_ns - start_ns) * 1e-9
    for begin, end in spans or ():
        contact[(time_s >= begin) & (time_s <= end)] = 1
    return contact


def _sentences(counts: Counter[str]) -> str:
    return "; ".join(f"{n} {text}" for text, n in counts.items() if n)
