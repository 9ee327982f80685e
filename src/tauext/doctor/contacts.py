"""Labelled contacts where there should be none."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from tauext.data import Recording
from tauext.doctor.finding import Finding


def contact_findings(recordings: Sequence[Recording], called_free: Collection[str] = ()) -> list[Finding]:
    """Recordings that are called free, by `called_free` or by what made them, and hold samples labelled contact."""
    found = []
    for r in recordings:
        free = r.name in called_free or r.provenance.get("contacts") == "none"
        if not free or r.contact is None or not (r.contact == 1).any():
            continue
        touched = r.contact == 1
        first = r.time_s[int(touched.argmax())]
        evidence = f"'{r.name}': {touched.mean():.1%} of the samples are labelled contact, the first at {first:.2f} s"
        advice = (
            "leave them out of training and limits: list the recording with the collisions, or exclude the interval"
        )
        found.append(Finding("contact-in-free-motion", "fault", None, evidence, advice))
    return found
