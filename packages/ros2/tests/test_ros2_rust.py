"""The monitor against a ROS 2 node in Rust (ros2-client on RustDDS), which keeps a node graph of its own.

RustDDS finds others by multicast on networks other than loopback, so this one test uses the machine's network.
"""

import json
import os
import shutil
import subprocess
import threading
from pathlib import Path

import numpy as np
import pytest
from made_bundles import watching_bundle
from made_ros2 import DOMAIN

pytest.importorskip("cyclonedds")

from tauext_ros2 import connect
from tauext_ros2.settings import Ros2Settings

from tauext import _core
from tauext.monitor.loop import Loop, LoopSettings

PEER = Path(__file__).parent / "interop" / "ros2_client"
BUILD = Path(__file__).parents[3] / "build" / "ros2_client"
SAMPLES = 4000
URI = "<CycloneDDS><Domain><General><AllowMulticast>spdp</AllowMulticast></General></Domain></CycloneDDS>"
"""Multicast to be found, and for nothing else."""


def built(feature: str) -> Path:
    """The program, built outside of the sources, so that no lock file lands there."""
    cargo = shutil.which("cargo") or shutil.which("cargo", path=str(Path.home() / ".cargo" / "bin"))
    if cargo is None:
        pytest.skip("needs cargo")
    shutil.copytree(PEER, BUILD, dirs_exist_ok=True)
    words = [cargo, "build", "--target-dir", f"target{feature}"]
    done = subprocess.run(
        words + (["--features", feature] if feature else []), cwd=BUILD, capture_output=True, text=True
    )
    if done.returncode and "error[E" not in done.stderr:
        pytest.skip(f"cargo could not build: {done.stderr.strip().splitlines()[-1]}")
    assert done.returncode == 0, done.stderr
    return BUILD / f"target{feature}" / "debug" / "ros2_client_peer"


@pytest.mark.slow
@pytest.mark.parametrize("distro", ["jazzy", "humble"])
def test_a_node_in_rust_gets_torques_alarms_and_diagnostics_and_sees_the_node(distro, monkeypatch):
    program = built("humble" if distro == "humble" else "")
    monkeypatch.setenv("CYCLONEDDS_URI", URI)
    space, topic, domain = f"/rust_{distro}", f"/rust_{distro}/joint_states", (DOMAIN + 1 + (distro == "humble")) % 200
    settings = Ros2Settings(
        topic=topic, namespace=space, domain=domain, distro=distro, reliability="reliable", depth=1000
    )
    source, publisher = connect(settings)
    loop = Loop(watching_bundle(), source, [publisher], settings=LoopSettings(missing_after_s=2.0))
    running = threading.Thread(target=loop.run)
    running.start()
    try:
        words = [str(program), str(domain), space, topic, str(SAMPLES)]
        done = subprocess.run(words, capture_output=True, text=True, timeout=60, env=os.environ)
    finally:
        loop.stop("test")
        running.join()
    assert done.returncode == 0, done.stderr
    got = json.loads(done.stdout)
    assert source.counts.lost == 0
    assert got["name"] == ["shoulder", "elbow"]
    # Either side may meet the other's writer a moment after its own was met; from then on nothing is lost.
    k = (np.array(got["stamps"]) - 1_700_000_000 * 10**9) // 1_000_000
    assert k[-1] == SAMPLES - 1 and (np.diff(k) == 1).all() and k[0] < 1500
    rows = np.arange(SAMPLES - loop.samples, SAMPLES)
    t = rows[:, None] * 1e-3
    speed, tau = np.array([1.1, 2.3]), np.zeros((len(rows), 2))
    tau[(rows >= 2000) & (rows < 2300), 0] = -12.0
    monitor = _core.Monitor(watching_bundle())
    said = monitor.run(rows * 1_000_000, np.sin(speed * t), speed * np.cos(speed * t), tau)["tau_ext"]
    # The sine of Rust and that of NumPy differ in the last bit.
    np.testing.assert_allclose(np.array(got["effort"], dtype=float), said[k - rows[0]], atol=1e-9, rtol=0)
    assert got["collision"] == [False, True]
    assert [2, "collision on shoulder"] in got["diagnostics"]
    assert f"{space}/tauext" in got["nodes"]
