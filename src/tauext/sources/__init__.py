"""Where samples come from and where answers go: robots, ROS 2, servo buses, replay, LeRobot.

In go the addresses and settings of a controller, bus or dataset. Out come samples in the monitor's units, and answers
in the other side's protocol. It imports `monitor` and the packages before it.
"""
