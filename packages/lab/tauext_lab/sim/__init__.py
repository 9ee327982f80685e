"""Simulated arms, sensors, contacts and servos.

In go settings and a seed. Out come recordings and datasets whose external torque is known. It imports `files`, `robot`,
`data` and the core.
"""
