"""The monitor against other implementations of the wire, with types written down apart: Fast DDS and RustDDS.

RustDDS (by ros2-client) keeps a node graph of its own. It finds others by multicast on networks other than loopback, so
its test uses the machine's network.
"""

import json
import shutil
import subprocess
import threading
from pathlib import Path

import numpy as np
import pytest
from made_bundles import JOINTS, watching_bundle
from made_ros2 import DOMAIN, running

pytest.importorskip("cyclonedds")

from tauext_ros2 import connect
from tauext_ros2.settings import Ros2Settings

from tauext import _core
from tauext.monitor.cell_file import load_cell
from tauext.monitor.loop import Loop, LoopSettings
from tauext.monitor.sink import ReactionEvent

pytestmark = pytest.mark.slow
INTEROP = Path(__file__).parent / "interop"
BUILD = Path(__file__).parents[3] / "build" / "ros2_client"
SAMPLES = 4000
URI = "<CycloneDDS><Domain><General><AllowMulticast>spdp</AllowMulticast></General></Domain></CycloneDDS>"
"""Multicast to be found, and for nothing else."""
PROFILES = "profiles = { lowest = 0.5, highest = 3.0, plain = {}, careful = { collision = 1.5, contact = 1.5 } }\n"


def watched(loop: Loop, *words: object, beside=lambda: None) -> dict:
    """What the program of a peer got while the loop ran."""
    with running(loop), subprocess.Popen([*map(str, words)], stdout=subprocess.PIPE, text=True) as process:
        beside()
        printed = process.communicate(timeout=60)[0]
    assert process.returncode == 0
    return json.loads(printed)


def expect_torques(stamps: list[int], efforts: list, phase: tuple[float, float], begun: int) -> int:
    """Torques are those of the monitor offline that begins at a sample; none is missing. Returns the first's sample.

    Either side may meet the other's writer a moment after its own was met; from then on nothing is lost.
    """
    k = (np.array(stamps) - 1_700_000_000 * 10**9) // 1_000_000
    assert k[-1] == SAMPLES - 1 and (np.diff(k) == 1).all() and k[0] < 1500
    rows = np.arange(begun, SAMPLES)
    speed, tau = np.array([1.1, 2.3]), np.zeros((len(rows), 2))
    angle = speed * rows[:, None] * 1e-3 + phase
    tau[(rows >= 2000) & (rows < 2300), 0] = -12.0
    said = _core.Monitor(watching_bundle()).run(rows * 1_000_000, np.sin(angle), speed * np.cos(angle), tau)["tau_ext"]
    # The peers' sines and NumPy's differ in the last bit. Their null is NaN.
    np.testing.assert_allclose(np.array(efforts, dtype=float), said[k - begun], atol=1e-9, rtol=0)
    return int(k[0])


def test_fast_dds_gets_torques_alarms_and_diagnostics_and_is_obeyed(tmp_path):
    if shutil.which("g++") is None or not Path("/usr/include/fastrtps").is_dir():
        pytest.skip("needs g++ and the Debian packages libfastrtps-dev, libfastcdr-dev")
    program, space, topic = tmp_path / "fastdds_peer", "/fast", "/fast_states"
    options = ["-std=c++20", "-O1", "-Wall", "-Wextra", "-lfastrtps", "-lfastcdr", "-o", str(program)]
    subprocess.run(["g++", str(INTEROP / "fastdds_peer.cpp"), *options], check=True)
    (tmp_path / "cell.toml").write_text(PROFILES)
    settings = Ros2Settings(topic=topic, namespace=space, domain=DOMAIN, reliability="reliable", depth=1000)
    source, publisher = connect(settings)
    profiles = load_cell(tmp_path / "cell.toml", JOINTS).profiles
    patient = LoopSettings(missing_after_s=2.0)  # of a test on a busy machine nothing is late
    loop = Loop(watching_bundle(), source, [publisher], profiles=profiles, settings=patient)
    notes, switches = [], []
    loop.note, loop.switched = notes.append, switches.append
    event = ReactionEvent("contact", "elbow", 1, 2, {"text": 'quoted " ü'})
    tell = threading.Timer(3.0, publisher.publish_event, [event]).start
    got = watched(loop, program, DOMAIN, space, topic, SAMPLES, beside=tell)
    torques = got["torques"]
    begun = SAMPLES - loop.samples
    first = expect_torques([m["t_ns"] for m in torques], [m["effort"] for m in torques], (0.3, 1.9), begun)
    assert first == begun  # every torque returns
    counts = source.counts
    assert (counts.received, counts.lost, counts.refused) == (SAMPLES - first + 20, 0, 0)
    assert all(m["name"] == list(JOINTS) and m["others"] == 0 for m in torques)
    assert got["contact"][:2] == [False, True] and got["collision"] == [False, True, False]
    assert [json.loads(text) for text in got["event"]] == [
        {"event": "contact", "joint": "elbow", "t_ns": 1, "merged": 1, "text": 'quoted " ü'}
    ]
    arm = [status for statuses in got["diagnostics"] for status in statuses if status["name"] == "tauext: arm"]
    assert {(2, "collision on shoulder"), (0, "ok")} <= {(status["level"], status["message"]) for status in arm}
    assert ["health", "ok"] in arm[-1]["values"] and arm[-1]["hardware_id"] == topic
    assert {"space": space, "name": "tauext", "readers": 5, "writers": 5} in [node for m in got["nodes"] for node in m]
    assert {(switch.new, switch.by) for switch in switches[1:]} == {("careful", f"ros2 {space}/profile")}
    assert {f"acknowledged by ros2 {space}/acknowledge", f"resumed by ros2 {space}/resume"} <= set(notes)


def built(feature: str) -> Path:
    """The program in Rust, built outside of the sources, so that no lock file lands there."""
    cargo = shutil.which("cargo") or shutil.which("cargo", path=str(Path.home() / ".cargo" / "bin"))
    if cargo is None:
        pytest.skip("needs cargo")
    shutil.copytree(INTEROP / "ros2_client", BUILD, dirs_exist_ok=True)
    words = [cargo, "build", "--target-dir", f"target{feature}", *(["--features", feature] if feature else [])]
    done = subprocess.run(words, cwd=BUILD, capture_output=True, text=True)
    if done.returncode and "error[E" not in done.stderr:
        pytest.skip(f"cargo could not build: {done.stderr.strip().splitlines()[-1]}")
    assert done.returncode == 0, done.stderr
    return BUILD / f"target{feature}" / "debug" / "ros2_client_peer"


@pytest.mark.parametrize("distro", ["jazzy", "humble"])
def test_a_node_in_rust_gets_torques_alarms_and_diagnostics_and_sees_the_node(distro, monkeypatch):
    program = built("humble" if distro == "humble" else "")
    monkeypatch.setenv("CYCLONEDDS_URI", URI)
    space, topic, domain = f"/rust_{distro}", f"/rust_{distro}/joint_states", (DOMAIN + 1 + (distro == "humble")) % 200
    settings = {"topic": topic, "namespace": space, "domain": domain, "distro": distro, "depth": 1000}
    source, publisher = connect(Ros2Settings(**settings, reliability="reliable"))
    loop = Loop(watching_bundle(), source, [publisher], settings=LoopSettings(missing_after_s=2.0))
    got = watched(loop, program, domain, space, topic, SAMPLES)
    assert source.counts.lost == 0 and got["name"] == ["shoulder", "elbow"]
    expect_torques(got["stamps"], got["effort"], (0.0, 0.0), SAMPLES - loop.samples)
    assert got["collision"] == [False, True] and [2, "collision on shoulder"] in got["diagnostics"]
    assert f"{space}/tauext" in got["nodes"]
