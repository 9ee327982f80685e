"""Snapshots of a simulation for viewers: estimates of every monitor, the weight in the hand, contact places."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from tauext import _core
from tauext.errors import ConfigError
from tauext.monitor.places import links_words
from tauext.sim.arms import DemoArm

SHOWN = 3
"""Places that are drawn: the first, and two ghosts."""
STAYS = 0.5
"""Share of the most probable link's probability down to which the first link stays first, so that noise does not move
the arrow between links."""


@dataclass(frozen=True)
class Place:
    """A force at a point that would explain the torques, in the base frame."""

    joint: int
    """Joint that carries the link."""
    probability: float
    point_m: np.ndarray
    force_n: np.ndarray
    pushes: bool
    """The force points into the surface; else it pulls."""


@dataclass(frozen=True)
class Placed:
    """Contact places that explain the torques of one sample."""

    links: tuple[tuple[int, float], ...]
    """Joint that carries the link, and its probability: that of the first place, then the most probable first."""
    places: tuple[Place, ...]
    """The best one on the first link, then those that rival it, the most probable first."""

    @property
    def newtons(self) -> float:
        """Size of the force at the first place."""
        return float(np.linalg.norm(self.places[0].force_n))


class Places:
    """Places of touches by one method; a bundle without a model of the arm or without a standard error gives none."""

    def __init__(self, bundle: _core.Bundle):
        self._model = _core.PlaceModel(bundle)
        self._frames = _core.WrenchModel(bundle)
        self._names = [link.joint_name for link in bundle.links]
        self.refused = self._model.refused
        """Reason why the bundle gives no place; empty: it gives places."""
        self._first = -1

    def find(self, q: np.ndarray, estimate: _core.Estimate) -> Placed | None:
        """Places of this sample; None where no joint exceeds a limit: only errors would be located."""
        if self.refused:
            return None
        if estimate.held_alarm == _core.Alarm.none:
            self._first = -1
            return None
        left = np.subtract(estimate.tau_ext, estimate.load_nm)
        found = self._model.find(list(q), left.tolist(), list(estimate.sigma_nm), list(estimate.contact_sigma_nm))
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
    return f"On {links_words(placed.links, joints)}: {placed.newtons:.0f} N."


# --- A weight in the arm's hand: its load, its start, and the monitors in which it is set.


STEEL_KG_M3 = 7850.0
LEAST_KG, MOST_KG = 1.0, 3.0
"""Range of the weights: less is visible at the last joints only, more is too heavy for an arm of this size."""


def ball_radius_m(mass_kg: float) -> float:
    """Radius of a steel ball."""
    return float(np.cbrt(3 * mass_kg / (4 * np.pi * STEEL_KG_M3)))


def ball(arm: DemoArm, mass_kg: float) -> _core.Load:
    """A steel ball in the hand, in the frame of the last link.

    It is round and lies on the last joint's axis, so it is the same for a bundle without a model, whose last link has
    another x axis.

    Raises:
        ConfigError: the arm has no hand, or the mass is out of range.
    """
    if arm.hand_m is None:
        raise ConfigError(f"arm {arm.name} has no hand; another one has")
    if not LEAST_KG <= mass_kg <= MOST_KG:
        raise ConfigError(f"mass_kg = {mass_kg:g} must be {LEAST_KG:g} to {MOST_KG:g}")
    about_centre = 0.4 * mass_kg * ball_radius_m(mass_kg) ** 2
    return _core.Load(mass_kg, [0.0, 0.0, arm.hand_m], [about_centre] * 3 + [0.0] * 3)


@dataclass(frozen=True)
class Held:
    """The weight in the hand, for viewers."""

    mass_kg: float
    since_s: float
    load_set: bool
    """The weight is set in the method shown."""
    refused: str
    """Why the method shown refused the load; empty: it did not."""


class Hand:
    """The weight in the hand, and the methods in which it is set; the caller of take() changes the arm's
    physics."""

    def __init__(self) -> None:
        self.load: _core.Load | None = None
        self.since_ns = -1
        self.load_set = False
        self._refused: dict[str, str] = {}

    def take(self, load: _core.Load | None, last_ns: int) -> None:
        """Hold this from the sample after this time on; None: nothing."""
        self.load, self.since_ns = load, last_ns

    def set_load(self, load_set: bool, monitors: Mapping[str, _core.Monitor], afterwards: bool = False) -> None:
        """Set the held load in every monitor, or clear it; a monitor that refuses goes on without.

        Args:
            load_set: False: clear the load, as if the hand were empty.
            monitors: by method.
            afterwards: set it from the time it was taken on, where a monitor can go back.
        """
        self.load_set, self._refused = load_set, {}
        for method, monitor in monitors.items():
            load = self.load if load_set else None
            if load is None:
                if monitor.load.mass > 0:  # a monitor that refuses loads refuses clear_load(), too
                    monitor.clear_load()
            elif reason := monitor.why_no_load(load):
                self._refused[method] = reason
            else:
                since_ns = self.since_ns if afterwards and not monitor.why_no_load(load, self.since_ns) else None
                monitor.set_load(load.mass, load.com, load.inertia, since_ns=since_ns)

    def right_in(self, method: str) -> bool:
        """Whether the load of a method is right: nothing is held, or the held load is set."""
        return self.load is None or (self.load_set and method not in self._refused)

    def held(self, method: str) -> Held | None:
        """The held weight for a viewer of this method; None: none."""
        if self.load is None:
            return None
        return Held(self.load.mass, 1e-9 * self.since_ns, self.right_in(method), self._refused.get(method, ""))


# --- A snapshot of a simulation: its state, and the events since the last snapshot.


@dataclass(frozen=True)
class Verdict:
    """The present result of one method."""

    health: str
    alarm: str
    joint: int  # the joint that raised the alarm; -1: none
    kind: str = "none"
    """Kind of the touch: impact, push, clamp or load; unknown, or none without an alarm."""
    force_n: float = float("nan")
    """Force of the touch at its most probable place, when it was last found; NaN where unknown."""


@dataclass(frozen=True)
class Event:
    """A method raised a contact or a collision."""

    time_s: float
    method: str
    alarm: str
    joint: int
    after_push_s: float | None
    """Since the link was grabbed; None: nothing pushed."""
    after_limit_s: float | None
    """Since the true external torque of some joint first exceeded the method's limit of this level, counted from the
    grab or from resume(); None: it has not exceeded it."""
    by_weight: bool = False
    """A weight in the hand that is not set in this method, or that has just gone; without push or weight the alarm
    is false."""


@dataclass(frozen=True)
class Touch:
    """A push, true and estimated."""

    joint: int
    point_m: np.ndarray
    target_m: np.ndarray
    """Position of the pointer."""
    force_n: np.ndarray
    estimate_n: np.ndarray
    directions: int
    """Number of force directions visible in the joint torques, 0 to 3."""


@dataclass
class Snapshot:
    """State that a viewer draws; arrays over the joints unless stated otherwise."""

    time_s: float
    poses: np.ndarray
    """Of the links in the base frame: position and quaternion w, x, y, z, (joints, 7)."""
    doing: str
    method: str
    tau_ext: np.ndarray
    """Estimate of the method shown, [N m]; NaN while it warms up."""
    limit_nm: np.ndarray
    verdicts: dict[str, Verdict]
    touch: Touch | None
    trace: np.ndarray
    """Since the last snapshot, (rows, 1 + 4 joints): time, estimate, standard error (0: unknown), limit, truth."""
    events: list[Event] = field(default_factory=list)
    """Since the last snapshot."""
    real_time_factor: float = float("nan")
    held: Held | None = None
    """The weight in the hand."""
    placed: Placed | None = None
    """Contact places by the method shown; None while none of its joints exceeds a limit."""
    places_refused: str = ""
    """Reason why that method gives no place; empty: it gives places."""
