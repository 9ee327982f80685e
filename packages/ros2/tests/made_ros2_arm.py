"""The rig as a ROS 2 arm in a process of its own: python made_ros2_arm.py DOMAIN TOPIC FACTOR.

Publishes joint states at 250 Hz in real time until it is killed; the effort is the drives' torque times FACTOR.
"""

import sys
import time

from made_ros2 import Robot
from tauext_lab.sim.source import KINDS
from tauext_ros2.settings import Ros2Settings

EVERY = 4


def main() -> None:
    domain, topic, factor = int(sys.argv[1]), sys.argv[2], float(sys.argv[3])
    arm = KINDS["rig"].make(1)
    robot = Robot(Ros2Settings(topic=topic, domain=domain), ("joint1", "joint2"))
    began, sent = time.monotonic(), 0
    while True:
        for _ in range(EVERY):
            q, dq, tau, _ = arm.step()
        sent += 1
        due = began + sent * EVERY * 1e-3
        time.sleep(max(0.0, due - time.monotonic()))
        robot.send(
            stamp_ns=10**18 + sent * EVERY * 10**6,
            position=q.tolist(),
            velocity=dq.tolist(),
            effort=(factor * tau).tolist(),
        )


if __name__ == "__main__":
    main()
