"""What each cause of a bad health means, and where to look."""

from __future__ import annotations

MEANING = {
    "not finite": "a position, velocity or torque was NaN, infinite or absurdly large; look at the driver and at the "
    "conversion of its values",
    "wrong size": "the sample did not hold one value for each joint; look at what puts the samples together",
    "late sample": "a sample was older than the one before it and was left out; look at the order in which they come",
    "time backwards": "the time stamps went back by more than one network period; look at the clock that makes them",
    "missing sample": "the loop ran and no new sample had come; look at the connection to the arm",
    "gap": "no sample came for longer than one network period; look at the connection to the arm",
    "wrong rate": "samples came at another rate than the bundle was trained for; run the loop at that rate, or train "
    "for this one",
    "torque saturated": "a drive was at its torque limit and gave another torque than it was told; move slower, carry "
    "less, or expect doubtful estimates there",
    "encoder still": "a position did not change while velocity or torque say that the joint moved; look at the encoder "
    "and its cable",
    "impossible torque": "a torque was larger than the drive can give, whatever touches the arm; look at the driver, "
    "at the unit of its torques and at the conversion of their values",
    "impossible velocity": "a velocity was higher than the joint can get; look at the encoder, at the unit of the "
    "velocity and at how it is differentiated",
    "impossible position": "a position lay farther from the one before than the joint can have gone, or beyond all "
    "that encoders count; look at the encoder, its cable and its zero: after a new zero the monitor goes on by itself",
}
"""By the core's name of the cause."""


def in_words(names: list[str]) -> str:
    """`gap and wrong rate`, or `no cause`."""
    return " and ".join(names) if names else "no cause"
