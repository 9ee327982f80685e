"""The whole chain over DDS: a robot's joint states in, torques and alarms at a peer, against the monitor offline."""

import threading

import numpy as np
import pytest
from made_bundles import pushed, watching_bundle
from made_ros2 import DOMAIN, Robot, until

pytest.importorskip("cyclonedds")

from tauext import _core
from tauext.cli import main
from tauext.errors import ConfigError
from tauext.monitor.loop import Loop, LoopSettings
from tauext.sources.ros2 import connect
from tauext.sources.ros2_messages import Bool, DiagnosticArray, JointState
from tauext.sources.ros2_node import Node
from tauext.sources.ros2_settings import Ros2Settings
from tauext.sources.ros2_source import LEARNT_FROM

SPACE, TOPIC, DEPTH = "/whole", "/whole/joint_states", 8000


def test_torques_equal_the_monitor_offline_bit_for_bit_and_alarms_are_told():
    bundle, made = watching_bundle(), pushed(seconds=4.0)
    settings = Ros2Settings(topic=TOPIC, namespace=SPACE, domain=DOMAIN, depth=DEPTH)
    source, publisher = connect(settings)
    # Samples come as fast as they can be sent, so none of them is late.
    notes: list[str] = []
    loop = Loop(bundle, source, [publisher], settings=LoopSettings(missing_after_s=60.0))
    loop.note = notes.append
    running = threading.Thread(target=loop.run)
    running.start()
    try:
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
    finally:
        loop.stop("test")
        running.join()
    rows = slice(LEARNT_FROM - 1, None)
    said = _core.Monitor(bundle).run(made.t_ns[rows], made.q[rows], made.dq[rows], made.tau[rows])
    messages = [m for m in torques.take(DEPTH) if m.sample_info.valid_data][:-1]
    assert [m.header.stamp.ns for m in messages] == made.t_ns[rows].tolist()
    np.testing.assert_array_equal([m.effort for m in messages], said["tau_ext"])
    assert (said["alarm"] == 2).any() and np.isnan(said["tau_ext"][0]).all()
    assert [m.data for m in alarms.take(8) if m.sample_info.valid_data] == [False, True, False]
    levels = [m.status[0].message for m in diagnostics.take(100) if m.sample_info.valid_data]
    assert "collision on shoulder" in levels


def test_the_command_refuses_what_cannot_be(tmp_path, capsys):
    bundle = tmp_path / "arm.tauext"
    watching_bundle().save(str(bundle))
    for words, message in (
        (["--ros2.topic", "joint_states"], "ROS 2 topic 'joint_states' must begin with /"),
        (["--ros2.names", "a"], "ROS 2 names a: 1 for the bundle's 2 joints shoulder, elbow"),
    ):
        assert main(["monitor", str(bundle), "--source", "ros2", "--ros2.domain", str(DOMAIN), *words]) == 2
        assert message in capsys.readouterr().err
    assert main(["monitor", str(bundle), "--source", "ros2:/x"]) == 2
    assert "must be one of" in capsys.readouterr().err
    assert main(["monitor", str(bundle), "--source", "replay:x", "--ros2.depth", "1"]) == 2
    assert "--ros2 is for source ros2, not for replay" in capsys.readouterr().err


def test_a_missing_library_names_the_extra(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "cyclonedds.core", None)
    monkeypatch.delitem(__import__("sys").modules, "tauext.sources.ros2_node")
    with pytest.raises(ConfigError, match=r"ROS 2 needs CycloneDDS \(.*\): pip install 'tauext\[ros2\]'"):
        connect(Ros2Settings())
