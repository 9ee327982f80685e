"""The monitor against Fast DDS, both ways: another implementation of the wire, with types written down apart."""

import json
import os
import shutil
import subprocess
import threading
from pathlib import Path

import numpy as np
import pytest
from made_bundles import JOINTS, watching_bundle
from made_ros2 import DOMAIN

pytest.importorskip("cyclonedds")

from tauext_ros2 import connect
from tauext_ros2.settings import Ros2Settings

from tauext import _core
from tauext.monitor.cell_file import load_cell
from tauext.monitor.loop import Loop, LoopSettings
from tauext.monitor.sink import ReactionEvent

SOURCE = Path(__file__).parent / "interop" / "fastdds_peer.cpp"
SPACE, TOPIC, SAMPLES = "/fast", "/fast_states", 4000
PROFILES = """
profiles = { lowest = 0.5, highest = 3.0, plain = {}, careful = { collision = 1.5, contact = 1.5 } }
"""


@pytest.fixture(scope="module")
def peer(tmp_path_factory):
    """The compiled program."""
    if shutil.which("g++") is None or not Path("/usr/include/fastrtps").is_dir():
        pytest.skip("needs g++ and the Debian packages libfastrtps-dev, libfastcdr-dev")
    program = tmp_path_factory.mktemp("fastdds") / "fastdds_peer"
    words = ["g++", "-std=c++20", "-O1", "-Wall", "-Wextra", str(SOURCE), "-o", str(program), "-lfastrtps", "-lfastcdr"]
    subprocess.run(words, check=True)
    return program


@pytest.fixture(scope="module")
def run(peer, tmp_path_factory):
    """What the peer got, and what the loop counted and noted, of four seconds at 1 kHz."""
    folder = tmp_path_factory.mktemp("run")
    (folder / "cell.toml").write_text(PROFILES)
    bundle = watching_bundle()
    settings = Ros2Settings(topic=TOPIC, namespace=SPACE, domain=DOMAIN, reliability="reliable", depth=1000)
    source, publisher = connect(settings)
    notes, switches = [], []
    loop = Loop(
        bundle,
        source,
        [publisher],
        profiles=load_cell(folder / "cell.toml", JOINTS).profiles,
        settings=LoopSettings(missing_after_s=2.0),  # of a test on a busy machine nothing is late
    )
    loop.note, loop.switched = notes.append, switches.append
    running = threading.Thread(target=loop.run)
    running.start()
    words = [str(peer), str(DOMAIN), SPACE, TOPIC, str(SAMPLES)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=os.environ) as process:
        threading.Timer(
            3.0, publisher.publish_event, [ReactionEvent("contact", "elbow", 1, 2, {"text": 'quoted " ü'})]
        ).start()
        printed = process.communicate(timeout=60)[0]
    loop.stop("test")
    running.join()
    assert process.returncode == 0
    return json.loads(printed), loop, source.counts, notes, switches


def states():
    """As the peer makes them, in the bundle's order: t_ns, q, dq, tau."""
    k = np.arange(SAMPLES)
    t, speed, phase = k[:, None] * 1e-3, np.array([1.1, 2.3]), np.array([0.3, 1.9])
    tau = np.zeros((SAMPLES, 2))
    tau[2000:2300, 0] = -12.0
    t_ns = 1_700_000_000 * 10**9 + k * 1_000_000
    return t_ns, np.sin(speed * t + phase), speed * np.cos(speed * t + phase), tau


def first(got) -> int:
    """Sample of the first torque: the monitor may meet the peer's writer a moment after that has met the monitor."""
    return (got["torques"][0]["t_ns"] - states()[0][0]) // 1_000_000


@pytest.mark.slow
def test_every_sample_since_the_first_arrives_and_every_torque_returns(run):
    got, loop, counts, _, _ = run
    assert first(got) < 1500
    assert (counts.received, counts.lost, counts.refused) == (SAMPLES - first(got) + 20, 0, 0)
    assert len(got["torques"]) == loop.samples == SAMPLES - first(got)
    assert all(m["name"] == list(JOINTS) and m["others"] == 0 for m in got["torques"])


@pytest.mark.slow
def test_torques_are_those_of_the_monitor_offline(run):
    got, *_ = run
    t_ns, *signals = (signal[first(got) :] for signal in states())
    assert [m["t_ns"] for m in got["torques"]] == t_ns.tolist()
    monitor = _core.Monitor(watching_bundle())
    expected = monitor.run(t_ns, *map(np.ascontiguousarray, signals))["tau_ext"]
    efforts = np.array([m["effort"] for m in got["torques"]], dtype=float)  # null, which is NaN there, is NaN here
    # The C library's sine and NumPy's differ in the last bit.
    np.testing.assert_allclose(efforts, expected, atol=1e-9, rtol=0)


@pytest.mark.slow
def test_alarms_diagnostics_events_and_nodes_arrive(run):
    got, *_ = run
    assert got["contact"][:2] == [False, True] and got["collision"] == [False, True, False]
    assert [json.loads(text) for text in got["event"]] == [
        {"event": "contact", "joint": "elbow", "t_ns": 1, "merged": 1, "text": 'quoted " ü'}
    ]
    arm = [status for statuses in got["diagnostics"] for status in statuses if status["name"] == "tauext: arm"]
    assert {(2, "collision on shoulder"), (0, "ok")} <= {(status["level"], status["message"]) for status in arm}
    assert ["health", "ok"] in arm[-1]["values"] and arm[-1]["hardware_id"] == TOPIC
    assert {"space": SPACE, "name": "tauext", "readers": 5, "writers": 5} in [node for m in got["nodes"] for node in m]


@pytest.mark.slow
def test_what_the_peer_asks_is_done(run):
    _, _, _, notes, switches = run
    assert {(switch.new, switch.by) for switch in switches[1:]} == {("careful", f"ros2 {SPACE}/profile")}
    assert {f"acknowledged by ros2 {SPACE}/acknowledge", f"resumed by ros2 {SPACE}/resume"} <= set(notes)
