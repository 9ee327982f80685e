"""The cheap looks: at one recording without any fit, and at all of them with one, so that hours pass in seconds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext.check.clock import clock_findings, degree_findings, time_findings
from tauext.check.contacts import unlabelled_findings
from tauext.check.examine import Diagnosis
from tauext.check.finding import SEVERITIES, Finding
from tauext.check.motion import stretches
from tauext.check.sensors import normal_ranges, sensor_findings, spike_findings, spikes_of, without_spikes
from tauext.check.servo import efforts_of, servo_findings, with_sign
from tauext.data.recording import Recording

OF_ALL = ("quantised", "smoothed", "saturated")
"""A joint that rests in one recording, or holds one torque, shows none of these; all of them together do."""


def quick_look(recording: Recording, torque_limits_nm: np.ndarray | None) -> list[Finding]:
    """Unsigned efforts, clock, spikes, stuck and saturated signals, degrees and unit of time of one recording, the
    worst first.

    Args:
        torque_limits_nm: (joints,) of the robot file, infinite where it has none; None: no robot file.
    """
    found, (mended,) = time_findings([recording])
    efforts = efforts_of([mended])
    found += [f for f in servo_findings(mended.joints, efforts) if f.severity == "fault"]
    (mended,), _ = with_sign([mended], efforts)
    normal = normal_ranges([mended])
    spikes = spikes_of(mended, normal, torque_limits_nm)
    found += spike_findings(mended, spikes, normal)
    mended = without_spikes(mended, spikes)
    found += clock_findings([mended])
    found += [f for f in sensor_findings([mended]) if f.code not in OF_ALL]
    found += degree_findings([mended], stretches([mended]))
    return sorted((_of(recording, f) for f in found), key=lambda f: SEVERITIES.index(f.severity))


def unlabelled_contacts(recordings: Sequence[Recording], diagnosis: Diagnosis) -> list[Finding]:
    """What `examine` says of contacts without a label, of more than it saw.

    Args:
        recordings: of the same joints.
        diagnosis: of a share of them, without a fault.
    """
    normal = normal_ranges(recordings)
    mended = [without_spikes(r, spikes_of(r, normal)) for r in recordings]
    return unlabelled_findings(mended, diagnosis.tree, diagnosis.lag_s)


def _of(recording: Recording, finding: Finding) -> Finding:
    return Finding(finding.code, finding.severity, finding.joint, finding.evidence, finding.advice, recording.name)
