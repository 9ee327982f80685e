"""When a recording's collisions happen: far enough apart that each is judged alone."""

import numpy as np

from tauext.errors import ConfigError


def log_uniform(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    """One draw whose logarithm is uniform between the bounds."""
    return float(np.exp(rng.uniform(*np.log(bounds))))


def spread(lengths_s: list[float], total_s: float, gap_s: float, rng: np.random.Generator) -> np.ndarray:
    """Random start times of events of these lengths, in order, [s]: every gap, first and last too, at least gap_s.

    Raises:
        ConfigError: the events and their gaps do not fit into the recording.
    """
    slack = total_s - sum(lengths_s) - gap_s * (len(lengths_s) + 1)
    if slack < 0.0:
        raise ConfigError(
            f"collision_recording_s = {total_s:g} must hold {len(lengths_s)} collisions of {sum(lengths_s):.1f} s in "
            f"all and gaps of gap_s = {gap_s:g}: lengthen the recording or ask for fewer collisions"
        )
    before = np.cumsum([0.0, *lengths_s])[:-1]
    return before + gap_s * np.arange(1, len(lengths_s) + 1) + slack * np.sort(rng.uniform(size=len(lengths_s)))
