"""A recording is checked when made, its file keeps it exactly, and every fault is refused by name."""

from __future__ import annotations

import hashlib
import json
from dataclasses import FrozenInstanceError, fields

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tauext.data.recording import Recording
from tauext.data.recording_file import describe, load_recording, save_recording
from tauext.errors import RecordingError

JOINTS = ("shoulder", "elbow")
SAMPLES = 500


def content(seed: int = 0, samples: int = SAMPLES) -> dict:
    rng = np.random.default_rng(seed)

    def signal() -> np.ndarray:
        return rng.standard_normal((samples, len(JOINTS)))

    return {
        "name": "one",
        "joints": JOINTS,
        "t_ns": 5_000_000_000 + np.arange(samples) * 1_000_000,
        "q": signal(),
        "dq": signal(),
        "tau": signal(),
        "rate_hz": 1000.0,
        "torque_timing": "held",
        "source": "made for a test",
        "robot_sha256": "0" * 64,
    }


def full_content(seed: int = 0) -> dict:
    rng = np.random.default_rng([seed, 1])
    shape = (SAMPLES, len(JOINTS))
    per_joint = ("tau_jts", "tau_ext", "tau_ext_sensor", "q_des", "temperature")
    return content(seed) | {
        **{signal: rng.standard_normal(shape) for signal in per_joint},
        "contact": rng.integers(-1, 2, SAMPLES),
        "contact_link": rng.integers(-1, len(JOINTS), SAMPLES),
        "provenance": {"seed": seed, "motion": [1.5, None]},
    }


def assert_same(a: Recording, b: Recording) -> None:
    for field in fields(Recording):
        left, right = getattr(a, field.name), getattr(b, field.name)
        if isinstance(left, np.ndarray):
            assert left.dtype == right.dtype
            assert np.array_equal(left, right), field.name
        else:
            assert left == right, field.name


# The type


def test_arrays_are_contiguous_read_only_and_apart_from_the_callers():
    given = full_content()
    recording = Recording(**given)
    for field in fields(Recording):
        value = getattr(recording, field.name)
        if isinstance(value, np.ndarray):
            assert value.flags.c_contiguous and not value.flags.writeable
    given["q"][0, 0] = 99.0
    assert recording.q[0, 0] != 99.0
    assert (recording.t_ns.dtype, recording.q.dtype, recording.contact.dtype) == (np.int64, np.float64, np.int8)
    with pytest.raises(FrozenInstanceError):
        recording.name = "other"


def test_time_counts_from_the_first_sample():
    recording = Recording(**content())
    assert recording.samples == SAMPLES
    assert recording.duration_s == pytest.approx(0.499, abs=1e-12)
    assert recording.time_s[0] == 0.0 and recording.time_s[-1] == recording.duration_s


def test_a_single_sample_and_a_gap_are_allowed():
    assert Recording(**content(samples=1)).duration_s == 0.0
    given = content()
    given["t_ns"][SAMPLES // 2 :] += 3_000_000_000
    assert Recording(**given).duration_s == pytest.approx(3.499)


def change(name: str, row: int, joint: int, value: float):
    def apply(given: dict) -> None:
        given[name][row, joint] = value

    return apply


def put(**values):
    return lambda given: given.update(values)


def step_back(given: dict) -> None:
    given["t_ns"][7] = given["t_ns"][6]


FAULTS = {
    "nan": (change("tau", 17, 1, np.nan), "tau_elbow at row 17 is nan; every value must be finite"),
    "infinity": (change("q", 3, 0, -np.inf), "q_shoulder at row 3 is -inf"),
    "time stands still": (step_back, "t_ns at row 7 is 5006000000, after 5006000000 at row 6; times must strictly inc"),
    "float times": (put(t_ns=np.arange(SAMPLES) * 1e-3), "t_ns is float64, must be int64 nanoseconds"),
    "no samples": (put(t_ns=np.zeros(0, np.int64)), "it has no samples; at least one is needed"),
    "table of times": (put(t_ns=np.zeros((3, 1), np.int64)), "t_ns has shape (3, 1), must be (samples,)"),
    "one joint only": (put(dq=np.zeros((SAMPLES, 1))), "dq has shape (500, 1), must be (500, 2): (samples, joints)"),
    "too few rows": (put(tau_jts=np.zeros((9, 2))), "tau_jts has shape (9, 2)"),
    "no torque": (put(tau=None), "tau is object, must be float64"),
    "complex": (put(tau=np.zeros((SAMPLES, 2), complex)), "tau is complex128, must be float64"),
    "twin joints": (put(joints=("elbow", "elbow")), "joint 'elbow' is named 2 times; names must differ"),
    "no joints": (put(joints=()), "it has no joints"),
    "nameless joint": (put(joints=("elbow", "")), "joint name '' must be text, not empty"),
    "commands to a terminal": (put(joints=("elbow", "a\x1b[2J")), r"joint name 'a\x1b[2J' has characters that cannot"),
    "shared column": (put(joints=("a", "jts_a")), "joints 'a' and 'jts_a' would share the column tau_jts_a"),
    "timing": (put(torque_timing="late"), "torque_timing = 'late' must be one of held, instant, averaged"),
    "rate zero": (put(rate_hz=0.0), "rate_hz = 0 must be > 0"),
    "rate nan": (put(rate_hz=np.nan), "rate_hz = nan must be > 0"),
    "rate of another": (put(rate_hz=500.0), "rate_hz = 500 disagrees with the sample period of t_ns, 1 ms (1000 Hz)"),
    "contact 2": (put(contact=np.full(SAMPLES, 2)), "contact at row 0 is 2, must be 0 (free), 1 (contact) or -1"),
    "contact rows": (put(contact=np.zeros(3, int)), "contact has shape (3,), must be (500,)"),
    "float contact": (put(contact=np.zeros(SAMPLES)), "contact is float64, must be int8"),
    "no such link": (put(contact_link=np.full(SAMPLES, 2)), "contact_link at row 0 is 2, must be the index of a joint"),
    "wrapping link": (put(contact_link=np.full(SAMPLES, 256)), "contact_link at row 0 is 256"),
    "source": (put(source=None), "source = None must be text"),
    "provenance": (put(provenance={"x": object()}), "provenance must be plain JSON"),
    "provenance list": (put(provenance=[1]), "provenance is list, must be a dict"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_refused_with_its_place_and_rule_on_one_line(fault):
    inject, message = FAULTS[fault]
    given = content()
    inject(given)
    with pytest.raises(RecordingError) as caught:
        Recording(**given)
    assert message in str(caught.value)
    assert str(caught.value).startswith("recording 'one': ")
    assert "\n" not in str(caught.value)


def test_rates_agree_within_twenty_percent():
    for rate_hz in (810.0, 1190.0):
        Recording(**content() | {"rate_hz": rate_hz})
    for rate_hz in (790.0, 1210.0):
        with pytest.raises(RecordingError, match="must agree within 20%"):
            Recording(**content() | {"rate_hz": rate_hz})


# The file


@pytest.mark.parametrize("make", [content, full_content], ids=["required", "everything"])
def test_a_file_keeps_the_recording_exactly(make, tmp_path):
    recording = Recording(**make())
    save_recording(recording, tmp_path / "one.parquet")
    assert_same(load_recording(tmp_path / "one.parquet"), recording)


def test_extreme_values_survive(tmp_path):
    given = content()
    given["q"][0] = [5e-324, 1.7976931348623157e308]
    given["q"][1] = [-0.0, 0.1]
    given["rate_hz"] = 1000.0000000000001
    save_recording(Recording(**given), tmp_path / "one.parquet")
    again = load_recording(tmp_path / "one.parquet")
    assert again.q.tobytes() == np.ascontiguousarray(given["q"]).tobytes()
    assert again.rate_hz == given["rate_hz"]


def test_the_same_recording_gives_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        save_recording(Recording(**full_content()), tmp_path / f"{name}.parquet")
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()


def test_the_name_is_the_stem_of_the_file(tmp_path):
    save_recording(Recording(**content()), tmp_path / "other.name.parquet")
    assert load_recording(tmp_path / "other.name.parquet").name == "other.name"


def test_floats_are_byte_stream_split_and_zstd(tmp_path):
    save_recording(Recording(**full_content()), tmp_path / "one.parquet")
    group = pq.ParquetFile(tmp_path / "one.parquet").metadata.row_group(0)
    columns = [group.column(k) for k in range(group.num_columns)]
    floats = [c for c in columns if c.physical_type == "DOUBLE"]
    assert len(floats) == 16
    assert all("BYTE_STREAM_SPLIT" in c.encodings and c.compression == "ZSTD" for c in floats)
    assert not any("DICTIONARY" in encoding for c in floats for encoding in c.encodings)


def test_describe_reads_the_head_only(tmp_path):
    save_recording(Recording(**full_content()), tmp_path / "one.parquet")
    head = describe(tmp_path / "one.parquet")
    assert (head.name, head.joints, head.samples, head.rate_hz) == ("one", JOINTS, SAMPLES, 1000.0)
    assert head.signals[:3] == ("q", "dq", "tau") and head.signals[-2:] == ("contact", "contact_link")
    assert head.torque_timing == "held" and head.provenance["seed"] == 0


def test_a_failed_save_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path = tmp_path / "one.parquet"
    save_recording(Recording(**content()), path)
    before = path.read_bytes()

    def full_disk(*args, **kwargs):
        (tmp_path / "one.parquet.part").write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pq, "write_table", full_disk)
    with pytest.raises(RecordingError, match=r"one\.parquet: cannot be written \(No space left on device\)"):
        save_recording(Recording(**content(seed=1)), path)
    assert [p.name for p in tmp_path.iterdir()] == ["one.parquet"]
    assert path.read_bytes() == before


def test_save_refuses_a_missing_folder_and_another_ending(tmp_path):
    with pytest.raises(RecordingError, match="cannot be written"):
        save_recording(Recording(**content()), tmp_path / "nowhere" / "one.parquet")
    with pytest.raises(RecordingError, match=r"must end in \.parquet"):
        save_recording(Recording(**content()), tmp_path / "one.csv")


# Faults of files


def rewrite(path, change_table=None, change_metadata=None) -> None:
    table = pq.read_table(path)
    metadata = {k.decode(): v.decode() for k, v in table.schema.metadata.items()}
    if change_table:
        table = change_table(table)
    if change_metadata:
        metadata = change_metadata(metadata)
    pq.write_table(table.replace_schema_metadata(metadata), path)


def drop(name: str):
    return {"change_table": lambda table: table.drop_columns([name])}


def replace(name: str, values):
    def change_table(table: pa.Table) -> pa.Table:
        return table.set_column(table.column_names.index(name), name, values(table.column(name)))

    return {"change_table": change_table}


def metadata(**entries):
    return {"change_metadata": lambda old: old | entries}


def without(key: str):
    return {"change_metadata": lambda old: {k: v for k, v in old.items() if k != key}}


def with_unit(quantity: str, unit: str):
    return {"change_metadata": lambda old: old | {"units": json.dumps(json.loads(old["units"]) | {quantity: unit})}}


def at(row: int, value):
    def values(column: pa.ChunkedArray) -> pa.Array:
        entries = column.to_pylist()
        entries[row] = value
        return pa.array(entries, column.type)

    return values


def extra(name: str):
    return {"change_table": lambda table: table.append_column(name, pa.array(np.zeros(len(table))))}


FILE_FAULTS = {
    "no torque": (drop("tau_elbow"), "column 'tau_elbow' is missing; a signal has all joints (shoulder, elbow)"),
    "no times": (drop("t_ns"), "column 't_ns' is missing"),
    "half a sensor": (drop("tau_jts_shoulder"), "column 'tau_jts_shoulder' is missing; a signal has all joints"),
    "half a temperature": (drop("temperature_elbow"), "column 'temperature_elbow' is missing"),
    "single floats": (replace("q_elbow", lambda c: c.cast(pa.float32())), "column 'q_elbow' is float, must be double"),
    "text": (replace("dq_elbow", lambda c: c.cast(pa.string())), "column 'dq_elbow' is string, must be double"),
    "seconds": (replace("t_ns", lambda c: c.cast(pa.float64())), "column 't_ns' is double, must be int64"),
    "missing value": (replace("tau_elbow", at(9, None)), "tau_elbow at row 9 is missing; every sample must have a val"),
    "nan": (replace("tau_elbow", at(9, float("nan"))), "tau_elbow at row 9 is nan; every value must be finite"),
    "unknown column": (extra("tau_wrist"), "column 'tau_wrist' does not belong to a recording"),
    "column twice": (extra("q_elbow"), "column 'q_elbow' occurs 2 times"),
    "degrees": (with_unit("q", "deg"), "the unit of q is 'deg', must be 'rad'"),
    "amperes of known constants": (
        metadata(units='{"t": "ns", "q": "rad", "dq": "rad/s", "tau": "A"}'),
        "the unit of tau is 'A', must be 'N m'",
    ),
    "no torque unit": (metadata(units='{"t": "ns", "q": "rad", "dq": "rad/s"}'), "the unit of tau is 'missing'"),
    "units text": (metadata(units="rad"), "metadata 'units' is not JSON"),
    "units list": (metadata(units="[1]"), "metadata 'units' is [1], must be a JSON object"),
    "no metadata": ({"change_metadata": lambda old: {}}, "not a recording: its metadata has no tauext_format"),
    "no joints": (without("joints"), "its metadata has no 'joints'; needed are tauext_format, joints"),
    "joints of another": (metadata(joints='["wrist"]'), "column 'q_wrist' is missing"),
    "joint twice": (metadata(joints='["elbow", "elbow"]'), "joint 'elbow' is named 2 times"),
    "newer": (metadata(tauext_format="2"), "format 2 instead of 1: made by a development version before 0.1.0 or"),
    "rate text": (metadata(rate_hz="fast"), "rate_hz = 'fast' must be a number, in Hz"),
    "wrong rate": (metadata(rate_hz="100"), "rate_hz = 100 disagrees with the sample period of t_ns, 1 ms"),
    "timing": (metadata(torque_timing="later"), "torque_timing = 'later' must be one of held, instant, averaged"),
}


def damage(path, fault: str) -> None:
    whole = path.read_bytes()
    if fault == "truncated":
        path.write_bytes(whole[: len(whole) // 2])
    elif fault == "last byte gone":
        path.write_bytes(whole[:-1])
    elif fault == "empty":
        path.write_bytes(b"")
    elif fault == "text":
        path.write_bytes(b"t,q\n1,2\n")
    elif fault == "footer":
        begin = len(whole) - 8 - int.from_bytes(whole[-8:-4], "little")
        path.write_bytes(whole[:begin] + bytes(64) + whole[begin + 64 :])
    elif fault == "flipped bit":
        middle = len(whole) // 2
        path.write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])


DAMAGES = {
    "truncated": "truncated: the end of a Parquet file is missing",
    "last byte gone": "truncated",
    "empty": "not a Parquet file",
    "text": "not a Parquet file",
    "footer": "cannot be read",
    "flipped bit": "cannot be read",
}


def assert_load_fails_and_leaves_the_file(path, message: str) -> None:
    before = (hashlib.sha256(path.read_bytes()).hexdigest(), path.stat().st_mtime_ns)
    with pytest.raises(RecordingError) as caught:
        load_recording(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert (hashlib.sha256(path.read_bytes()).hexdigest(), path.stat().st_mtime_ns) == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize("fault", FILE_FAULTS)
def test_a_wrong_file_is_refused_by_name_and_left_as_it_was(fault, tmp_path):
    changes, message = FILE_FAULTS[fault]
    path = tmp_path / "one.parquet"
    save_recording(Recording(**full_content()), path)
    rewrite(path, **changes)
    assert_load_fails_and_leaves_the_file(path, message)


@pytest.mark.parametrize("fault", DAMAGES)
def test_a_damaged_file_is_refused_by_name_and_left_as_it_was(fault, tmp_path):
    path = tmp_path / "one.parquet"
    save_recording(Recording(**full_content()), path)
    damage(path, fault)
    assert_load_fails_and_leaves_the_file(path, DAMAGES[fault])


def test_a_missing_file_and_a_folder_are_refused(tmp_path):
    with pytest.raises(RecordingError, match="there is no such recording"):
        load_recording(tmp_path / "one.parquet")
    with pytest.raises(RecordingError, match="is a folder, not a recording"):
        load_recording(tmp_path)
