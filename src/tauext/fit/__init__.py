"""Fits and their results: prior, network, kinematics, torque constants.

In go observed residuals of free motion. Out come fitted parameters and the bundle that holds them. It imports the
packages before it and orchestrates nothing.
"""
