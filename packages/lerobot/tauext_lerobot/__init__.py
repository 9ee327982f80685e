"""LeRobot and servo buses for tauext: live sources, labels, leader feedback.

Input: a bus of servos or motors, a LeRobot dataset, a follower's estimates. Output: samples for a monitor, a labelled
dataset, torque for a leader. LeRobot is not needed; `lerobot_robot_tauext`, which LeRobot imports, needs it.
"""
