"""MCAP files for viewers, read back by the package `mcap` and by the definitions in the file."""

from __future__ import annotations

import errno
import json
import os
import shutil
import struct
import subprocess
import time
from functools import partial
from types import SimpleNamespace

import numpy as np
import pinocchio_oracle as oracle
import pytest
from made_arms import prismatic_mass
from made_bundles import planar_arm_bundle, pushed, seven_axis_bundle, watching_bundle
from made_live import ScriptedSource, replay, samples_of
from made_results import run_command
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from tauext_lab.mcap import writer as mcap_writer
from tauext_lab.mcap.log import DRAWN_HZ, M_PER_N, Arm, McapLog, arrows_of
from tauext_lab.mcap.messages import Template, cdr, stamp
from tauext_lab.mcap.sink import McapSink
from tauext_lab.mcap.viewer_urdf import viewer_urdf

from tauext import _core
from tauext.data.importers import mcap_file
from tauext.data.importers.open_raw import open_raw
from tauext.data.recording_file import save_recording
from tauext.errors import ConfigError
from tauext.monitor.loop import Loop
from tauext.monitor.phases import Phase, Phases
from tauext.monitor.touch_place import PlaceFinder

ROWS, PUSH_S, PUSH_N = 1500, (0.8, 1.2), (60.0, 120.0, 0.0)
ALWAYS = {
    "/joint_states": "sensor_msgs/msg/JointState",
    "/tauext/tau_ext": "sensor_msgs/msg/JointState",
    "/tauext/declared": "sensor_msgs/msg/JointState",
    "/tauext/declared_size": "sensor_msgs/msg/JointState",
    "/tauext/band": "sensor_msgs/msg/JointState",
    "/tauext/limit": "sensor_msgs/msg/JointState",
    "/tauext/contact_limit": "sensor_msgs/msg/JointState",
    "/tauext/health": "std_msgs/msg/UInt8",
    "/tauext/alarm": "std_msgs/msg/UInt8",
    "/tauext/declared_state": "std_msgs/msg/UInt8",
    "/tauext/events": "rcl_interfaces/msg/Log",
}
WITH_MODEL = {
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/robot_description": "std_msgs/msg/String",
    "/tauext/wrench": "geometry_msgs/msg/WrenchStamped",
    "/tauext/touch": "geometry_msgs/msg/WrenchStamped",
    "/tauext/force": "visualization_msgs/msg/MarkerArray",
}


@pytest.fixture(scope="module")
def bundle() -> _core.Bundle:
    planar = planar_arm_bundle()
    planar.largest_torque_nm = [10.0, 10.0]  # its drives hold PUSH_N
    planar.answer_reference()
    return planar


def moving(bundle: _core.Bundle):
    """The planar arm in slow motion; for half a second the tool is pushed with PUSH_N."""
    t, tree, model = np.arange(ROWS) * 1e-3, _core.Tree(bundle.links, bundle.gravity), _core.WrenchModel(bundle)
    q = np.array([0.4, 0.9]) + 0.2 * np.sin(np.outer(t, [1.0, 1.7]))
    dq = 0.2 * np.array([1.0, 1.7]) * np.cos(np.outer(t, [1.0, 1.7]))
    momentum, beta = tree.momentum(q, dq)
    tau = np.gradient(momentum, 1e-3, axis=0) + beta
    for k in np.flatnonzero((t >= PUSH_S[0]) & (t < PUSH_S[1])):
        tau[k] -= np.array(PUSH_N) @ model.columns("tool", q[k].tolist())[:3]
    return pushed(pushes=(), q=q, dq=dq, tau=tau, t_ns=7_000_000_000 + np.arange(ROWS) * 1_000_000)


@pytest.fixture(scope="module")
def recording(bundle):
    return moving(bundle)


@pytest.fixture(scope="module")
def place(tmp_path_factory, bundle, recording):
    """A folder with the bundle, the recording, and what `tauext run --mcap` and `--json` made of them."""
    folder = tmp_path_factory.mktemp("mcap")
    bundle.save(str(folder / "planar.tauext"))
    save_recording(recording, folder / "moving.parquet")
    return folder


@pytest.fixture(scope="module")
def file(place, bundle, recording):
    path = place / "moving.mcap"
    write(path, bundle, recording, ROWS / 3000)
    return path


def write(
    path, bundle, recording, chunk_s: float = 1.0, acknowledge_after_s: float | None = None, phase: Phase | None = None
) -> None:
    """What `tauext run` does."""
    log, monitor = McapLog(path, bundle, recording.name), _core.Monitor(bundle)
    phases = None if phase is None else Phases({phase.name: phase})
    places = PlaceFinder(bundle)
    for chunk in replay(monitor, recording, None, acknowledge_after_s, chunk_s, (), places, phases):
        rows = slice(chunk.first_row, chunk.first_row + len(chunk.t_ns))
        log.add(chunk.t_ns, recording.q[rows], recording.dq[rows], recording.tau[rows], chunk.estimates, chunk.changes)
    log.close()


def messages_of(path, topic: str) -> list:
    """(log time, message) of a topic, decoded by the definition in the file alone."""
    found, store = [], get_typestore(Stores.EMPTY)
    with path.open("rb") as opened:
        for schema, channel, one in make_reader(opened, validate_crcs=True).iter_messages(topics=[topic]):
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            if schema.name not in store.fielddefs:
                store.register(get_types_from_msg(schema.data.decode(), schema.name))
            found.append((one.log_time, store.deserialize_cdr(one.data, schema.name)))
    return found


def ns_of(at) -> int:
    return at.sec * 1_000_000_000 + at.nanosec


def columns_of(path, topic: str, field: str) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and values of a JointState's array; stamp and log time agree."""
    found = messages_of(path, topic)
    assert all(ns_of(one.header.stamp) == t_ns for t_ns, one in found)
    assert all(one.name == ["shoulder", "elbow"] for _, one in found)
    return np.array([t_ns for t_ns, _ in found]), np.array([getattr(one, field) for _, one in found])


@pytest.fixture(scope="module")
def said(bundle, recording):
    return _core.Monitor(bundle).run(recording.t_ns, recording.q, recording.dq, recording.tau)


# --- Content.


def test_every_topic_has_its_type_and_definition(file):
    with file.open("rb") as opened:
        reader = make_reader(opened)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
    kinds = {one.topic: summary.schemas[one.schema_id].name for one in summary.channels.values()}
    assert kinds == ALWAYS | WITH_MODEL
    assert all(one.metadata["tauext"] for one in summary.channels.values())
    counts = summary.statistics.channel_message_counts
    read = {one.topic: len(messages_of(file, one.topic)) for one in summary.channels.values()}
    assert read == {one.topic: counts.get(number, 0) for number, one in summary.channels.items()}
    assert [topic for topic, count in read.items() if not count] == ["/tauext/declared_size"]  # no contact is declared


def test_samples_and_estimates_are_those_of_the_monitor(file, recording, said):
    for field, signal in (("position", "q"), ("velocity", "dq"), ("effort", "tau")):
        t_ns, values = columns_of(file, "/joint_states", field)
        np.testing.assert_array_equal(t_ns, recording.t_ns)
        np.testing.assert_array_equal(values, getattr(recording, signal))
    for topic, column, factor in (
        ("tau_ext", "tau_ext", 1),
        ("band", "contact_sigma_nm", 2),
        ("limit", "limit_nm", 1),
        ("contact_limit", "contact_limit_nm", 1),
    ):
        t_ns, values = columns_of(file, f"/tauext/{topic}", "effort")
        rows = np.searchsorted(recording.t_ns, t_ns)
        np.testing.assert_array_equal(values, (factor * said[column][rows]).astype(np.float32))
        seconds = ROWS / 1000
        assert len(rows) == ROWS if topic == "tau_ext" else seconds * DRAWN_HZ <= len(rows) <= seconds * DRAWN_HZ + 10


def test_health_and_alarm_have_a_message_where_they_change(file, recording, said):
    for name in ("health", "alarm"):
        found = messages_of(file, f"/tauext/{name}")
        rows = np.searchsorted(recording.t_ns, [t_ns for t_ns, _ in found])
        assert [one.data for _, one in found] == said[name][rows].tolist()
        changed = np.flatnonzero(np.diff(said[name])) + 1
        assert len(changed) and set(changed.tolist()) <= set(rows.tolist())


def test_events_have_the_words_of_the_text_output(file, place, capsys):
    code, out, _ = run_command(capsys, "run", place / "planar.tauext", place / "moving.parquet")
    printed = [line.split(" s  ", 1) for line in out.splitlines() if " s  " in line[:20]]
    found = messages_of(file, "/tauext/events")
    assert code == 0
    assert [one.msg for _, one in found] == [words for _, words in printed]
    assert [f"{(t_ns - 7_000_000_000) * 1e-9:.3f}" for t_ns, _ in found] == [when.strip() for when, _ in printed]
    levels = {one.msg.split()[0]: one.level for _, one in found}
    assert (levels["ok"], levels["CONTACT"], levels["COLLISION"], levels["the"]) == (20, 30, 40, 20)


def test_transforms_and_urdf_place_the_frames_where_the_model_has_them(file, bundle, recording):
    """Also those of a seven-axis arm, by Pinocchio's reading of the URDF."""
    model = _core.WrenchModel(bundle)
    (_, static), *_ = messages_of(file, "/tf_static")
    fixed = {one.child_frame_id: one for one in static.transforms}
    assert list(fixed) == ["tool"]
    links = [one for _, one in messages_of(file, "/tf") if one.transforms[0].child_frame_id != "touch"]
    assert len(links) >= ROWS / 1000 * DRAWN_HZ
    for one in links[::9]:
        known = {part.child_frame_id: part for part in one.transforms} | fixed
        row = int(np.searchsorted(recording.t_ns, ns_of(one.transforms[0].header.stamp)))
        for frame in ("shoulder", "elbow", "tool"):
            turn, point = model.pose(frame, recording.q[row].tolist())
            found = in_base(known, frame)
            np.testing.assert_allclose(found[:3, :3], turn, atol=1e-9)
            np.testing.assert_allclose(found[:3, 3], point, atol=1e-9)
    arm = seven_axis_bundle([0.1] * 7, _core.Capsule(6, [0, 0, 0], [0.01, 0.02, 0.1], 0.04))
    pin, read = oracle.pin, oracle.read_model(Arm(arm).urdf)
    names, model = [link.joint_name for link in arm.links], _core.WrenchModel(arm)
    for q in np.random.default_rng(2).uniform(-2, 2, (3, 7)):
        data = read.createData()
        pin.framesForwardKinematics(read, data, oracle.configurations(read, q[None], names)[0])
        for name in names:
            turn, point = model.pose(name, q.tolist())
            found = data.oMf[read.getFrameId(name, pin.FrameType.BODY)]
            np.testing.assert_allclose(found.rotation, turn, atol=1e-7)
            np.testing.assert_allclose(found.translation, point, atol=1e-7)


def in_base(transforms: dict, frame: str) -> np.ndarray:
    """Pose of a frame, (4, 4), along its parents."""
    pose = np.eye(4)
    while frame in transforms:
        one = transforms[frame].transform
        x, y, z, w = (getattr(one.rotation, name) for name in "xyzw")
        step = np.eye(4)
        step[:3, :3] = oracle.pin.Quaternion(w, x, y, z).toRotationMatrix()
        step[:3, 3] = [getattr(one.translation, name) for name in "xyz"]
        pose, frame = step @ pose, transforms[frame].header.frame_id
    assert frame == "base"
    return pose


def test_the_wrench_explains_the_torques_and_its_arrow_points_along_it(file, bundle, recording, said):
    model = _core.WrenchModel(bundle)
    found = {t_ns: one for t_ns, one in messages_of(file, "/tauext/wrench")}
    row = int(np.nanargmax(said["tau_ext"][:, 0]))
    assert 800 < row <= 1250
    at = found[int(recording.t_ns[row])]
    assert at.header.frame_id == "tool"
    wrench = [getattr(part, axis) for part in (at.wrench.force, at.wrench.torque) for axis in "xyz"]
    axes = model.columns("tool", recording.q[row].tolist(), axes=_core.WrenchAxes.frame)
    np.testing.assert_allclose(np.array(wrench) @ axes, said["tau_ext"][row], rtol=0.02)
    pushed_on = np.array(PUSH_N) @ model.columns("tool", recording.q[row].tolist())[:3]
    np.testing.assert_allclose(said["tau_ext"][row], pushed_on, rtol=0.1)  # positive: on the arm
    arrows = messages_of(file, "/tauext/force")
    assert all([marker.ns for marker in one.markers] == ["force", "touch"] for _, one in arrows)
    assert {one.markers[0].action for _, one in arrows} == {0, 2}  # none while the monitor warms up
    for t_ns, one in arrows:
        assert (one.markers[0].action == 0) == (t_ns in found)
        if t_ns in found:
            expect_arrow(one.markers[0], "tool", [getattr(found[t_ns].wrench.force, axis) for axis in "xyz"])


def expect_arrow(marker, frame: str, force: list[float]) -> None:
    """From the tail, length along its x to the frame's origin."""
    assert marker.header.frame_id == frame and (marker.type, marker.color.a) == (0, 1.0)
    tail = np.array([getattr(marker.pose.position, axis) for axis in "xyz"])
    turn = oracle.pin.Quaternion(*(getattr(marker.pose.orientation, name) for name in "wxyz")).toRotationMatrix()
    np.testing.assert_allclose(-tail, M_PER_N * np.array(force), rtol=1e-9)
    if np.linalg.norm(force) > 0.05:  # shorter ones have the least length
        np.testing.assert_allclose(tail + marker.scale.x * turn[:, 0], 0, atol=1e-9)


@pytest.mark.parametrize("force", [[1, 2, 3], [50, 0, 0], [-50, 0, 0], [-50, 1e-9, 0]], ids=str)
def test_an_arrow_ends_at_its_frame_whatever_its_direction(force):
    tail, turn, length = np.split(arrows_of(np.array([force], float), np.zeros(3))[0], [3, 7])
    x, y, z, w = turn
    ahead = oracle.pin.Quaternion(w, x, y, z).toRotationMatrix()[:, 0]
    np.testing.assert_allclose(tail + length * ahead, 0, atol=1e-8)


def test_the_touch_is_where_the_event_has_it(file, place, capsys):
    _, out, _ = run_command(capsys, "run", place / "planar.tauext", place / "moving.parquet", "--json")
    events = [line for line in map(json.loads, out.splitlines()) if line["event"] == "place"]
    found = messages_of(file, "/tauext/touch")
    assert found and [t_ns for t_ns, _ in found] == [one["t_ns"] for one in events]
    frames = {
        t: one.transforms[0] for t, one in messages_of(file, "/tf") if one.transforms[0].child_frame_id == "touch"
    }
    for event, (t_ns, one) in zip(events, found, strict=True):
        best = event["places"][0]
        assert one.header.frame_id == "touch" and frames[t_ns].header.frame_id == "base"
        assert [getattr(one.wrench.force, axis) for axis in "xyz"] == best["force_n"]
        assert [getattr(frames[t_ns].transform.translation, axis) for axis in "xyz"] == best["point_m"]
    shown = [(t_ns, one.markers[1]) for t_ns, one in messages_of(file, "/tauext/force")]
    for t_ns, marker in shown:
        last = [event for event in events if event["t_ns"] <= t_ns]
        assert (marker.action == 0) == bool(last)  # the alarm stands to the end
        if last:
            expect_arrow(marker, "touch", last[-1]["places"][0]["force_n"])


def test_the_arrow_of_a_touch_ends_with_its_alarm(tmp_path, bundle, recording):
    path = tmp_path / "ended.mcap"
    write(path, bundle, recording, 0.3, acknowledge_after_s=0.2)
    actions = [one.markers[1].action for _, one in messages_of(path, "/tauext/force")]
    assert actions[0] == actions[-1] == 2 and 0 in actions


@pytest.mark.parametrize("axes", ["base", "frame"])
def test_what_a_declared_contact_explains_is_in_the_file(tmp_path, bundle, recording, axes):
    """The push is along the declared line, at a point beside the tool's origin; tool_force() is the reference."""
    path, row = tmp_path / "declared.mcap", 990
    turn = _core.WrenchModel(bundle).pose("tool", recording.q[row].tolist())[0]
    axis = np.array(PUSH_N) if axes == "base" else np.array(PUSH_N) @ turn
    bounds = {"axes": axes, "axis": tuple(axis.tolist()), "at_most_n": 150.0, "during": ((0.0, PUSH_S[1]),)}
    phase = Phase(frame="tool", point=(0.0, 0.0, 0.02), **bounds, name="pressing")
    write(path, bundle, recording, phase=phase)
    assert {one.data for _, one in messages_of(path, "/tauext/alarm")} == {0}
    sizes = dict(messages_of(path, "/tauext/declared_size"))
    assert all(one.name == ["size", "band", "moment"] for one in sizes.values())
    known, after = (np.array(list(sizes)) - 7_000_000_000)[[0, -1]] * 1e-9
    assert known == 0.5 and PUSH_S[1] < after < ROWS / 1000  # from the first torque on, and while r contains it
    at = int(recording.t_ns[row])
    size, band, moment = sizes[at].effort
    assert size == pytest.approx(np.linalg.norm(PUSH_N), rel=0.1) and 0 < band < 30 and moment == 0
    t_ns, explained = columns_of(path, "/tauext/declared", "effort")
    assert set(sizes) <= set(t_ns.tolist())
    _, tau_ext = columns_of(path, "/tauext/tau_ext", "effort")
    np.testing.assert_allclose(explained[t_ns == at][0], tau_ext[row], atol=0.5)
    states = dict(messages_of(path, "/tauext/declared_state"))
    assert {one.data for one in states.values()} == {0, 1}
    assert all((one.data == 1) == (when in sizes) for when, one in states.items())
    assert any(
        one.msg == "pressing: contact at tool of at most 150 N" for _, one in messages_of(path, "/tauext/events")
    )
    monitor = _core.Monitor(bundle)
    monitor.expect_contact(phase.contact, PUSH_S[1])
    monitor.run(*(signal[: row + 1] for signal in (recording.t_ns, recording.q, recording.dq, recording.tau)))
    wanted = monitor.tool_force(_core.WrenchAxes.frame).wrench
    wrench = dict(messages_of(path, "/tauext/wrench"))[at]
    assert wrench.header.frame_id == wanted.frame == "tool"
    force, torque = ([getattr(part, way) for way in "xyz"] for part in (wrench.wrench.force, wrench.wrench.torque))
    np.testing.assert_allclose(force, wanted.force, atol=0.5)
    np.testing.assert_allclose(torque, np.cross([0.0, 0.0, 0.02], force), atol=1e-5)
    arrow = next(one.markers[0] for when, one in messages_of(path, "/tauext/force") if when >= at - 40_000_000)
    assert arrow.pose.position.z == pytest.approx(0.02, abs=1e-6)  # it ends at the point


def test_a_bundle_without_a_model_has_no_arm_and_no_force(tmp_path, capsys):
    watching_bundle(network=False).save(str(tmp_path / "a.tauext"))
    save_recording(pushed(seconds=1.0, pushes=()), tmp_path / "r.parquet")
    path = tmp_path / "new" / "r.mcap"
    code, out, _ = run_command(capsys, "run", tmp_path / "a.tauext", tmp_path / "r.parquet", "--mcap", path)
    assert code == 0 and "r.mcap: no arm, transforms and forces: the bundle has no model of the arm" in out
    assert f"{path}: 1,000 samples" in out
    with path.open("rb") as opened:
        topics = {one.topic for one in make_reader(opened).get_summary().channels.values()}
    assert topics == ALWAYS.keys() - {"/tauext/band"}  # nor an error scale


def test_a_force_is_at_the_frame_of_the_option(place, capsys):
    path = place / "at-elbow.mcap"
    files = (place / "planar.tauext", place / "moving.parquet")
    assert run_command(capsys, "run", *files, "--mcap", path, "--wrench", "elbow")[0] == 0
    assert {one.header.frame_id for _, one in messages_of(path, "/tauext/wrench")} == {"elbow"}


def test_the_urdf_draws_capsules_or_bars():
    arm = seven_axis_bundle([0.1] * 7, _core.Capsule(6, [0, 0, 0], [0, 0, 0], 0.04))
    drawn = viewer_urdf(arm.links, arm.capsules, [], "base")
    long = sum(np.linalg.norm(link.translation) > 0 for link in arm.links)
    assert 4 <= long < 7
    assert drawn.count("<cylinder") == long  # the first one from the base, which has no capsule
    assert drawn.count("<sphere") == 2 * long + (7 - long) + 1
    tip = _core.WrenchFrame("tip", 6, translation=[0, 0, 0.1])
    assert viewer_urdf(arm.links, [], [tip], "base").count("<cylinder") == long + 1
    slide = viewer_urdf(prismatic_mass(1.0).links, [], [], "base")
    assert 'type="prismatic"' in slide and oracle.read_model(slide).nq == 1


def test_messages_of_a_template_are_those_of_rosbags():
    make = partial(lambda at, x: {"header": {"stamp": at, "frame_id": "f"}, "name": ["a", "bc"], "effort": x})
    kind, rng = "sensor_msgs/msg/JointState", np.random.default_rng(1)
    t_ns, values = np.array([0, 1_999_999_999, 2**31 * 10**9 - 1]), rng.normal(0, 5, (3, 2))
    for row, raw in enumerate(Template(kind, 2, make).fill(t_ns, values)):
        assert raw.tobytes() == cdr(kind, make(stamp(int(t_ns[row])), values[row].tolist()))


# --- Live.


def live(path, bundle, script) -> McapSink:
    sink = McapSink(path, bundle, "script")
    Loop(bundle, ScriptedSource(script), [sink]).run()
    return sink


def test_a_live_arm_s_file_is_that_of_a_replay(tmp_path, bundle, recording, file):
    sink = live(tmp_path / "live.mcap", bundle, samples_of(recording))
    assert (sink.samples, sink.lost, sink.error) == (ROWS, 0, "")
    for topic in ALWAYS | WITH_MODEL:
        if topic != "/tauext/events":  # a busy computer may add a late sample
            assert bytes_of(tmp_path / "live.mcap", topic) == bytes_of(file, topic), topic


def bytes_of(path, topic: str) -> list[bytes]:
    with path.open("rb") as opened:
        return [one.data for _, _, one in make_reader(opened).iter_messages(topics=[topic])]


def test_a_killed_process_leaves_a_file_that_is_read(tmp_path, bundle, recording):
    """The file as it is after a second, before close()."""
    path, kept = tmp_path / "killed.mcap", tmp_path / "copy.mcap"
    sink = McapSink(path, bundle, "script")

    def copy() -> bool:
        for _ in range(1000):
            if sink.samples >= 500:
                break
            time.sleep(0.002)
        shutil.copy(path, kept)
        return True

    everything = samples_of(recording)
    Loop(bundle, ScriptedSource([*everything[:1000], copy]), [sink]).run()
    counts = count_streamed(kept)
    assert 500 <= counts["/joint_states"] <= 1000 and counts["/robot_description"] == 1
    raw = open_raw(kept, ["/joint_states"])[0]
    assert rows_of(raw) == counts["/joint_states"] and "not closed" in " ".join(raw.notes)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_a_file_that_is_cut_off_is_read_to_its_last_whole_chunk(tmp_path, file, share):
    whole = file.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: int(share * len(whole))])
    with file.open("rb") as opened:
        chunks = make_reader(opened).get_summary().chunk_indexes
    ends = [one.chunk_start_offset + one.chunk_length for one in chunks]
    read = count_streamed(cut)["/joint_states"]
    assert read == sum(ROWS // 3 for end in ends if end <= cut.stat().st_size)
    assert rows_of(open_raw(cut, ["/joint_states"])[0]) >= read


def count_streamed(path) -> dict[str, int]:
    """Messages by topic, of a file whose end may be missing."""
    counts, topics = {}, {}
    with path.open("rb") as opened:
        try:
            for record in StreamReader(opened).records:
                if isinstance(record, Message):
                    topic = topics[record.channel_id]
                    counts[topic] = counts.get(topic, 0) + 1
                elif hasattr(record, "topic"):
                    topics[record.id] = record.topic
        except (EndOfFile, struct.error):
            pass
    return counts


def rows_of(raw) -> int:
    return sum(len(block.columns) for block in raw.blocks())


def test_a_disk_that_is_full_for_a_while_loses_samples_and_no_file(tmp_path, bundle, recording, monkeypatch):
    chunks, real = [0], os.write

    def half_full(file: int, content) -> int:
        chunks[0] += content[0] == mcap_file.CHUNK
        if chunks[0] != 2:
            return real(file, content)
        if content[0] == mcap_file.CHUNK:
            return real(file, content[: len(content) // 2])  # the rest does not fit
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(mcap_writer, "os", SimpleNamespace(**(vars(os) | {"write": half_full})))
    sink = live(tmp_path / "full.mcap", bundle, samples_of(recording))
    assert 0 < sink.lost < ROWS and sink.samples == ROWS - sink.lost and "No space left" in sink.error
    t_ns, _ = columns_of(tmp_path / "full.mcap", "/joint_states", "position")
    assert len(t_ns) == sink.samples and set(t_ns.tolist()) <= set(recording.t_ns.tolist())


def test_the_monitor_writes_a_file_and_fails_where_samples_are_lost(place, capsys, monkeypatch):
    command = ("monitor", place / "planar.tauext", "--source", f"replay:{place / 'moving.parquet'}", "--speed", "30")
    code, out, _ = run_command(capsys, *command, "--mcap", place / "live.mcap")
    assert code == 0 and f"live.mcap: {ROWS:,} samples" in out

    def broken(log, *content) -> None:
        raise ValueError("a fault of the writer")

    monkeypatch.setattr(McapLog, "add", broken)
    code, out, err = run_command(capsys, *command, "--mcap", place / "full.mcap")
    assert code == 2 and f"{ROWS} of {ROWS} samples of the MCAP file are lost: a fault of the writer" in err
    assert not (place / "full.mcap").exists()  # without a sample


# --- Wrong input.


@pytest.mark.parametrize(
    ("name", "more", "words"),
    [
        ("there.mcap", (), "there.mcap: exists already; choose another name, or remove it"),
        ("folder.mcap", (), "folder.mcap: is a folder"),
        ("log.bag", (), "log.bag: the name of an MCAP file ends in .mcap"),
        ("planar.tauext/a.mcap", (), "planar.tauext is no folder"),
        ("a.mcap", ("moving.parquet",), "must be left out, or given with one recording"),
        ("a.mcap", ("--wrench", "nose"), "'nose' must be one of shoulder, elbow, tool"),
    ],
    ids=["exists", "folder", "suffix", "below a file", "two recordings", "frame"],
)
def test_a_file_that_cannot_be_made_is_refused_before_the_replay(place, capsys, monkeypatch, name, more, words):
    monkeypatch.chdir(place)
    (place / "there.mcap").touch()
    (place / "folder.mcap").mkdir(exist_ok=True)
    code, out, err = run_command(capsys, "run", "planar.tauext", "moving.parquet", *more, "--mcap", name)
    assert (code, out) == (2, "") and words in err and len(err.splitlines()) == 1
    if not more or more[0] == "--wrench":
        source = ("--source", "replay:moving.parquet")
        code, out, err = run_command(capsys, "monitor", "planar.tauext", *source, *more, "--mcap", name)
        assert (code, out) == (2, "") and words in err
    assert not (place / "a.mcap").exists()


def test_stamps_that_are_no_time_of_ros_are_refused(tmp_path, bundle, recording):
    early = pushed(
        pushes=(),
        t_ns=recording.t_ns[:500] - 8_000_000_000,
        q=recording.q[:500],
        dq=recording.dq[:500],
        tau=recording.tau[:500],
    )
    with pytest.raises(ConfigError, match="stamps must be 0 to"):
        write(tmp_path / "early.mcap", bundle, early)


# --- Viewers.


@pytest.mark.skipif(shutil.which("rerun") is None, reason="rerun-sdk is not installed")
def test_rerun_reads_joints_by_name_transforms_and_arm(tmp_path, file):
    made = tmp_path / "file.rrd"
    subprocess.run(["rerun", "mcap", "convert", file, "-o", made], check=True, capture_output=True)
    shown = subprocess.run(["rerun", "rrd", "print", made], check=True, capture_output=True, text=True).stdout
    for words in (
        "/tauext/tau_ext/effort - data columns: [Scalars:scalars SeriesLines:names]",
        "/joint_states/position - data columns: [Scalars:scalars SeriesLines:names]",
        "/visual_geometries/elbow/visual_0 - data columns: [Ellipsoids3D",
        "/tf - data columns: [Transform3D",
        "/tauext/events - data columns: [file function line TextLog",
    ):
        assert words in shown
