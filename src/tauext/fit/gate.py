"""The gate: a network ships for a joint only where it helps on recordings that it never saw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tauext import _core
from tauext.bundle.estimates import OK
from tauext.data.recording import Recording


@dataclass(frozen=True)
class Gate:
    """RMSE in free motion on validation recordings, and for which joints the network was worth its place."""

    prior_rmse_nm: np.ndarray  # (n,)
    network_rmse_nm: np.ndarray  # (n,) of prior and network together
    opened: np.ndarray  # (n,) bool

    def reason(self, joint: int, margin: float) -> str:
        """Why the joint has a network or none."""
        before, after = self.prior_rmse_nm[joint], self.network_rmse_nm[joint]
        verdict = "prior and network" if self.opened[joint] else "prior only"
        growth = after / before - 1 if before > 0 else np.inf
        change = f"{growth:+.1%}, asked {-margin:.0%}"
        return f"{verdict}: RMSE {before:.3g} Nm without a network, {after:.3g} Nm with it ({change})"


def apply_gate(bundle: _core.Bundle, validation: Sequence[Recording], margin: float, threads: int) -> Gate:
    """Judge every joint's network, and shut it off in the bundle where it does not lower the RMSE by `margin`.

    A joint that is shut off has an output scale of 0; where all are, the bundle keeps no network.
    """
    n = bundle.joints
    prior, both, samples = np.zeros(n), np.zeros(n), 0
    for recording in validation:
        signals = (recording.t_ns, recording.q, recording.dq, recording.tau)
        said = _core.estimate(bundle, *signals, threads, recording.temperature)
        healthy = said["health"] == OK
        prior += ((said["residual"] - said["prior"])[healthy] ** 2).sum(axis=0)
        both += (said["tau_ext"][healthy] ** 2).sum(axis=0)
        samples += int(healthy.sum())
    prior, both = np.sqrt(prior / max(samples, 1)), np.sqrt(both / max(samples, 1))
    gate = Gate(prior, both, both < (1 - margin) * prior)
    bundle.output_scale_nm = np.where(gate.opened, bundle.output_scale_nm, 0.0).tolist()
    if gate.opened.any():
        bundle.answer_reference()
    else:
        bundle.drop_network()
    return gate
