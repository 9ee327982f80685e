"""`tauext simulate`: a dataset from the virtual rig."""

from __future__ import annotations

import math

from tauext.cli.place_argument import PlaceArg
from tauext.config import require, require_seed
from tauext.files.copies import staged


def simulate(
    out: PlaceArg,
    minutes: float = 90.0,
    collision_recordings: int = 10,
    seed: int = 0,
    calibration_hours: float = 0.0,
    test_hours: float = 0.0,
    encoder_bits: int = 20,
    friction: float = 1.0,
) -> None:
    """Simulate the paper's rig: free motion and collisions, recorded at 1 kHz.

    Args:
        out: dataset folder to write: recordings, robot.xml, split.json.
        minutes: minutes of free motion in all, cut in recordings of at most 90 s, at least 20 of them.
        collision_recordings: number of recordings with about ten collisions each.
        seed: seed of motions, noise and collisions.
        calibration_hours: hours of free motion beside the minutes, for limits alone; 24 support a promise of 1 false
            alarm in 8 hours.
        test_hours: hours of free motion beside the minutes, to test on.
        encoder_bits: resolution of the joints' encoders, counts in one turn as a power of two.
        friction: factor on Coulomb, static and viscous friction of every joint.
    """
    from tauext.cli.progress import ProgressBar
    from tauext.sim.collect import simulate_dataset
    from tauext.sim.config import changed_rig

    require(0 < minutes < math.inf, "minutes", minutes, "> 0")
    require(0 <= calibration_hours < math.inf, "calibration_hours", calibration_hours, ">= 0")
    require(0 <= test_hours < math.inf, "test_hours", test_hours, ">= 0")
    require_seed(seed)
    require(collision_recordings >= 0, "collision_recordings", collision_recordings, ">= 0")
    require(12 <= encoder_bits <= 24, "encoder_bits", encoder_bits, "12 to 24")
    require(0.1 <= friction <= 10, "friction", friction, "0.1 to 10")
    with staged(out) as folder, ProgressBar("simulate") as bar:
        simulate_dataset(
            folder,
            changed_rig(encoder_bits, friction),
            seed,
            minutes,
            collision_recordings,
            lambda what, done, total: bar.update(done, total, what),
            calibration_hours,
            test_hours,
        )
    print(out)
