"""The whole chain over DDS: a robot's joint states in, torques and alarms at a peer, against the monitor offline.

docs/quickstarts/ros2.md: its quickstart as printed, on a synthetic bag and a synthetic driver.
"""

import os
import signal
import threading
import time
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from doc_pages import Page
from made_arms import planar_rig, urdf
from made_bundles import pushed, watching_bundle
from made_live import Keeper
from made_recordings import Drive, made_motion, write_bag
from made_ros2 import DOMAIN, Robot, running, until
from test_live_properties import at_each_end, expect_clean, swinging, turning_bundle

pytest.importorskip("cyclonedds")

from tauext_ros2 import connect
from tauext_ros2.messages import Bool, DiagnosticArray, Inertia, JointState, String, Vector3
from tauext_ros2.node import Node
from tauext_ros2.samples import LEARNT_FROM
from tauext_ros2.settings import Ros2Settings

from tauext import _core
from tauext.cli import main
from tauext.errors import ConfigError
from tauext.monitor.loop import Loop, LoopSettings
from tauext.robot.read import load_tree

SPACE, TOPIC, DEPTH = "/whole", "/whole/joint_states", 8000


def test_torques_equal_the_monitor_offline_bit_for_bit_and_alarms_are_reported():
    bundle, made = watching_bundle(), pushed(seconds=4.0)
    settings = Ros2Settings(topic=TOPIC, namespace=SPACE, domain=DOMAIN, depth=DEPTH)
    source, publisher = connect(settings)
    # Samples come as fast as they can be sent, so none of them is late.
    notes: list[str] = []
    loop = Loop(bundle, source, [publisher], settings=LoopSettings(missing_after_s=60.0))
    loop.note = notes.append
    with running(loop):
        peer = Node(Ros2Settings(domain=DOMAIN, node="peer"))
        torques = peer.inbox(f"{SPACE}/external_torque", JointState, "reliable", "volatile", DEPTH).reader
        alarms = peer.inbox(f"{SPACE}/collision", Bool, "reliable", "transient-local", 8).reader
        diagnostics = peer.inbox(f"{SPACE}/diagnostics", DiagnosticArray, "reliable", "volatile", 100).reader
        acknowledge = peer.writer(f"{SPACE}/acknowledge", Bool, "reliable", "volatile", 8)
        robot = Robot(settings, joints=("hand", "elbow", "shoulder"))
        robot.meets()
        until(lambda: torques.get_matched_publications() and acknowledge.get_matched_subscriptions(), "the monitor")
        for k in range(made.samples):
            signals = {"position": made.q, "velocity": made.dq, "effort": made.tau}
            values = {field: [0.0, *signal[k, ::-1].tolist()] for field, signal in signals.items()}
            robot.send(stamp_ns=int(made.t_ns[k]), **values)
        given = made.samples - (LEARNT_FROM - 1)
        until(lambda: loop.samples == given, "all samples")
        acknowledge.write(Bool(True))
        until(lambda: "acknowledged by ros2 /whole/acknowledge" in notes, "the acknowledgement")
        # The alarm falls with the next sample.
        robot.send(stamp_ns=int(made.t_ns[-1]) + 1_000_000, **values)
        until(lambda: loop.samples == given + 1, "the last sample")
    rows = slice(LEARNT_FROM - 1, None)
    said = _core.Monitor(bundle).run(made.t_ns[rows], made.q[rows], made.dq[rows], made.tau[rows])
    messages = [m for m in torques.take(DEPTH) if m.sample_info.valid_data][:-1]
    assert [m.header.stamp.ns for m in messages] == made.t_ns[rows].tolist()
    np.testing.assert_array_equal([m.effort for m in messages], said["tau_ext"])
    assert (said["alarm"] == 2).any() and np.isnan(said["tau_ext"][0]).all()
    assert [m.data for m in alarms.take(8) if m.sample_info.valid_data] == [False, True, False]
    levels = [m.status[0].message for m in diagnostics.take(100) if m.sample_info.valid_data]
    assert "collision on shoulder" in levels


def test_positions_that_wrap_are_unwrapped():
    bundle, clean = turning_bundle(), swinging()
    wrapped = at_each_end(clean.q)
    settings = Ros2Settings(topic="/turns/joint_states", namespace="/turns", domain=DOMAIN, depth=8000)
    keeper = Keeper()
    loop = Loop(bundle, connect(settings)[0], [keeper], settings=LoopSettings(missing_after_s=60.0))
    with running(loop):
        robot = Robot(settings, joints=clean.joints)
        robot.meets()
        for k in range(clean.samples):
            values = {"position": wrapped[k], "velocity": clean.dq[k], "effort": clean.tau[k]}
            robot.send(stamp_ns=int(clean.t_ns[k]), **{field: value.tolist() for field, value in values.items()})
        until(lambda: loop.samples and keeper.verdicts[-1].t_ns == clean.t_ns[-1], "all samples")
    expect_clean(bundle, keeper, clean)


def test_the_command_refuses_what_cannot_be(tmp_path, capsys):
    bundle = tmp_path / "arm.tauext"
    watching_bundle().save(str(bundle))
    names = f"ros2 --ros2.domain {DOMAIN} --ros2.names a"
    for words, message in (
        ("ros2 --ros2.topic joint_states", "ROS 2 topic 'joint_states' must begin with /"),
        (names, "ROS 2 names a: 1 for the bundle's 2 joints shoulder, elbow"),
        ("ros2:/x", "must be one of"),
        ("replay:x --ros2.depth 1", "--ros2 is for source ros2, not for replay"),
    ):
        assert main(["monitor", str(bundle), "--source", *words.split()]) == 2
        assert message in capsys.readouterr().err


def test_a_missing_library_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "cyclonedds.core", None)
    monkeypatch.delitem(__import__("sys").modules, "tauext_ros2.node")
    with pytest.raises(ConfigError, match=r"ROS 2 needs CycloneDDS \(.*\): pip install cyclonedds"):
        connect(Ros2Settings())


PAGE = "quickstarts/ros2.md"
TYPES = {"std_msgs/msg/Bool": Bool, "std_msgs/msg/String": String, "geometry_msgs/msg/Inertia": Inertia}


class Driver(threading.Thread):
    """Publishes a recording at its rate, over and over; `push_nm` is added to the first joint's effort."""

    def __init__(self, recording):
        super().__init__(daemon=True)
        self.recording, self.push_nm, self.stopped = recording, 0.0, threading.Event()

    def run(self):
        made = self.recording
        robot = Robot(Ros2Settings(domain=DOMAIN, node="driver"), joints=made.joints, step_ns=10_000_000)
        begin, sent = time.monotonic(), 0
        way = [*range(made.samples), *range(made.samples - 2, 0, -1)]
        while not self.stopped.wait(max(0.0, begin + 0.01 * sent - time.monotonic())):
            k = way[sent % len(way)]
            back = sent % len(way) >= made.samples
            effort = made.tau[k].copy()
            effort[0] += self.push_nm
            dq = -made.dq[k] if back else made.dq[k]
            robot.send(position=made.q[k].tolist(), velocity=dq.tolist(), effort=effort.tolist())
            sent += 1


def message_of(name: str, text: str):
    """A message from the YAML of `ros2 topic pub`."""
    from ruamel.yaml import YAML

    of, values = TYPES[name], YAML(typ="safe").load(text)
    assert set(values) <= {field.name for field in fields(of)}
    return of(**{key: Vector3(**value) if isinstance(value, dict) else value for key, value in values.items()})


def used_as_printed(driver: Driver, done: list[str]) -> None:
    """What the page has a person do beside the running monitor: push the arm, read the topics, resume, set a load."""
    page, peer = Page(PAGE), Node(Ros2Settings(domain=DOMAIN, node="person"))
    echoed = [topic for verb, topic in (words[:2] for words in page.commands("ros2 topic")) if verb == "echo"]
    assert echoed == ["/tauext/collision", "/tauext/external_torque"]
    collision = peer.inbox(echoed[0], Bool, "reliable", "transient-local", 8).reader
    torque = peer.inbox(echoed[1], JointState, "reliable", "volatile", 8).reader

    def came(value: bool):
        return any(m.data is value for m in collision.take(8) if m.sample_info.valid_data)

    until(lambda: came(False), "the monitor")
    until(lambda: any(m.sample_info.valid_data and np.isfinite(m.effort).all() for m in torque.take(8)), "an estimate")
    driver.push_nm = 60.0
    until(lambda: came(True), "a collision")
    driver.push_nm = 0.0
    time.sleep(0.3)
    for verb, once, topic, name, text in (words for words in page.commands("ros2 topic") if words[0] == "pub"):
        assert (verb, once) == ("pub", "--once")
        writer = peer.writer(topic, TYPES[name], "reliable", "volatile", 8)
        until(writer.get_matched_subscriptions, f"a subscriber of {topic}")
        writer.write(message_of(name, text))
        done.append(topic)
        if topic == "/tauext/resume":
            until(lambda: came(False), "the end of the collision")
    time.sleep(0.3)


@pytest.mark.slow
def test_the_quickstart_runs_as_printed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(DOMAIN))
    Path("robot.urdf").write_text(urdf(planar_rig()))
    made = made_motion(load_tree(Path("robot.urdf")), 2.0, pieces=1, drive=Drive(presliding_rad=0.02)).recordings[0]
    signals = zip((10**18 + made.t_ns).tolist(), made.q, made.dq, made.tau, strict=True)
    rows = [(stamp_ns + 2_000_000, stamp_ns, made.joints, *row) for stamp_ns, *row in signals]
    write_bag(Path("free"), "mcap", {"/joint_states": rows})
    driver, done, failed = Driver(made), [], []

    def beside() -> None:
        try:
            driver.start()
            used_as_printed(driver, done)
        except BaseException as error:  # it fails the test, in the main thread
            failed.append(error)
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    commands = Page(PAGE, "Quickstart").commands()
    assert [words[0] for words in commands] == ["import", "import", "check", "train", "run", "monitor"]
    for command in commands:
        live = command[0] == "monitor"
        person = threading.Thread(target=beside)
        if live:
            person.start()
        assert main(command) == 0, command
        if live:
            person.join()
            driver.stopped.set()
            driver.join()
    if failed:
        raise failed[0]
    assert done == [f"/tauext/{name}" for name in ("resume", "load", "load", "declare_contact", "declare_contact")]
    shown = capsys.readouterr().out
    for text in (
        "0 faults",
        "COLLISION shoulder",
        "resumed by ros2 /tauext/resume",
        "carries 2.8 kg",
        "0 expected contacts ended",
    ):
        assert text in shown
