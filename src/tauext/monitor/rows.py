"""What a recording shows of a load, row by row: the chain's estimate, what it is worth, and what would show there."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tauext import _core
from tauext.bundle.bundle_fit import expect_fit
from tauext.bundle.estimates import OK
from tauext.data.recording import Recording
from tauext.monitor.weighable import weighing_joints

ROW_S = 0.01
"""A row: the network period. r changes little in less."""
STAND_S = 0.5
"""What holds a standing joint does not change meanwhile: however long, a stand tells as much as this of sliding."""
SIGMA_SHARE = 0.2
"""Of a limit: the standard error of bundles that have no error scale, whose limits are some five of it."""


@dataclass(frozen=True)
class Seen:
    """A recording as the chain saw it, at the rows that tell."""

    recording: Recording
    samples: np.ndarray  # (rows,) of the recording
    time_s: np.ndarray  # (rows,) from the recording's first sample
    tau_ext: np.ndarray  # (rows, n): without what the drift tracker takes off, which takes the load for drift
    sigma: np.ndarray  # (rows, n)
    worth: np.ndarray  # (rows, n): 1, less the longer a joint stands, 0 where its torque is in another unit
    moved: np.ndarray  # (rows, n): |dq|

    @property
    def rows(self) -> int:
        return len(self.samples)

    def part(self, keep: np.ndarray) -> Seen:
        """Some of the rows; keep: (rows,) bool."""
        fields = (self.samples, self.time_s, self.tau_ext, self.sigma, self.worth, self.moved)
        return Seen(self.recording, *(values[keep] for values in fields))


def see(bundle: _core.Bundle, recording: Recording, threads: int = 0) -> Seen:
    """Run the chain on a recording: every healthy row of it.

    Raises:
        BundleError: the recording is not one that the bundle was made for.
    """
    expect_fit(bundle, recording)
    recorded = (recording.t_ns, recording.q, recording.dq, recording.tau)
    said = _core.estimate(bundle, *recorded, threads or os.cpu_count() or 1)
    stride = max(1, round(ROW_S * recording.rate_hz))
    samples = np.arange(0, recording.samples, stride)
    samples = samples[(said["health"] == OK)[samples]]
    sigma = said["sigma_nm"] if bundle.error_scale.on else SIGMA_SHARE * said["limit_nm"]
    worth = stand_worth(said["near_stiction"] > 0, np.diff(recording.time_s, prepend=0.0)) * weighing_joints(bundle)
    return Seen(
        recording,
        samples,
        recording.time_s[samples],
        (said["tau_ext"] + said["drift"])[samples],
        np.maximum(sigma[samples], 1e-9),
        worth[samples],
        np.abs(recording.dq[samples]),
    )


def stand_worth(near: np.ndarray, steps_s: np.ndarray) -> np.ndarray:
    """(1 + t / STAND_S)^-2 with t the time that a joint has stood for, 1 where it slides: it adds up to STAND_S.

    Args:
        near: (samples, n) bool: near stiction.
        steps_s: (samples,) since the sample before.
    """
    stood, worth = np.zeros(near.shape[1]), np.ones(near.shape)
    for k, step in enumerate(steps_s):
        stood = np.where(near[k], stood + step, 0.0)
        worth[k] = (1 + stood / STAND_S) ** -2
    return worth


def columns(bundle: _core.Bundle, frame: _core.LoadFrame, seen: Seen, phi: np.ndarray) -> np.ndarray:
    """The rows of `_core.LoadSums`, (rows, n, columns), about a load phi (10,) as known so far.

    It says which side the gears are loaded on.
    """
    r, sums = seen.recording, _core.LoadSums
    told = _core.load_rows(bundle, frame, phi.tolist(), r.t_ns, r.q, r.dq, seen.samples)
    z = np.empty((*seen.tau_ext.shape, sums.COLUMNS))
    z[..., sums.LOAD : sums.LOAD + 10] = told["load"]
    z[..., sums.OFFSET], z[..., sums.COULOMB] = 1.0, told["coulomb"]
    z[..., sums.BASE : sums.BASE + 3], z[..., sums.FRAME : sums.FRAME + 3] = told["base_forces"], told["frame_forces"]
    z[..., sums.GEAR], z[..., sums.TAU_EXT] = told["offset"], seen.tau_ext
    return z


def sums_about(bundle: _core.Bundle, frame: _core.LoadFrame, parts: Sequence[Seen], phi: np.ndarray) -> _core.LoadSums:
    """Of all rows of these recordings."""
    sums = _core.LoadSums(bundle.joints)
    for part in parts:
        sums.add(columns(bundle, frame, part, phi), part.sigma, part.worth)
    return sums
