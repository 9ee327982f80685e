"""Where a method takes the touch of its alarm to be: link, point and force, and the places that rival them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tauext import _core

SHOWN = 3
"""Places that are drawn: the first, and two ghosts."""
STAYS = 0.5
"""Of the most probable link's probability: a link that was first stays first down to this, and no noise makes the arrow
jump to and fro."""


@dataclass(frozen=True)
class Place:
    """A force at a point that would explain the torques, in the base frame."""

    joint: int
    """That carries the link."""
    probability: float
    point_m: np.ndarray
    force_n: np.ndarray
    pushes: bool
    """Into the surface; else it pulls."""


@dataclass(frozen=True)
class Placed:
    """What explains the torques of one sample."""

    links: tuple[tuple[int, float], ...]
    """Joint that carries the link, and its probability: that of the first place, then the most probable first."""
    places: tuple[Place, ...]
    """The best one on the first link, then those that rival it, the most probable first."""

    @property
    def newtons(self) -> float:
        """Size of the force at the first place."""
        return float(np.linalg.norm(self.places[0].force_n))


class Places:
    """Of one method; a bundle without a model of the arm or without a standard error tells none."""

    def __init__(self, bundle: _core.Bundle):
        self._model = _core.PlaceModel(bundle)
        self._frames = _core.WrenchModel(bundle)
        self._names = [link.joint_name for link in bundle.links]
        self.refused = self._model.refused
        """Why it tells none; empty: it does."""
        self._first = -1

    def find(self, q: np.ndarray, said: _core.Estimate) -> Placed | None:
        """Places of this sample; None where no joint is over a limit, so that nothing would be placed but errors."""
        if self.refused:
            return None
        if said.held_alarm == _core.Alarm.none:
            self._first = -1
            return None
        left = np.subtract(said.tau_ext, said.load_nm)
        found = self._model.find(list(q), left.tolist(), list(said.sigma_nm), list(said.contact_sigma_nm))
        places = found.places
        if not places:
            return None
        most = found.ranked[0]
        stays = self._first >= 0 and found.probability[self._first] >= STAYS * found.probability[most]
        if not stays or all(one.link != self._first for one in places):
            self._first = most
        links = tuple(
            (link, found.probability[link]) for link in put_first(found.ranked, found.ranked.index(self._first))
        )
        best = next((k for k, one in enumerate(places) if one.link == self._first), 0)
        ordered = put_first(places, best)
        return Placed(links, tuple(self._place(q, one) for one in ordered[:SHOWN]))

    def _place(self, q: np.ndarray, found: _core.TouchPlace) -> Place:
        turn, _ = self._frames.pose(self._names[found.link], list(q))
        outwards = turn @ outward(np.array(found.on_link), [c for c in self._model.capsules if c.link == found.link])
        force = np.array(found.force)
        return Place(found.link, found.probability, np.array(found.point), force, bool(force @ outwards <= 0))


def put_first(all_of: list, index: int) -> list:
    return [all_of[index], *all_of[:index], *all_of[index + 1 :]]


def outward(point_m: np.ndarray, capsules: list[_core.Capsule]) -> np.ndarray:
    """From the axis of the capsule on whose surface a point lies to the point; all in the link's frame."""
    best, least = np.zeros(3), np.inf
    for one in capsules:
        start, way = np.array(one.start), np.subtract(one.end, one.start)
        share = np.clip((point_m - start) @ way / max(float(way @ way), 1e-12), 0.0, 1.0)
        off = point_m - start - share * way
        if (distance := abs(float(np.linalg.norm(off)) - one.radius_m)) < least:
            best, least = off, distance
    return best


def place_words(placed: Placed, joints: tuple[str, ...]) -> str:
    """`On the link of joint4 (83%; joint5 12%): 34 N.`"""
    (first, probability), *others = placed.links
    rivals = "".join(f"; {joints[link]} {share:.0%}" for link, share in others[:2] if share >= 0.05)
    return f"On the link of {joints[first]} ({probability:.0%}{rivals}): {placed.newtons:.0f} N."
