"""Pushes into recordings of a real arm that nothing touched: of a drive that follows its path whatever pushes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tauext.data.recording import Recording

EVERY_S, LENGTH_S = 1.5, (0.1, 0.4)
FIRST_S = 1.5
"""The observer is warm."""
SIZES = (0.1, 1.0)
"""Of the torque that a joint usually stays below: some are found and some are not."""


def pushed(recording: Recording, usual_nm: np.ndarray, seed: Sequence[int]) -> Recording:
    """The recording as if pushes acted on it: half sines of joint torque, which the motor gives besides, and labels.

    The drive of a stiff arm keeps its path, so that positions and velocities stay and tau gains the opposite of the
    external torque. A push on a link turns the joints before it; the farther ones less, by chance.
    """
    rng = np.random.default_rng(list(seed))
    tau_ext = np.zeros_like(recording.tau)
    contact = np.zeros(recording.samples, dtype=np.int8)
    time_s = recording.time_s
    for slot_s in np.arange(FIRST_S, recording.duration_s - EVERY_S, EVERY_S):
        start_s, length_s = slot_s + rng.uniform(0, EVERY_S - LENGTH_S[1] - 0.5), rng.uniform(*LENGTH_S)
        inside = (time_s >= start_s) & (time_s <= start_s + length_s)
        last = int(rng.integers(len(recording.joints)))
        share = float(np.exp(rng.uniform(*np.log(SIZES))))
        size = share * usual_nm * rng.uniform(-1, 1, len(usual_nm)) * (np.arange(len(usual_nm)) < last)
        size[last] = share * usual_nm[last] * rng.choice([-1, 1])
        tau_ext[inside] = np.sin(np.pi * (time_s[inside, None] - start_s) / length_s) * size
        contact[inside] = 1
    return replace(recording, tau=recording.tau - tau_ext, tau_ext=tau_ext, contact=contact)
