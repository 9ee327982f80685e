"""Everything that is measured of one bundle, taken in recording by recording."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np

from tauext import _core
from tauext.bundle.changed import changed_since_training
from tauext.bundle.estimates import Estimates
from tauext.bundle.loss_history import LossHistory
from tauext.check.rejected import Rejected
from tauext.config import EventsConfig
from tauext.data.recording import Recording
from tauext.evaluate.after_contact import AfterContact
from tauext.evaluate.collisions import Collision, found_curve, judge
from tauext.evaluate.during_contact import DuringContact
from tauext.evaluate.error_against_sigma import ErrorAgainstSigma
from tauext.evaluate.events import EventMeasures
from tauext.evaluate.free_motion import FreeMotionErrors
from tauext.evaluate.latched import judge_latched, latched_summary
from tauext.evaluate.missed_curve import MissedCurve
from tauext.evaluate.promise_check import check_promise, promised_per_hour
from tauext.evaluate.strength import by_strength
from tauext.evaluate.touches import TouchMeasures

COPIED = ("recipe", "case", "training_minutes", "steps", "epochs", "batch")
"""Of a bundle's provenance, into its entry."""


class BundleMeasures:
    """One bundle's numbers."""

    def __init__(
        self,
        name: str,
        bundle: _core.Bundle,
        events: EventsConfig = EventsConfig(),  # noqa: B008
        touches: TouchMeasures | None = None,
    ) -> None:
        self._name, self._bundle = name, bundle
        self._errors = FreeMotionErrors(bundle.joints, bundle.near_stiction_rad_s)
        self._curve = MissedCurve(bundle.hold_s)
        self._after = AfterContact(bundle.joints)
        self._during = DuringContact(bundle.joints)
        self._sigma = ErrorAgainstSigma(bundle.joints)
        self._rejected = Rejected()
        self._events = EventMeasures(events, bundle.near_stiction_rad_s)
        self._touches = touches or TouchMeasures(bundle)
        self._verdicts: list[dict] = []
        self._latched: list[dict] = []

    def add_events(self, recording: Recording, estimates: Estimates) -> None:
        """Take in any recording, for events, free time and health; once each."""
        self._rejected.add(recording.name, estimates.health, estimates.causes)
        self._events.add_estimates(recording, estimates)

    def add_free(self, recording: Recording, estimates: Estimates) -> None:
        """Take in a test recording, all of it free motion but what is not healthy."""
        self._errors.add(recording, estimates)
        self._curve.add_free(recording, estimates)
        self._after.add_free(recording, estimates)
        self._sigma.add(estimates)

    def add_touched(
        self, touches: Sequence[Collision], recording: Recording, estimates: Estimates, reference: np.ndarray | None
    ) -> None:
        """Take in a recording with these collisions; the reference is `sensor_reference` at the bundle's gain."""
        self._verdicts += [judge(touch, recording, estimates) for touch in touches]
        self._latched += [judge_latched(t, recording, estimates, self._bundle.hold_s, reference) for t in touches]
        self._curve.add_collisions(touches, recording, estimates)
        self._after.add_touched(recording, estimates)
        self._during.add(touches, recording, estimates, reference)
        self._sigma.add_touched(touches, recording, estimates, reference)
        self._touches.add(touches, recording, estimates)

    def peaks_over_limit(self) -> dict[str, float | None]:
        """How often its own limits go into the sensor's peak, by the ids of the collisions taken in."""
        return {verdict["id"]: verdict["peak_over_limit"] for verdict in self._verdicts}

    def summary(self, touches: Sequence[Collision], ten: Sequence[str], loss_history: LossHistory | None) -> dict:
        """Its entry in `bundles` of results.json.

        Args:
            touches: all that were taken in, in their order.
            ten: ids of the chosen ones.
        """
        bundle = self._bundle
        trained = json.loads(bundle.provenance or "{}")
        found = {verdict["id"]: verdict["found"] for verdict in self._verdicts}
        promised = promised_per_hour(trained)
        errors = self._errors
        return {
            "name": self._name,
            "bundle": f"{bundle.name}.tauext",
            "estimate_units": list(bundle.estimate_units),
            **{key: trained.get(key) for key in COPIED},
            "free_motion": errors.summary()
            | check_promise(promised, errors.false_collisions, float(errors.seconds) / 3600),
            "limits": {
                "sliding_nm": bundle.sliding_limit_nm,
                "near_stiction_nm": bundle.near_stiction_limit_nm,
                "moving": bundle.error_scale.follows,
            },
            "collisions": self._verdicts,
            "ten_found": sum(found[one] for one in ten),
            "found_curve": found_curve(self._verdicts),
            "rejected": self._rejected.facts(),
            "latched": latched_summary(self._latched),
            "by_strength": by_strength(touches, self._latched),
            "missed_curve": self._curve.summary(),
            "after_contact": self._after.summary(),
            "rmse_during_contact_nm": self._during.rmse_nm(),
            "error_against_sigma": self._sigma.summary(),
            "events": self._events.summary(),
            "touches": self._touches.summary(),
            "loss_history": loss_history,
            "changed_since_training": changed_since_training(trained),
        }
