"""What a bundle says of each collision: which link, how many newtons, what kind; and how that fits the labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from tauext import _core
from tauext.bundle.estimates import Estimates
from tauext.data.recording import Recording
from tauext.evaluate.collisions import GRACE_S, Collision

FOLLOWED_S = 1.0
"""After the alarm: so long a monitor tells places of it."""
STATED = 0.9
"""A link that is so probable is stated."""


@dataclass
class TouchMeasures:
    """One bundle's links and kinds, collision by collision."""

    bundle: _core.Bundle
    _told: list[dict] = field(default_factory=list)
    _labels: list[tuple[int, str]] = field(default_factory=list)
    """Touched link, -1 where nobody knows, and the recording's word for the kind of its contacts."""

    def add(self, touches: Sequence[Collision], recording: Recording, estimates: Estimates) -> None:
        """Take in the collisions of a recording that raised an alarm, contact or collision."""
        model = _core.PlaceModel(self.bundle) if touches else None  # here, since it is not to be kept with the numbers
        for touch in touches:
            rows = alarm_rows(touch, recording, estimates)
            if model is None or len(rows) == 0:
                continue
            place = {} if model.refused else place_of(model, rows, recording, estimates)
            self._told.append({"id": touch.id, "kind": kind_of(touch, recording, estimates), **place})
            self._labels.append((touch.link, touch.kind))

    def summary(self) -> dict:
        """The entry `touches` of a bundle in results.json."""
        return {"stated_from": STATED, "links": self._links(), "kinds": self._kinds(), "told": self._told}

    def _links(self) -> dict | None:
        """None where no place was told of a collision whose link is labelled."""
        names = [link.joint_name for link in self.bundle.links]
        known = [
            (names[link], told)
            for (link, _), told in zip(self._labels, self._told, strict=True)
            if 0 <= link < len(names) and told.get("links")
        ]
        if not known:
            return None
        said = [
            (true, [one["joint"] for one in told["links"]], told["links"][0]["probability"]) for true, told in known
        ]
        stated = [true == ranked[0] for true, ranked, probability in said if probability >= STATED]
        return {
            "joints": names,
            "table": [
                [sum(true == row and ranked[0] == name for true, ranked, _ in said) for name in names] for row in names
            ],
            "collisions": len(said),
            "first": sum(true == ranked[0] for true, ranked, _ in said),
            "first_two": sum(true in ranked[:2] for true, ranked, _ in said),
            "stated": len(stated),
            "stated_right": sum(stated),
        }

    def _kinds(self) -> dict[str, dict[str, int]]:
        """How many were said to be of each kind, by the recording's word."""
        counts: dict[str, dict[str, int]] = {}
        for (_, word), told in zip(self._labels, self._told, strict=True):
            if told["kind"] is not None:
                row = counts.setdefault(word, {})
                row[told["kind"]] = row.get(told["kind"], 0) + 1
        return counts


def alarm_rows(touch: Collision, recording: Recording, estimates: Estimates) -> np.ndarray:
    """Rows at which some joint was over a limit, from the first in the collision on, for at most FOLLOWED_S."""
    assert estimates.held_alarm is not None
    last = min(touch.end + round(GRACE_S * recording.rate_hz), recording.samples)
    rows = touch.begin + np.flatnonzero(estimates.held_alarm[touch.begin : last] > 0)
    return rows[recording.t_ns[rows] <= recording.t_ns[rows[0]] + FOLLOWED_S * 1e9] if len(rows) else rows


def place_of(model: _core.PlaceModel, rows: np.ndarray, recording: Recording, estimates: Estimates) -> dict:
    """Links and newtons as told at that of these rows at which tau_ext stands out most; empty where nothing is."""
    assert estimates.sigma_nm is not None and estimates.contact_sigma_nm is not None
    with np.errstate(divide="ignore", invalid="ignore"):
        strength = np.nan_to_num(np.square(estimates.tau_ext[rows] / estimates.sigma_nm[rows]).sum(axis=1), posinf=0.0)
    row = int(rows[np.argmax(strength)])
    signals = (estimates.tau_ext, estimates.sigma_nm, estimates.contact_sigma_nm)
    tau_ext, sigma, contact_sigma = (signal[row].astype(float).tolist() for signal in signals)
    found = model.find(recording.q[row].tolist(), tau_ext, sigma, contact_sigma, dq=recording.dq[row].tolist())
    best = found.best
    if best is None:
        return {}
    return {
        "links": [
            {"joint": recording.joints[link], "probability": found.probability[link]} for link in found.ranked[:3]
        ],
        "force_n": float(np.linalg.norm(best.force)),
        "point_m": list(best.point),
        "spread_m": best.spread_m,
        "consistent": found.consistent,
    }


def kind_of(touch: Collision, recording: Recording, estimates: Estimates) -> str | None:
    """As known when the collision is over; None where the estimates do not say it."""
    if estimates.touch is None:
        return None
    last = min(touch.end + round(GRACE_S * recording.rate_hz), recording.samples) - 1
    return str(_core.Touch(int(estimates.touch[last])).name)
