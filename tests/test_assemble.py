"""Raw signals and a description to a recording: what is converted, merged, dropped and kept, and that it says so."""

from __future__ import annotations

import dataclasses
import json
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from made_recordings import JOINTS, joint_rows, motion, write_bag

from tauext.data import description
from tauext.data.assemble import assemble, derived_velocity, interpolated
from tauext.data.clock import RowRules
from tauext.data.description import parse_arm
from tauext.data.description_template import Guess, guess, guess_values, template
from tauext.data.importers.open_raw import open_raw
from tauext.data.importers.raw import RawRecording, RawSignals
from tauext.data.recording import fitted_period_ns, fresh, lost_samples, ordered
from tauext.data.servo import from_amperes, in_amperes
from tauext.data.unmeasured import UNMEASURED
from tauext.errors import ConfigError, RecordingError

ARM = """
[robot]
joints = ["a", "b"]
gear_ratio = [100, -50]
{robot}
[time]
{time}
[signals.q]
columns = "q"
{q}
[signals.dq]
columns = "dq"
{dq}
[signals.tau]
columns = "tau"
{tau}
{rest}
"""


def arm(robot="", time="", q="", dq="", tau="", rest=""):
    return parse_arm(ARM.format(robot=robot, time=time, q=q, dq=dq, tau=tau, rest=rest))


def a_source(t_ns, *, block: int = 100, **arrays) -> RawRecording:
    """Arrays (samples, joints) or (samples,) as the blocks of a source."""
    columns = {}
    for name, values in arrays.items():
        values = np.asarray(values, float)
        columns |= {name: values} if values.ndim == 1 else {f"{name}[{k}]": v for k, v in enumerate(values.T)}

    def blocks():
        for first in range(0, len(t_ns), block):
            rows = slice(first, first + block)
            yield RawSignals("", tuple(columns), t_ns[rows], np.column_stack(list(columns.values()))[rows])

    return RawRecording("run", Path("run.csv"), "test", blocks)


def one(source, description):
    (recording,) = assemble(source, description)
    return recording


def test_si_units_pass_unchanged():
    t_ns, q, dq, tau = motion(joints=2)
    recording = one(a_source(t_ns, q=q, dq=dq, tau=tau), arm())
    for name, values in (("t_ns", t_ns), ("q", q), ("dq", dq), ("tau", tau)):
        np.testing.assert_array_equal(getattr(recording, name), values)
    assert recording.rate_hz == 100 and recording.provenance["done"] == []


def test_units_signs_sides_and_offsets_are_applied_and_reported():
    t_ns, q, dq, tau = motion(joints=2)
    gear, sign, offset_deg = np.array([100, -50]), np.array([1, -1]), np.array([0, 90])
    raw_q = np.rad2deg(q) - offset_deg  # motor encoder in degrees, joint 2 counted the other way
    source = a_source(t_ns, q=raw_q * gear * sign, dq=dq * 30 / np.pi, tau=tau / gear / 0.05 * 1e3)
    described = arm(
        q='unit = "deg"\nside = "motor"\nsign = [1, -1]\noffset = [0, 90]',
        dq='unit = "rpm"',
        tau='unit = "mA"\nside = "motor"\ntorque_constant = 0.05',
    )
    recording = one(source, described)
    for name, values in (("q", q), ("dq", dq), ("tau", tau)):
        np.testing.assert_allclose(getattr(recording, name), values, rtol=1e-12, atol=1e-12)
    assert recording.provenance["done"] == [
        "q: from deg, divided by gear ratio, sign turned of b, offset 0, 90 deg added",
        "dq: from rpm",
        "tau: from mA, times 0.05, 0.05 Nm/A, times gear ratio",
    ]
    assert from_amperes([recording]) and not in_amperes([recording])
    assert not from_amperes([one(a_source(t_ns, q=q, dq=dq, tau=tau), arm())])


def test_an_unknown_torque_constant_leaves_amperes_and_says_so():
    t_ns, q, dq, tau = motion(joints=2)
    recording = one(a_source(t_ns, q=q, dq=dq, tau=tau), arm(tau='unit = "A"\ntorque_constant = "unknown"'))
    np.testing.assert_array_equal(recording.tau, tau)
    assert recording.provenance["torque"] == "amperes: the torque constant is unknown"


def test_late_packets_repeats_and_gaps_are_handled_and_counted():
    t_ns, q, dq, tau = motion(600, joints=2)
    rows = list(range(600))
    rows[50], rows[51] = 51, 50  # out of order
    rows.insert(200, 199)  # the same packet twice
    rows = [k for k in rows if not 300 <= k < 310]  # a gap
    again = [k - 1 if k in (400, 420) else k for k in rows]  # stale values under a new stamp
    source = a_source(t_ns[rows], q=q[again], dq=dq[again], tau=tau[again])
    recording = one(source, arm(time='repeats = "drop"'))
    kept = [k for k in range(600) if not 300 <= k < 310 and k not in (400, 420)]
    np.testing.assert_array_equal(recording.t_ns, t_ns[kept])
    np.testing.assert_array_equal(recording.tau, tau[kept])
    assert recording.provenance["counts"] == {
        "samples out of order, sorted by their stamps": 1,
        "samples dropped: stamp and values repeat the sample before": 1,
        "repeated samples dropped: all values equal the sample before": 2,
        "gaps: steps of two sample periods or more": 3,
    }
    assert recording.provenance["longest_step_s"] == pytest.approx(0.11)
    kept_all = one(source, arm())
    assert kept_all.samples == 590 and kept_all.provenance["counts"]["gaps: steps of two sample periods or more"] == 1
    assert "2 repeated samples kept: all values equal the sample before" in kept_all.provenance["done"]
    assert kept_all.provenance["measured_hz"] == pytest.approx(100 * 588 / 590, abs=1e-3)  # two of 590 hold others


def test_a_log_that_lost_rows_keeps_its_rate_and_says_the_share():
    """100 Hz, every 33rd row lost, one value held: not 97 measurements a second."""
    t_ns, q, dq, tau = motion(1000, joints=2)
    kept = np.arange(len(t_ns)) % 33 != 16
    kept[[0, -1]] = True
    t_ns, q, dq, tau = t_ns[kept], q[kept], dq[kept], tau[kept]
    for held in (q, dq, tau):
        held[500] = held[499]
    recording = one(a_source(t_ns, q=q, dq=dq, tau=tau), arm())
    lost = 1 - kept.mean()
    assert recording.rate_hz == 100 and recording.provenance["measured_hz"] == pytest.approx(100, abs=0.2)
    assert recording.provenance["lost_share"] == pytest.approx(lost, abs=1e-3)
    assert f"{lost:.1%} of the samples at 100 Hz are missing: gaps" in recording.provenance["done"]


def uneven(longer: float, every: int, lost: float = 0.0, rate_hz: float = 100.0, n: int = 6000) -> np.ndarray:
    """Stamps, [ns], of which every so many steps are so many times as long, and a share of the samples is lost."""
    rng = np.random.default_rng(0)
    steps = np.where(np.arange(n) % every == 0, longer, 1.0) * (1 + 0.02 * rng.uniform(-1, 1, n)) / rate_hz
    t_ns = np.round(np.cumsum(steps) * 1e9).astype(np.int64)
    return t_ns[rng.random(n) >= lost]


@pytest.mark.parametrize("rate_hz", [100.0, 125.0, 500.0])
@pytest.mark.parametrize("lost", [0.0, 0.06, 0.1])
@pytest.mark.parametrize("longer, every", [(1.0, 2), (1.2, 3), (1.5, 10), (1.6, 10)])
def test_the_period_is_the_mean_step_of_the_samples_that_were_to_come(longer, every, lost, rate_hz):
    mean_s = (1 + (longer - 1) / every) / rate_hz
    t_ns = uneven(longer, every, lost, rate_hz)
    # 2 %: where two steps run together and one of them is long, their sum may be no whole number of periods.
    assert fitted_period_ns(t_ns) * 1e-9 == pytest.approx(mean_s, rel=2e-2 if lost else 1e-3)
    missing = lost_samples(t_ns).sum()
    assert missing / (missing + len(t_ns)) == pytest.approx(lost, abs=0.01)


def test_pauses_and_bursts_of_lost_samples_leave_the_period_as_it_is():
    t_ns = uneven(1.2, 3)
    pauses = t_ns + 10**9 * (np.arange(len(t_ns)) // 500) * 3 + 37 * 10**6 * (np.arange(len(t_ns)) // 200)
    assert fitted_period_ns(pauses) == pytest.approx(fitted_period_ns(t_ns), rel=2e-3)
    assert fitted_period_ns(np.array([0, 10**7])) == 10**7
    late = t_ns + 9 * 10**6 * (np.arange(len(t_ns)) % 7 == 3)  # comes with the next one, and none is lost
    assert fitted_period_ns(late) == pytest.approx(fitted_period_ns(t_ns), rel=2e-3) and lost_samples(late).sum() == 0
    bursts = np.delete(t_ns, [k + j for k in range(100, 5900, 100) for j in range(4)])
    assert fitted_period_ns(bursts) == pytest.approx(fitted_period_ns(t_ns), rel=5e-3)


def test_an_arm_at_rest_is_no_repeated_sample():
    values = np.zeros((50, 3))
    values[:20] = np.arange(20)[:, None]
    counts: Counter[str] = Counter()
    assert fresh(np.arange(50) * 10**7, values, True, counts).all()
    assert +counts == {"samples that stay the same for more than 0.1 s kept: at rest, or stuck": 29}


def test_missing_values_are_dropped_and_counted():
    t_ns, q, dq, tau = motion(joints=2)
    tau[7, 1] = np.nan
    recording = one(a_source(t_ns, q=q, dq=dq, tau=tau), arm())
    assert recording.samples == 399
    assert recording.provenance["dropped"] == ["1 row left out: 'tau[1]' is missing or no finite number, first row 8"]
    assert recording.provenance["dropped_share"] == 1 / 400


def test_sorting_agrees_with_a_slow_twin():
    rng = np.random.default_rng(0)
    t_ns = rng.integers(0, 60, 200)
    values = rng.integers(0, 3, (200, 2)).astype(float)
    first: dict[int, np.ndarray] = {}
    for t, row in zip(t_ns, values, strict=True):
        first.setdefault(int(t), row)
    times, sorted_values = ordered(t_ns, values, Counter())
    assert times.tolist() == sorted(first)
    np.testing.assert_array_equal(sorted_values, [first[t] for t in sorted(first)])


def test_a_long_source_becomes_pieces_that_join_without_a_seam():
    t_ns, q, dq, tau = motion(1000, joints=2)
    order = np.arange(1000)
    order[98:102] = order[98:102][::-1]  # packets out of order across the seam
    source = a_source(t_ns[order], block=7, q=q[order], dq=dq[order], tau=tau[order])
    pieces = list(assemble(source, arm(), rules=RowRules(piece_s=1.0, late_s=0.05)))
    assert 8 <= len(pieces) <= 10 and [p.name for p in pieces[:2]] == ["run-00", "run-01"]
    np.testing.assert_array_equal(np.concatenate([p.t_ns for p in pieces]), t_ns)
    np.testing.assert_array_equal(np.concatenate([p.tau for p in pieces]), tau)
    assert pieces[3].provenance["start_s"] == pytest.approx((pieces[3].t_ns[0] - t_ns[0]) * 1e-9)
    assert sum(p.provenance["counts"].get("samples out of order, sorted by their stamps", 0) for p in pieces) >= 2


def test_topics_are_merged_onto_the_torques_stamps(tmp_path):
    # Position at 100 Hz, torque on a topic of its own, 3 ms later; linear signals are interpolated without error.
    line = np.arange(400)[:, None] * 0.01 + np.arange(3)
    t_ns = motion()[0]
    states = [(t, int(t), JOINTS, q, q, []) for t, q in zip(t_ns, line, strict=True)]
    torques = [
        (t, int(t) + 3_000_000, JOINTS[::-1], [], [], tau[::-1].copy()) for t, tau in zip(t_ns, 2 * line, strict=True)
    ]
    path = write_bag(tmp_path / "run", "sqlite3", {"/states": states, "/torques": torques})
    described = parse_arm(
        f"""
        [robot]
        joints = {list(JOINTS)}
        [signals.q]
        columns = "position"
        topic = "/states"
        [signals.dq]
        columns = "velocity"
        topic = "/states"
        [signals.tau]
        columns = "effort"
        topic = "/torques"
        """
    )
    recording = one(*open_raw(path, described.topics), described)
    np.testing.assert_array_equal(recording.t_ns, t_ns[:-1] + 3_000_000)  # the last has no position after it
    np.testing.assert_allclose(recording.q, line[:-1] + 0.003, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(recording.tau, 2 * line[:-1])
    assert (
        recording.provenance["done"][-1]
        == "/states brought to the stamps of /torques (the torque's), linear in between"
    )


def test_nothing_is_interpolated_across_a_gap():
    times = np.array([0, 10, 20, 30, 90, 100], np.int64)
    values, known = interpolated(np.array([-5, 5, 40, 90, 95, 101]), (times, times[:, None] * 2.0), Counter(), "q")
    assert known.tolist() == [False, True, False, True, True, False]
    np.testing.assert_array_equal(values[known, 0], [10, 180, 190])


def test_a_derived_velocity_is_the_low_pass_of_a_ramps_slope():
    # For a ramp from rest the filter's step response holds at every sample: v (1 - e^(-2 pi f t)).
    t_ns = np.cumsum(np.random.default_rng(0).integers(8_000_000, 12_000_000, 300))
    time_s = (t_ns - t_ns[0])[:, None] * 1e-9
    begin = time_s[20]
    q = np.where(time_s > begin, 3.0 * (time_s - begin), 0.0)
    dq = derived_velocity(t_ns, q, 5.0)
    expected = np.where(time_s > begin, 3.0 * (1 - np.exp(-2 * np.pi * 5.0 * (time_s - begin))), 0.0)
    np.testing.assert_allclose(dq, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(derived_velocity(t_ns, 3 * time_s, 0.0), 3.0, rtol=1e-9)


def test_a_held_position_has_the_speed_of_its_measurement():
    # A ramp read twice as often as it is measured: without a low-pass its speed is the ramp's at every row but the
    # last, whose row is new; a difference to the row before would be 0 and 2 v in turn.
    t_ns = np.arange(0, 400, dtype=np.int64) * 5_000_000
    ramp = np.repeat(np.arange(200)[:, None] * 0.01 * np.array([1.0, -2.0]), 2, axis=0)
    described = parse_arm(
        '[robot]\njoints = ["a", "b"]\n[signals.q]\ncolumns = "q"\n[signals.tau]\ncolumns = "tau"\n'
        '[signals.dq]\ncolumns = ""\nlow_pass_hz = 0'
    )
    recording = one(a_source(t_ns, q=ramp, tau=ramp), described)
    assert recording.samples == 400 and recording.rate_hz == 200
    np.testing.assert_allclose(recording.dq, np.tile([1.0, -2.0], (400, 1)), rtol=1e-9)


def test_a_velocity_that_is_not_recorded_is_derived_and_reported():
    t_ns, q, _, tau = motion(joints=2)
    described = parse_arm('[robot]\njoints = ["a", "b"]\n[signals.q]\ncolumns = "q"\n[signals.tau]\ncolumns = "tau"')
    recording = one(a_source(t_ns, q=q, tau=tau), described)
    np.testing.assert_array_equal(recording.dq, derived_velocity(t_ns, q, 20.0))
    assert recording.provenance["done"] == ["velocity derived from the position, low-pass 20 Hz"]


def test_labels_and_intervals_become_contact():
    t_ns, q, dq, tau = motion(joints=2)
    label = np.r_[np.zeros(100), np.full(100, 2.0), np.full(200, 7.0)]
    rest = '[contact]\ncolumn = "label"\ncontact_values = [2, 3]\n[contact.intervals]\n"run.csv" = [[3.5, 3.6]]'
    contact = one(a_source(t_ns, q=q, dq=dq, tau=tau, label=label), arm(rest=rest)).contact
    np.testing.assert_array_equal(contact, np.r_[[0] * 100, [1] * 100, [-1] * 150, [1] * 11, [-1] * 39])
    rest = '[contact.intervals]\n"run.csv" = [[1, 2]]\n"other.csv" = [[0, 1]]'
    assert one(a_source(t_ns, q=q, dq=dq, tau=tau), arm(rest=rest)).contact.sum() == 101
    assert one(a_source(t_ns, q=q, dq=dq, tau=tau), arm()).contact is None


def test_a_source_without_a_clock_needs_a_column_of_times_or_a_rate():
    t_ns, q, dq, tau = motion(joints=2)
    source = a_source(t_ns, q=q, dq=dq, tau=tau, t=(t_ns - t_ns[0]) * 1e-6)
    clockless = RawRecording(
        "run",
        Path("run.csv"),
        "test",
        lambda: (dataclasses.replace(b, t_ns=None) for b in source.blocks()),
        stated_hz={"fs": 100.0},
        unread_times={"when": "10h00"},
    )
    named = r"column 'when' is text such as '10h00', .* is read; the file states fs = 100 Hz"
    with pytest.raises(RecordingError, match=rf"it has no clock: name its column of times .*; {named}"):
        one(clockless, arm())
    by_column = one(clockless, arm(time='column = "t"\nunit = "ms"'))
    by_rate = one(clockless, arm(time="rate_hz = 100"))
    np.testing.assert_array_equal(by_column.t_ns, t_ns - t_ns[0])
    np.testing.assert_array_equal(by_rate.t_ns, t_ns - t_ns[0])


MISTAKES = {
    "unknown key": (
        dict(tau="torque_const = 1"),
        ".signals.tau. unknown key 'torque_const'; the nearest known is 'tor",
    ),
    "unknown table": (dict(rest="[contcat]"), "unknown key 'contcat'; the nearest known is 'contact'"),
    "unit": (dict(q='unit = "degrees"'), r"\[signals.q\] unit = 'degrees' must be one of rad, deg"),
    "sign": (dict(tau="sign = 2"), r"\[signals.tau\] sign = .* must be one of 1, -1"),
    "count": (dict(tau="sign = [1, 1, 1]"), "must be one of 1, -1, one for all joints or a list of 2"),
    "type": (dict(time='rate_hz = "fast"'), r"\[time\] rate_hz = 'fast' must be a number"),
    "choice": (dict(tau='timing = "later"'), "timing = 'later' must be one of held, instant, averaged"),
    "current": (dict(tau='unit = "A"'), 'torque_constant = .* must be Nm/A, one a joint, or "unknown"'),
    "constant": (dict(tau="torque_constant = 1"), "torque_constant = .* must be left out, since the unit is Nm"),
    "names": (dict(robot='names = ["x", "x"]'), r"\[robot\] names = .* must be .*, names that differ"),
    "interval": (dict(rest='[contact.intervals]\n"a.bag" = [[2, 1]]'), r"must be .*, \[t0, t1\] with t0 < t1"),
    "payload": (dict(rest="[payload]\nmass_kg = 1.0"), "model = '' must be a robot file, where there is a payload"),
    "toml": (dict(rest="[["), "not readable as TOML"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_wrong_description_is_refused_by_key_value_and_rule(mistake):
    entries, message = MISTAKES[mistake]
    with pytest.raises(ConfigError, match=message):
        arm(**entries)


def test_columns_that_are_not_there_are_named_with_what_is_near():
    t_ns, q, dq, tau = motion(joints=2)
    source = a_source(t_ns, q=q, qd=dq, torque=tau)
    with pytest.raises(ConfigError, match=r"\[signals.dq\] 'dq' is not in run.csv; similar: .*derives the velocity"):
        one(source, arm())
    source = a_source(t_ns, q=np.c_[q, q], dq=dq, tau=tau)
    with pytest.raises(ConfigError, match=r"its elements are 0, 1, 2, 3; \[robot\] names .* by \"q\[{index}\]\""):
        one(source, arm())


def test_joint_names_choose_columns_whatever_their_order(tmp_path):
    path = write_bag(tmp_path / "run", "ros1", {"/joint_states": joint_rows()})
    described = parse_arm(
        '[robot]\njoints = ["j3", "j1"]\nnames = ["tip", "base"]\n[signals.q]\ncolumns = "position"\n'
        '[signals.tau]\ncolumns = "effort[{joint}]"'
    )
    recording = one(*open_raw(path), described)
    np.testing.assert_array_equal(recording.q, motion()[1][:, [2, 0]])
    np.testing.assert_array_equal(recording.tau, motion()[3][:, [2, 0]])


def test_the_template_explains_every_key_and_is_itself_a_description():
    text = template(Guess())
    tables = (v for v in vars(description).values() if dataclasses.is_dataclass(v) and v.__name__.endswith("Table"))
    for table in tables:
        for key in dataclasses.fields(table):
            assert re.search(rf"^(# )?\[?(\w+\.)?{key.name}\b", text, re.MULTILINE), f"{table.__name__}.{key.name}"
    assert parse_arm(text).robot.joints == ("joint1", "joint2")
    uncommented = re.sub(r"(?m)^# (?=(\[|[a-z_0-9]+ = ))", "", text)
    with_all = parse_arm(uncommented.replace('unit = "Nm"', 'unit = "A"', 1))
    assert with_all.split.gap_s == 2.0 and set(with_all.signals) == set(description.SIGNALS)


def test_the_template_makes_a_servos_torque_where_no_column_holds_it():
    joints = ("shoulder_pan", "gripper")
    named = [f"{signal}_{joint}" for joint in joints for signal in ("q", "dq", "goal")]
    described = parse_arm(template(guess({"": ["t", *named]})))
    assert described.robot.joints == joints and described.signals["q"].columns == ("q_{joint}",)
    assert described.signals["q_des"].columns == ("goal_{joint}",) and described.makes_torque
    assert described.servo is not None and described.servo.torque_from == "goal"
    states = [f"{feature}[{joint}.pos]" for feature in ("observation.state", "action") for joint in joints]
    described = parse_arm(template(guess({"": [*states, "timestamp"]})))
    assert described.signals["q_des"].columns == ("action",) and described.makes_torque
    duty = [f"{signal}_{joint}" for joint in joints for signal in ("q", "duty", "goal")]
    assert parse_arm(template(guess({"": ["t", *duty]}))).servo.torque_from == "duty"
    with_current = template(guess({"": ["t", *named, *(f"current_{joint}" for joint in joints)]}))
    assert parse_arm(with_current).servo is None and 'unit = "A"' in with_current


@pytest.mark.parametrize(
    ("what", "first", "after"),
    [("all", 0, 150), ("all", 250, 400), ("all", 200, 230), ("tau", 0, 150), ("one position", 0, 150)],
)
@pytest.mark.parametrize("value", [0.0, 3.0])
def test_rows_that_a_driver_did_not_measure_are_left_out_and_counted(what, first, after, value):
    """At the beginning, at the end and in between."""
    t_ns, *signals = motion(joints=2)
    q, dq, tau = (x + 2e-4 * np.random.default_rng(0).standard_normal(x.shape) for x in signals)
    tau += 40.0
    rows = slice(first, after)
    for x in (q, dq, tau) if what == "all" else (tau,) if what == "tau" else (q[:, 1:],):
        x[rows] = value
    q[:, 1] += 9.0 * (what == "one position")
    q[rows, 1] -= 9.0 * (what == "one position")
    recording = one(a_source(t_ns, q=q, dq=dq, tau=tau), arm())
    kept = np.delete(np.arange(len(t_ns)), rows)
    np.testing.assert_array_equal(recording.t_ns, t_ns[kept])
    assert recording.provenance["counts"][UNMEASURED] == after - first
    assert recording.provenance["dropped_share"] == pytest.approx((after - first) / len(t_ns), abs=1e-6)


@pytest.mark.parametrize("noise", [0.0, 1e-4])
@pytest.mark.parametrize("pause_s", [0.0, 30.0])
def test_an_arm_that_rests_is_measured(noise, pause_s):
    """Without noise, before a friction that begins at once, and where the log was stopped while the arm moved."""
    t_ns, q, dq, tau = motion(joints=2)
    rests = np.r_[np.zeros(150, int), np.arange(250)]
    q, tau = q[rests], tau[rests] + 5.0 * (np.arange(400) >= 150)[:, None]
    if pause_s:
        t_ns, q = t_ns + np.where(np.arange(400) >= 150, round(pause_s * 1e9), 0), q + (np.arange(400) >= 150)[:, None]
    q = q + noise * np.random.default_rng(0).standard_normal(q.shape)
    tau = tau + noise * np.random.default_rng(1).standard_normal(q.shape)
    assert one(a_source(t_ns, q=q, dq=dq, tau=tau), arm()).samples == 400


UR_NAMES = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", *(f"wrist_{k}_joint" for k in (1, 2, 3)))


@pytest.mark.parametrize(("largest", "unit"), [(2.5, "A"), (48.0, "Nm")])
def test_the_effort_of_a_ur_arm_is_a_current_or_a_torque_by_its_size(largest, unit):
    t_ns, q, dq, _ = motion(joints=6)
    names = [f"{signal}[ur5e_{joint}]" for signal in ("position", "velocity", "effort") for joint in UR_NAMES]
    block = RawSignals("/joint_states", tuple(names), t_ns, np.hstack([q, dq, largest * np.sin(q)]))
    found = guess({"/joint_states": names})
    guess_values(found, RawRecording("run", Path("run.bag"), "test", lambda: iter([block])))
    text = template(found)
    assert f'\nunit = "{unit}"' in text.partition("[signals.tau]")[2].partition("\n[")[0]
    assert ('\ntorque_constant = "unknown"' in text) == (unit == "A") and "use_currents_as_efforts" in text


def test_of_a_log_by_rtde_the_measured_torque_is_taken():
    kinds = ("target_current", "target_moment", "actual_q", "actual_qd", "actual_current", "actual_current_as_torque")
    found = guess({"": ["timestamp", *(f"{kind}_{k}" for kind in ("target_q", *kinds) for k in range(6))]})
    assert found.columns["tau"] == "actual_current_as_torque_{index}" and '\nunit = "A"' not in template(found)
    fewer = guess({"": ["timestamp", *(f"{kind}_{k}" for kind in kinds[:-1] for k in range(6))]})
    assert fewer.columns["tau"] == "actual_current_{index}" and 'torque_constant = "unknown"' in template(fewer)


def test_the_template_guesses_names_of_columns():
    names = [f"{base}{k}" for base in ("tau_J", "q", "dq", "q_d", "tau_ext") for k in range(7)]
    found = guess({"": [*names, "time", "label"]})
    assert found.columns == {
        "q": "q{index}",
        "dq": "dq{index}",
        "tau": "tau_J{index}",
        "tau_ext": "tau_ext{index}",
        "q_des": "q_d{index}",
        "time": "time",
        "label": "label",
    }
    both = [f"{base}{k}" for base in ("q", "i", "current", "tau", "torque_measured") for k in range(6)]
    assert guess({"": both}).columns["tau"] == "tau{index}"
    longer = [f"{base}[{k}]" for base in ("position", "i", "actual_torque") for k in range(6)]
    assert 'columns = "i"' in template(guess({"": longer[:12]})) and 'unit = "A"' in template(guess({"": longer[:12]}))
    measured = [f"{base}{k}" for base in ("q", "current", "joint_torque") for k in range(6)]
    text = template(guess({"": measured}))
    assert 'columns = "joint_torque{index}"' in text and 'unit = "Nm"' in text and '\nunit = "A"' not in text
    states = [f"{a}[{j}]" for a in ("position", "effort") for j in JOINTS]
    text = template(guess({"/joint_states": states}), "arm.urdf", ("j1", "j2", "j3", "finger"))
    assert 'joints = ["j1", "j2", "j3"]' in text and 'names = ["?", "?", "?"]' in text and 'locked = ["finger"]' in text
    described = parse_arm(re.sub(r"names = .*", f"names = {json.dumps(JOINTS)}", text))
    assert described.robot.joints == ("j1", "j2", "j3") and described.names == JOINTS
    assert not described.signals["dq"].columns


@pytest.mark.parametrize(
    ("words", "columns", "unit"),
    [
        ("Mom", "{joint}_Mom", "Nm"),
        ("Drehmoment", "{joint}_Drehmoment", "Nm"),
        ("tq", "{joint}_tq", "Nm"),
        ("Strom", "{joint}_Strom", "A"),
        ("I", "{joint}_I", "A"),
        ("M", "?{joint}_M", "Nm"),  # may be a motor
        ("Last", "?", "Nm"),
    ],
)
def test_the_template_marks_a_torque_that_no_name_shows(words, columns, unit):
    names = [f"Gelenk{k}_{signal}" for signal in ("Pos", "Vel", words) for k in (1, 2)]
    text = template(guess({"": names}))
    table = text.partition("\n[signals.tau]\n")[2].partition("\n[")[0]
    assert f'\ncolumns = "{columns}"\n' in "\n" + table and f'\nunit = "{unit}"' in table
    evidence = "not in use: {joint}_Last" if columns == "?" else "by the names of 2 columns"
    assert f"# Evidence: {'no column is named' if columns == '?' else evidence}" in table and evidence in table
    if columns.startswith("?"):
        with pytest.raises(ConfigError, match=r"\[signals.tau\] columns has '\?"):
            parse_arm(text)
    else:
        assert parse_arm(text).signals["tau"].columns == (columns,)


def test_the_template_asks_for_a_position_and_a_velocity_that_no_name_shows():
    text = template(guess({"": [f"{signal}_{k}" for signal in ("lage", "tau") for k in (1, 2)]}))
    with pytest.raises(ConfigError, match=r"\[signals.q\] columns has '\?'"):
        parse_arm(text)
    text = template(guess({"": [f"{signal}_{k}" for signal in ("q", "tempo", "tau") for k in (1, 2)]}))
    with pytest.raises(ConfigError, match=r"\[signals.dq\] columns has '\?'"):
        parse_arm(text)
    assert not parse_arm(text.replace('"?"', '""')).signals["dq"].columns


def named(*patterns: str, joints=("shoulder", "elbow")) -> list[str]:
    """Columns of two joints: {j} is a name, {i} a number."""
    found = []
    for pattern in patterns:
        several = "{" in pattern
        found += [pattern.format(j=joint, i=k + 1) for k, joint in enumerate(joints)] if several else [pattern]
    return list(dict.fromkeys(found))


STATE = "observation.state"
NAMES = {
    "units in brackets": (
        named("Time (s)", "q{i} [rad]", "dq{i} [rad/s]", "c{i} (mA)"),
        {"q": "q{number} [rad]", "dq": "dq{number} [rad/s]", "tau": "c{number} (mA)"},
        {"time": "s", "q": "rad", "dq": "rad/s", "tau": "mA"},
    ),
    "units at the end": (
        named("timestamp_us", "position_{i}_rad", "velocity_{i}_rad_s", "current_{i}_A"),
        {"q": "position_{number}_rad", "dq": "velocity_{number}_rad_s", "tau": "current_{number}_A"},
        {"time": "us", "q": "rad", "dq": "rad/s", "tau": "A"},
    ),
    "units in humps": (
        named("t", "ActualJointPos{i}Deg", "JointTorque{i}mNm"),
        {"q": "ActualJointPos{number}Deg", "tau": "JointTorque{number}mNm"},
        {"q": "deg", "tau": "mNm"},
    ),
    "a letter is no unit of another signal": (
        named("position[{j}]", "effort[{j}]", joints=("a", "s")),
        {"q": "position", "tau": "effort"},
        {},
    ),
    "goal and measured of one joint": (
        ["time", "q_des", "q_act", "dq_des", "dq_act", "ddq_des", "torque"],
        {"q": "q_act", "dq": "dq_act", "tau": "torque", "q_des": "q_des"},
        {},
    ),
    "goal and measured of named joints": (
        named("{j}_des_pos", "{j}_act_pos", "{j}_act_vel", "{j}_torque"),
        {"q": "{joint}_act_pos", "dq": "{joint}_act_vel", "tau": "{joint}_torque", "q_des": "{joint}_des_pos"},
        {},
    ),
    "a state of several signals": (
        named(*(f"{STATE}[{{j}}.{kind}]" for kind in ("pos", "vel", "torque")), "action[{j}.pos]", "goal[{j}.pos]"),
        {f"{signal}": f"{STATE}[{{joint}}.{kind}]" for signal, kind in (("q", "pos"), ("dq", "vel"), ("tau", "torque"))}
        | {"q_des": "goal[{joint}.pos]"},
        {},
    ),
    "a torque of one arm": (
        named(f"{STATE}[{{j}}.pos]", "observation.torque.left[{j}]", "goal[{j}.pos]"),
        {"q": STATE, "tau": "observation.torque.left", "q_des": "goal"},
        {},
    ),
}


@pytest.mark.parametrize("kind", NAMES)
def test_names_state_signals_units_and_goals(kind):
    names, columns, units = NAMES[kind]
    found = guess({"": names})
    assert {name: column for name, column in found.columns.items() if name != "time"} == columns
    assert found.units == units
    assert not found.values.get("servo.torque_from") and found.joint_names != ("des", "act")


def test_what_names_leave_open_is_a_question():
    both = guess({"": named("motor_position_{i}", "joint_position_{i}", "tau_{i}")})
    assert both.values["signals.q.columns"] == "?joint_position_{number}"
    assert "motor_position_{number} would fit, too" in both.why["signals.q.columns"]
    arms = guess({"": named("left_q{i}", "right_q{i}", "left_tau{i}", "right_tau{i}")})
    assert arms.values["signals.q.columns"] == "?left_q{number}" and arms.columns["tau"] == "left_tau{number}"
    unknown = guess({"": named(f"{STATE}[{{j}}.pos]", "observation.last[{j}]", "goal[{j}.pos]")})
    assert unknown.values["servo.torque_from"] == "?goal" and unknown.unused == ["observation.last"]


def test_a_line_of_units_counts_as_names_do():
    names = named("time", "q{i}", "dq{i}", "tau{i}")
    stated = {"time": "[ms]", "q1": "deg", "q2": "deg", "dq1": "deg/s", "dq2": "deg/s", "tau1": "Nm", "tau2": "Nm"}
    assert guess({"": names}, (), stated).units == {"time": "ms", "q": "deg", "dq": "deg/s", "tau": "Nm"}
