"""Sources of samples and destinations of estimates: robots, servo buses, replay, LeRobot.

Input: addresses and settings of a controller, bus or dataset. Output: samples in the monitor's units, and estimates in
the protocol of the other side. The package imports `monitor` and the packages before it.
"""
