"""A bundle on a recording, by the same chain as the monitor's."""

from __future__ import annotations

import os

from tauext import _core
from tauext.bundle.estimates import Estimates, lacking
from tauext.bundle.match import expect_fit
from tauext.config import checked
from tauext.data.recording import Recording
from tauext.train.declared_spread import Contacts


@checked
def estimate_recording(
    bundle: _core.Bundle, recording: Recording, threads: int = 0, contacts: Contacts = ()
) -> Estimates:
    """The bundle's estimates of every sample of the recording, as a new monitor would compute them.

    Args:
        threads: 0: one a core. The result does not depend on it.
        contacts: declared contacts with start [ns] and duration [s], by rising start.

    Raises:
        BundleError: joints, rate or torque timing of the recording are not the bundle's.
    """
    expect_fit(bundle, recording)
    threads = threads or os.cpu_count() or 1
    columns = _core.estimate(
        bundle,
        recording.t_ns,
        recording.q,
        recording.dq,
        recording.tau,
        threads,
        recording.temperature,
        contacts=contacts,
    )
    return Estimates.of(recording.joints, recording.t_ns, columns, {"alarm", *lacking(bundle)})
