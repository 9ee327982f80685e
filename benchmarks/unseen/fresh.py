"""Arms that no method was fixed on: other kinematics, rates and stamps, and programs that end in abrupt stops."""

from __future__ import annotations

from pathlib import Path

from unseen.arms import Maker

HERE = Path(__file__).parent
STOP_SHARE = 0.25
JITTER_SHARE = 0.1
"""Standard deviation of a stamp, of the sample period."""


def fresh_makers() -> dict[str, Maker]:
    """The arms by name; their friction and rotors have the sizes of the others' beside their torque."""
    palletizer = Maker(
        "palletizer", HERE / "palletizer.urdf", tuple(f"joint{k}" for k in range(1, 6)),
        100, (-2.6, -0.9, -1.0, -1.6, -3.0), (2.6, 1.2, 1.1, 1.6, 3.0), (2.4, 2.0, 2.2, 2.8, 4.0),
        (350, 380, 240, 70, 35),
        (12.0, 14.0, 10.0, 4.0, 2.0), (13.0, 15.0, 10.0, 3.5, 1.5), (1.5, 1.7, 1.1, 0.25, 0.1),
        (18.0, 18.0, 15.0, 9.0, 7.0), 17, False, True,
        stop_share=STOP_SHARE, stamp_jitter_s=JITTER_SHARE / 100, missing_share=0.03, own_seed=5, fresh=True,
    )  # fmt: skip
    offset_wrist = Maker(
        "offset_wrist", HERE / "offset_wrist.urdf", tuple(f"joint{k}" for k in range(1, 7)),
        250, (-2.7, -1.0, -1.1, -2.6, -1.9, -3.0), (2.7, 1.2, 1.0, 2.6, 1.9, 3.0), (2.6, 2.2, 2.6, 3.6, 3.6, 4.5),
        (320, 380, 220, 70, 60, 35),
        (13.0, 16.0, 10.0, 3.5, 3.0, 1.8), (15.0, 17.0, 10.0, 3.2, 2.6, 1.4), (1.6, 1.8, 1.1, 0.25, 0.2, 0.1),
        (16.0, 16.0, 13.0, 8.0, 7.5, 6.0), 19, True, False,
        stop_share=STOP_SHARE, stamp_jitter_s=JITTER_SHARE / 250, own_seed=6, fresh=True,
    )  # fmt: skip
    light_arm = Maker(
        "light_arm", HERE / "light_arm.urdf", tuple(f"joint{k}" for k in range(1, 8)),
        1000, (-2.6, -1.6, -2.6, -2.0, -2.6, -1.8, -2.8), (2.6, 1.6, 2.6, 2.0, 2.6, 1.8, 2.8),
        (2.8, 2.8, 3.1, 3.1, 3.5, 3.5, 4.0), (45, 45, 28, 28, 12, 10, 8),
        (2.2, 2.4, 1.4, 1.5, 0.6, 0.5, 0.4), (2.0, 2.2, 1.3, 1.3, 0.5, 0.4, 0.3),
        (0.16, 0.16, 0.09, 0.09, 0.03, 0.025, 0.02),
        (6.0, 6.0, 5.0, 5.0, 3.0, 2.6, 2.4), 14, False, True,
        stop_share=STOP_SHARE, stamp_jitter_s=JITTER_SHARE / 1000, own_seed=7, fresh=True,
    )  # fmt: skip
    return {maker.name: maker for maker in (palletizer, offset_wrist, light_arm)}
