"""Time that the wrapper adds to a tick of a LeRobot loop with simulated servos; the aim is 2 ms.

    python packages/lerobot/benchmarks/added_ms.py --bundle arm.tauext --arm arm.toml [--ticks 20000]

The bundle must be of the simulated arm of tests/lerobot_arm.py. The time excludes the simulation.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

HERE = Path(__file__).parents[1]
sys.path[:0] = [str(HERE.parents[1] / "tests"), str(HERE / "tests")]


def main() -> None:
    """Print one line per call: median, 99 %, 99.9 %, worst."""
    from lerobot.robots import make_robot_from_config
    from lerobot_robot_tauext import TauextConfig
    from mock_arm import MockArmConfig, Player

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bundle", type=Path, required=True)
    parser.add_argument("--arm", type=Path, required=True)
    parser.add_argument("--ticks", type=int, default=20_000)
    options = parser.parse_args()
    nowhere = Path(tempfile.mkdtemp())
    inner = MockArmConfig(id="inner", calibration_dir=nowhere)
    robot = make_robot_from_config(
        TauextConfig(id="bench", calibration_dir=nowhere, robot=inner, bundle=options.bundle, arm=options.arm,
                     on_collision="hold", resume_within=1e9)
    )  # fmt: skip
    robot.connect()
    player = Player(7)
    spent = {
        name: np.zeros(options.ticks) for name in ("get_observation, wrapped", "the same, plain", "send_action beside")
    }
    states = []
    for _ in range(300):  # motion to repeat, so that simulating it takes no time between calls
        states.append(robot.robot.get_observation())
        robot.robot.send_action(player.action())
    actions = [player.action() for _ in range(300)]
    robot.robot.send_action = lambda action: dict(action)
    for k in range(options.ticks):
        robot.robot.get_observation = lambda k=k: dict(states[k % 300])
        begin = time.perf_counter()
        robot.robot.get_observation()
        plain = time.perf_counter()
        robot.get_observation()
        wrapped = time.perf_counter()
        robot.send_action(actions[k % 300])
        spent["the same, plain"][k] = plain - begin
        spent["get_observation, wrapped"][k] = wrapped - plain
        spent["send_action beside"][k] = time.perf_counter() - wrapped
    added = spent["get_observation, wrapped"] - spent["the same, plain"] + spent["send_action beside"]
    print(f"{options.ticks} ticks after 100 to warm up, ms: median, 99 %, 99.9 %, worst")
    for name, seconds in (*spent.items(), ("added to a tick", added)):
        values = np.percentile(1e3 * seconds[100:], [50, 99, 99.9, 100])
        print(f"{name:26} {values[0]:8.3f} {values[1]:8.3f} {values[2]:8.3f} {values[3]:8.3f}")


if __name__ == "__main__":
    main()
