"""The look before learning: the doctor's findings on what a stage is about to learn from; faults refuse."""

from tauext.look.verdict import Look, entries, expect_codes, judge, sentence, told
from tauext.look.viewing import look_at_calibration, look_at_training

__all__ = [
    "Look",
    "entries",
    "expect_codes",
    "judge",
    "look_at_calibration",
    "look_at_training",
    "sentence",
    "told",
]
