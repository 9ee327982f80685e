"""LeRobot's own programs with force feedback: lerobot-teleoperate and lerobot-record with one more step."""

from __future__ import annotations

import lerobot.scripts.lerobot_record as lerobot_record
import lerobot.scripts.lerobot_teleoperate as lerobot_teleoperate
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_robot_tauext.feel_step import processors


def teleoperate() -> None:
    """lerobot-teleoperate, with the same options."""
    register_third_party_plugins()
    lerobot_teleoperate.make_default_processors = processors  # unlike lerobot-record, it accepts no processors
    lerobot_teleoperate.teleoperate()


def record() -> None:
    """lerobot-record, with the same options."""
    register_third_party_plugins()
    lerobot_record.record(teleop_action_processor=processors()[0])
