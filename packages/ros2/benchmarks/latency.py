"""From a robot's joint states to the monitor's torques at a third process, over ROS 2 on the loopback interface.

    python packages/ros2/benchmarks/latency.py [--minutes 1] [--core N] [--priority P]
        [--reliability reliable]

Three processes: one publishes seven joints at 1 kHz, one runs the monitor as `tauext monitor --source ros2` does, one
takes the torques. Each writes down by CLOCK_MONOTONIC when it published or received the sample of every stamp; the
times below are differences of these, of all samples but those of the first seconds, in which the three find each other.
--core pins the monitor and the threads of its network library, --priority puts all three processes into SCHED_FIFO, as
`chrt -f 50 taskset -c 1 tauext monitor ...` does.
A sample is lost where the monitor or the third process never received what was published for it.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))
import seven_axis
from common import about_run, arguments, head, table_row

from tauext.monitor.latency import ask_for_real_time

SPACE, TOPIC, DOMAIN = "/latency", "/latency/joint_states", 91
PERIOD_NS = 1_000_000
SETTLE_S = 5.0
SILENT_S = 3.0
SHARES = (0.5, 0.99, 0.999, 1.0)
LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<Peers><Peer address='127.0.0.1'/></Peers></Discovery></Domain></CycloneDDS>"
)
ROLES = ("monitor", "peer", "robot")


def main() -> None:
    parser = arguments(__doc__, loop=True)
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--reliability", choices=("best-effort", "reliable"), default="best-effort")
    parser.add_argument("--role", choices=ROLES, help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    os.environ["CYCLONEDDS_URI"] = LOOPBACK
    if options.role:
        for text in ask_for_real_time(options.core if options.role == "monitor" else None, options.priority):
            print(f"{options.role}: {text}")
        {"monitor": run_monitor, "peer": run_peer, "robot": run_robot}[options.role](options)
        return
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, __file__, *sys.argv[1:]]
        started = [
            subprocess.Popen([*words, "--role", role, "--out", str(Path(folder) / f"{role}.npz")]) for role in ROLES
        ]
        try:
            if any([process.wait() for process in started]):
                sys.exit("a process failed")
        finally:
            for process in started:
                process.kill()
        logs = {role: dict(np.load(Path(folder) / f"{role}.npz")) for role in ROLES}
    show(logs, options)


def settings(**other):
    from tauext_ros2.settings import Ros2Settings

    return Ros2Settings(topic=TOPIC, namespace=SPACE, domain=DOMAIN, **other)


def run_robot(options: argparse.Namespace) -> None:
    """Publishes, at absolute times; the stamp of a message is when it was due."""
    from tauext_ros2.messages import Header, JointState, Time
    from tauext_ros2.node import Node

    node = Node(settings(node="robot"))
    writer = node.writer(TOPIC, JointState, "reliable", "volatile", 100)
    while not writer.get_matched_subscriptions():
        time.sleep(0.05)
    samples = round((options.minutes * 60 + SETTLE_S) * 1000)
    swing = seven_axis.motion(10.0)
    names, q, dq, tau = list(seven_axis.JOINTS), swing.q.tolist(), swing.dq.tolist(), swing.tau.tolist()
    message = JointState(Header(), names)
    stamps, published = np.zeros(samples, np.int64), np.zeros(samples, np.int64)
    wall_ns, due_ns = time.time_ns(), time.monotonic_ns()
    for k in range(samples):
        row = k % 20_000
        row = row if row < 10_000 else 19_999 - row  # there and back
        stamps[k] = wall_ns + k * PERIOD_NS
        message.header.stamp = Time.of_ns(int(stamps[k]))
        message.position, message.velocity, message.effort = q[row], dq[row], tau[row]
        left_ns = due_ns + k * PERIOD_NS - time.monotonic_ns()
        if left_ns > 0:
            time.sleep(left_ns * 1e-9)
        published[k] = time.monotonic_ns()
        writer.write(message)
    np.savez(options.out, stamps=stamps, times=published, late=published - due_ns - PERIOD_NS * np.arange(samples))


def run_monitor(options: argparse.Namespace) -> None:
    """The loop of `tauext monitor`, until nothing has come for a while."""
    from tauext_ros2 import connect

    from tauext.monitor.loop import Loop

    source, publisher = connect(settings(reliability=options.reliability))

    class Log:
        """Last of the sinks, so that the torque was sent when it is told."""

        def __init__(self):
            self.stamps, self.received, self.told = [], [], []

        def open(self, joints, control):
            self.control = control

        def verdict(self, verdict):
            now_ns = time.monotonic_ns()
            if verdict.block is not None:
                self.stamps += [source.stamp_ns(t_ns) for t_ns in verdict.t_ns.tolist()]
                self.received += verdict.block.received_ns.tolist()
                self.told += [now_ns] * len(verdict.block)
            elif self.stamps and now_ns - self.received[-1] > SILENT_S * 1e9:
                self.control.stop("silence")

        def every_second(self, report):
            pass

        def close(self):
            pass

    log = Log()
    loop = Loop(seven_axis.bundle(), source, [publisher, log])
    loop.note = lambda text: print("monitor:", text)
    loop.run()
    columns = {"stamps": log.stamps, "times": log.received, "told": log.told}
    counts = {"missing": loop.missing, "unsent": publisher.unsent}
    np.savez(options.out, **{name: np.array(one, np.int64) for name, one in columns.items()}, **counts)


def run_peer(options: argparse.Namespace) -> None:
    """Takes the torques, until none has come for a while."""
    from cyclonedds.core import WaitSet
    from tauext_ros2.messages import JointState
    from tauext_ros2.node import Node

    node = Node(settings(node="peer"))
    inbox = node.inbox(f"{SPACE}/external_torque", JointState, "reliable", "volatile", 1000)
    waitset = WaitSet(node.participant)
    waitset.attach(inbox.new)
    stamps, times = [], []
    while waitset.wait(round((SILENT_S if stamps else 60.0) * 1e9)):
        now_ns = time.monotonic_ns()
        for message in inbox.take()[0]:
            stamps.append(message.header.stamp.ns)
            times.append(now_ns)
    np.savez(options.out, stamps=np.array(stamps, np.int64), times=np.array(times, np.int64))


def show(logs: dict[str, dict], options: argparse.Namespace) -> None:
    robot, monitor, peer = logs["robot"], logs["monitor"], logs["peer"]
    counted = robot["stamps"] >= robot["stamps"][0] + round(SETTLE_S * 1e9)
    sent, published = robot["stamps"][counted], robot["times"][counted]
    at_monitor, in_monitor = where(sent, monitor["stamps"])
    at_peer, in_peer = where(sent, peer["stamps"])
    both = at_monitor & at_peer
    returned_ns, received_ns = peer["times"][in_peer[both]], monitor["times"][in_monitor[both]]
    times_ms = {
        "publication to torque at the peer": (returned_ns - published[both]) * 1e-6,
        "reception to torque at the peer": (returned_ns - received_ns) * 1e-6,
        "reception to torque sent (a tick)": (monitor["told"] - monitor["times"])[in_monitor[both]] * 1e-6,
        "publication, after it was due": robot["late"][counted] * 1e-6,
    }
    print(f"{about_run()}; {len(sent)} samples at 1 kHz, seven joints, {options.reliability}; core {options.core}")
    lost = (~at_monitor).sum(), (at_monitor & ~at_peer).sum(), monitor["missing"], monitor["unsent"]
    print("lost: {} before the monitor, {} after it; missing in time: {}; unsent: {}".format(*lost))
    print("\n".join(head("ms | p50 | p99 | p99.9 | max")))
    for name, ms in times_ms.items():
        print(table_row(name, *(f"{one:.3f}" for one in np.quantile(ms, SHARES))))


def where(sent: np.ndarray, got: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which of the sent stamps were got, and where in `got`, which is in their order."""
    at = np.searchsorted(got, sent).clip(max=max(len(got) - 1, 0))
    return (got[at] == sent) if len(got) else np.zeros(len(sent), bool), at


if __name__ == "__main__":
    main()
