"""Link, place and force of an alarm's touch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from tauext._core import Bundle, PlaceModel, TouchPlace, TouchPlaces, WrenchModel
from tauext.bundle.estimates import ALARMS, unexplained
from tauext.errors import ConfigError
from tauext.monitor.changes import Change, Trigger, number_at, trigger_of

# --- Force of an alarm's touch at a frame named by the user.


INCONSISTENT = 0.01
"""Least probability at which a force at the frame explains the torques."""


@dataclass(frozen=True)
class FrameForce:
    """A force without moment at a frame's origin, along the base's axes."""

    frame: str
    force_n: tuple[float, float, float]
    covariance: tuple[float, ...]
    """Covariance (3, 3), row by row, [N^2]."""
    blind: int
    """Number of directions not observable in this pose."""
    consistent: float
    """Probability that a force there leaves at least this residual."""
    blind_directions: tuple[tuple[float, ...], ...] = ()
    """Unobservable directions, unit vectors along the base's axes."""
    left_out: tuple[str, ...] = ()
    """Joints without an estimate in N m: they contribute nothing."""

    @property
    def size_n(self) -> float:
        return float(np.linalg.norm(self.force_n))

    @property
    def off_n(self) -> float:
        """Bound of the force's error, [N]: two standard errors along its worst direction, as 19 of 20 are smaller."""
        return 2.0 * float(np.sqrt(np.linalg.eigvalsh(np.reshape(self.covariance, (3, 3)))[-1]))

    def words(self) -> str:
        """Describe a force by the nearest of the base's axes: `23 N at tool0 (up to 4 N wrong), 12° from -z`."""
        if self.consistent < INCONSISTENT:
            return f"no force at {self.frame} explains it"
        axis = int(np.argmax(np.abs(self.force_n)))
        along = abs(self.force_n[axis]) / max(self.size_n, 1e-9)
        degrees = np.degrees(np.arccos(min(along, 1.0)))
        sign = "-" if self.force_n[axis] < 0 else "+"
        if self.blind:
            ways = f"{self.blind} direction{'s' * (self.blind != 1)}"
            without = f" without {', '.join(self.left_out)}" if self.left_out else ""
            along_ways = " and ".join(f"({', '.join(f'{x:.1f}' for x in way)})" for way in self.blind_directions)
            doubt = f"and {ways} that this pose cannot show{without}{': ' if along_ways else ''}{along_ways}"
        else:
            doubt = f"up to {max(self.off_n, 1):.0f} N wrong"
        return f"{self.size_n:.0f} N at {self.frame} ({doubt}), {degrees:.0f}° from {sign}{'xyz'[axis]}"


class ForceAtFrame:
    """Estimates the force at one frame of a bundle's arm."""

    def __init__(self, bundle: Bundle, frame: str) -> None:
        """Raises ConfigError if the bundle estimates no force or lacks the frame."""
        self._model, self._frame = WrenchModel(bundle), frame
        if self._model.refused:
            raise ConfigError(f"wrench = {frame!r}: no force can be estimated: {self._model.refused}")
        names = [one.name for one in self._model.frames]
        if frame not in names:
            raise ConfigError(f"wrench = {frame!r} must be one of {', '.join(names)}")

    def find(
        self, q: np.ndarray, dq: np.ndarray | None, estimates: dict[str, np.ndarray], row: int
    ) -> FrameForce | None:
        """The force at one row of the estimates; None where it is unknown."""
        at = slice(row, row + 1)
        wrench = self._model.wrenches(
            self._frame,
            q[at],
            estimates["tau_ext"][at] - estimates["load_nm"][at],
            estimates["sigma_nm"][at],
            [0.0, 0.0, 0.0],
            contact_sigma_nm=estimates["contact_sigma_nm"][at],
            dq=None if dq is None else dq[at],
        )
        if not np.isfinite(wrench["force"]).all():
            return None
        x, y, z = wrench["force"][0].tolist()
        blind = int(wrench["blind"][0])
        return FrameForce(
            frame=self._frame,
            force_n=(x, y, z),
            covariance=tuple(wrench["covariance"][0].ravel().tolist()),
            blind=blind,
            blind_directions=tuple(tuple(way) for way in wrench["blind_directions"][0][:blind, :3].tolist()),
            left_out=tuple(self._model.left_out),
            consistent=float(wrench["consistent"][0]),
        )


# --- Link and place of an alarm's touch, reported while the alarm is active.


FOLLOWED_S = 1.0
"""Time after which a change behind a latched alarm may be another touch."""


@dataclass(frozen=True)
class PlaceChange(Change):
    """The touched link and place became known, or more accurate, at this sample."""

    alarm: int
    """Present level."""
    joint: int
    """The joint that raised it."""
    since_s: float
    """Time since the alarm rose to this level, [s]."""
    links: tuple[tuple[int, float], ...]
    """Index of the joint that carries each link, and probability; most probable first."""
    places: tuple[TouchPlace, ...]
    """Places, most probable first, at least one."""
    best: TouchPlace
    """The place that messages report: the most probable place on the most probable link."""
    within_m: float
    """Distance from it that the touch is within with the probability STATED."""
    newtons: float
    """Median of the force."""
    interval_n: tuple[float, float]
    """Bounds that the force is within with the probability STATED, [N]."""
    consistent: float
    """Probability that a single force leaves at least this residual."""
    force: FrameForce | None = None
    """The force if it acts at the named frame."""
    number: int = 0
    """Number of the alarm."""
    straight: tuple[int, ...] = ()
    """Links farther out, if a smaller force there, straight through the axes between, causes the same torques; the
    interval contains it."""

    @classmethod
    def of(
        cls,
        model: PlaceModel,
        sample: Sample,
        row: int,
        t_ns: int,
        alarm: int,
        joint: int,
        since_s: float,
        force: FrameForce | None = None,
    ) -> PlaceChange | None:
        """Make the change for what the model finds at this sample; None if it finds no place."""
        found = find_places(model, sample)
        if found.best is None:
            return None
        links = tuple((link, found.probability[link]) for link in found.ranked)
        low_n, high_n = found.force_interval_n
        straight, least_n = straight_touches(model, sample, found)
        return cls(
            row,
            t_ns,
            alarm,
            joint,
            since_s,
            links,
            tuple(found.places),
            found.best,
            found.within_m,
            found.force_n,
            (min(low_n, least_n), high_n),
            found.consistent,
            force,
            straight=straight,
        )

    event = "place"

    @property
    def guessed(self) -> bool:
        """Whether the shape of a link that may be touched is guessed."""
        return any(place.guessed for place in self.places)

    @property
    def explains(self) -> bool:
        """Whether a single force on a link explains the touch."""
        return self.consistent >= INCONSISTENT

    def on(self, joints: tuple[str, ...]) -> str:
        """`the link of elbow`, `the link of elbow, or straight through the axes on the link of wrist_1`."""
        on = links_words(self.links, joints, self.guessed)
        if not self.straight:
            return on
        return f"{on}, or straight through the axes on {name_of(min(self.straight), max(self.straight), joints)}"

    def words(self, joints: tuple[str, ...], units: Sequence[str] = ()) -> list[str]:
        """`the touch is on the link of elbow: 26 to 42 N within 6 cm of (0.31, -0.20, 0.55) m`."""
        at_frame = "" if self.force is None else f"; {self.force.words()}"
        if not self.explains:
            return [f"the touch is no single force on one link: two touches, or a moment without a force{at_frame}"]
        return [f"the touch is on {self.on(joints)}: {force_words(self.interval_n)}{self._around()}{at_frame}"]

    def _around(self) -> str:
        """` within 6 cm of (0.31, -0.20, 0.55) m`, with the digits that the distance supports; empty if it is vague."""
        if self.within_m > VAGUE_M or self.straight:
            return ""
        digits, step_cm = (2, 1) if self.within_m < 0.1 else (1, 5)
        where = ", ".join(f"{value:.{digits}f}" for value in self.best.point)
        return f" within {step_cm * math.ceil(self.within_m * 100 / step_cm - 1e-9)} cm of ({where}) m"

    def facts(self, joints: tuple[str, ...]) -> dict[str, Any]:
        joint = joints[self.joint] if self.joint >= 0 else None
        return {
            "number": self.number,
            "alarm": ALARMS[self.alarm],
            "joint": joint,
            "since_s": self.since_s,
        } | self.place_facts(joints)

    def place_facts(self, joints: tuple[str, ...]) -> dict[str, Any]:
        """Links by their joints' names, and places in the base's frame."""
        facts: dict[str, Any] = {} if self.force is None else {"at_frame": asdict(self.force)}
        return facts | {
            "links": [{"joint": joints[link], "probability": share} for link, share in self.links],
            "places": [
                {
                    "joint": joints[place.link],
                    "probability": place.probability,
                    "point_m": list(place.point),
                    "force_n": list(place.force),
                    "spread_m": place.spread_m,
                }
                for place in self.places
            ],
            "within_m": self.within_m,
            "newtons": self.newtons,
            "newtons_interval": list(self.interval_n),
            "consistent": self.consistent,
            "shapes_guessed": self.guessed,
            "straight_links": [joints[link] for link in self.straight],
        }

    @property
    def trigger(self) -> Trigger | None:
        return trigger_of(self.alarm, self.joint, self.number, False, True)

    @property
    def learned(self) -> dict[str, Any]:
        return {"number": self.number, "place": self}

    @property
    def touched(self) -> TouchPlace | None:
        return self.best


def strength(tau_ext: np.ndarray, sigma_nm: np.ndarray) -> np.ndarray:
    """Sums of (tau_ext / sigma)^2 over each joint and those beyond it, (samples, joints).

    The touch that loads a joint is on its link or beyond: of the joints before it, another sample may show more, as
    they have errors of their own. 0 where a torque or its standard error is unknown.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.square(tau_ext / sigma_nm)
    return np.nan_to_num(ratios[:, ::-1].cumsum(axis=1)[:, ::-1], nan=0.0, posinf=0.0)


Sample = tuple[list[float], list[float], list[float], list[float], list[float]]
"""q, tau_ext, sigma_nm, contact_sigma_nm and dq of a sample."""


def find_places(model: PlaceModel, sample: Sample, link: int | None = None) -> TouchPlaces:
    """Places of a touch; link: the touched one, if it is known."""
    q, tau_ext, sigma_nm, contact_sigma_nm, dq = sample
    return model.find(q, tau_ext, sigma_nm, contact_sigma_nm, link=link, dq=dq)


STRAIGHT = 0.3
"""Probability of the remainder from which on a force explains the torques as well as any."""
SMALLER = 2 / 3
"""Share of the stated force below which another one is named."""


def straight_touches(model: PlaceModel, sample: Sample, found: TouchPlaces) -> tuple[tuple[int, ...], float]:
    """Links behind the stated ones, if a clearly smaller force there causes the same torques, and its lower bound.

    A force straight through the axes of a wrist loads the joints before them alone, like a larger one nearer to the
    base. To the posterior that is a coincidence; people who aim do it.
    """
    _, last, _ = run_of([(link, found.probability[link]) for link in found.ranked])
    farther = tuple(range(last + 1, len(found.probability)))
    lows = [
        other.force_interval_n[0]
        for other in (find_places(model, sample, link) for link in farther)
        if other.places and other.consistent > STRAIGHT and other.force_n < SMALLER * found.force_n
    ]
    return (farther, min(lows)) if lows else ((), math.inf)


def strongest_sample(
    joint: int, q: np.ndarray, dq: np.ndarray, tau_ext: np.ndarray, sigma_nm: np.ndarray, contact_sigma_nm: np.ndarray
) -> Sample:
    """The sample with the largest strength() from the joint that raised the alarm on (-1: unknown, all count), from
    arrays (samples, joints)."""
    row = int(np.argmax(strength(tau_ext, sigma_nm)[:, max(joint, 0)]))
    at, tau, sigma, contact, speed = (
        one[row].astype(float).tolist() for one in (q, tau_ext, sigma_nm, contact_sigma_nm, dq)
    )
    return at, tau, sigma, contact, speed


class PlaceFinder:
    """Finds places of touches in the estimates, chunk after chunk; the result does not depend on the chunks.

    The place is that of the sample since the alarm with the largest strength(), of tau_ext less an expected load, from
    the joint that raised the alarm on.
    """

    after_ns = 100_000_000
    """Delay after the alarm, [ns]: early enough for a reaction, late enough for most touches to be near their peak."""
    again_ns = 200_000_000
    """Shortest time between two reports, [ns]."""
    stronger = 2.0
    """Growth of the sum of (tau_ext / sigma)^2 for another report: errors of links, which go with 1 / root, are then
    0.7 times as large."""

    def __init__(self, bundle: Bundle, frame: str | None = None) -> None:
        """frame: frame at which the force is also estimated; ConfigError if the bundle lacks it."""
        self._at_frame = None if frame is None else ForceAtFrame(bundle, frame)
        self._force: FrameForce | None = None
        self._model = PlaceModel(bundle)
        self.refused = self._model.refused
        """Reason why places cannot be estimated; empty: they can."""
        self._alarm, self._rose_ns, self._joint = 0, 0, -1
        self._due_ns: int | None = None
        self._strength, self._reported = 0.0, 0.0
        self._sample: Sample | None = None

    def stand(self, alarm: int) -> None:
        """This alarm stands from before the first sample on: its place is not estimated again."""
        self._alarm = alarm

    def acknowledged(self) -> None:
        """The alarm was acknowledged just before the next sample; an alarm at that sample was raised again."""
        self._alarm, self._due_ns = 0, None

    def find(
        self, first_row: int, t_ns: np.ndarray, q: np.ndarray, dq: np.ndarray, estimates: dict[str, np.ndarray]
    ) -> list[PlaceChange]:
        """Places found at these samples, in order.

        Args:
            first_row: the chunk's first row, counted from the recording's first sample.
            t_ns: (rows,), [ns].
            q: (rows, joints), [rad].
            dq: (rows, joints), [rad/s].
            estimates: as returned by Monitor.run for these samples, not empty.
        """
        alarm = estimates["alarm"]
        if self.refused or (self._due_ns is None and (alarm == self._alarm).all()):
            return []  # fast path, also during long alarms
        left = unexplained(estimates)
        by_row = strength(left, estimates["sigma_nm"])
        places = []
        for k in range(len(t_ns)):
            fell, level = self._follow(int(t_ns[k]), int(alarm[k]), int(estimates["alarm_joint"][k]))
            if self._due_ns is None:
                continue
            joint = max(self._joint, 0)
            if alarm[k] and by_row[k, joint] > self._strength:
                self._strength = float(by_row[k, joint])
                at = slice(k, k + 1)
                errors = estimates["sigma_nm"][at], estimates["contact_sigma_nm"][at]
                self._sample = strongest_sample(joint, q[at], dq[at], left[at], *errors)
                if self._at_frame is not None:
                    self._force = self._at_frame.find(q, dq, estimates, k)
            if found := self._judge(first_row + k, int(t_ns[k]), fell, level):
                places.append(replace(found, number=number_at(estimates, k)))
        return places

    def _follow(self, t_ns: int, alarm: int, joint: int) -> tuple[bool, int]:
        """Whether the alarm fell at this sample, and the level to report."""
        fell, level = self._alarm > 0 and alarm == 0, alarm or self._alarm
        if alarm > self._alarm:
            if self._alarm == 0:
                self._strength, self._reported, self._sample = 0.0, 0.0, None
            self._rose_ns, self._joint = t_ns, joint
            self._due_ns = t_ns + self.after_ns
        self._alarm = alarm
        return fell, level

    def _judge(self, row: int, t_ns: int, fell: bool, level: int) -> PlaceChange | None:
        """A place, if one is due and the strongest sample is `stronger` times as strong as the last reported one."""
        assert self._due_ns is not None
        due = fell or not 0 < self._due_ns - t_ns <= self.again_ns  # past, or the clock was set back
        if not due or self._sample is None or self._strength < self.stronger * self._reported:
            if fell or not 0 <= t_ns - self._rose_ns <= FOLLOWED_S * 1e9:
                self._due_ns = None
            return None
        self._reported = self._strength
        self._due_ns = None if fell else t_ns + self.again_ns
        since_s = (t_ns - self._rose_ns) * 1e-9
        return PlaceChange.of(self._model, self._sample, row, t_ns, level, self._joint, since_s, self._force)


STATED = 0.9
"""Probability of the reported run of links, interval of the force, and distance from the place."""
VAGUE_M = 0.5
"""Distance from which on a place is not reported."""


def force_words(interval_n: tuple[float, float]) -> str:
    """`26 to 42 N`, `40 to 260 N`: rounded to a fifth of the interval at most."""
    low, high = interval_n
    step = next((one for one in (50, 20, 10, 5, 2) if one <= (high - low) / 5), 1)
    return f"{step * round(low / step)} to {step * round(high / step)} N"


def run_of(links: Sequence[tuple[int, float]]) -> tuple[int, int, float]:
    """Number of the first and last link of the shortest run of neighbours whose probability is STATED, and its
    probability.

    Args:
        links: number of the joint that carries the link, and its probability, of all links; the most probable first,
            which the run contains.
    """
    probability = dict(links)
    best, last = links[0][0], max(probability)
    runs = [
        (end - first, -sum(probability.get(link, 0.0) for link in range(first, end)), first)
        for first in range(best + 1)
        for end in range(best + 1, last + 2)
    ]
    count, less, first = min(run for run in runs if -run[1] >= STATED or run[0] == last + 1)
    return first, first + count - 1, -less


def name_of(first: int, last: int, joints: tuple[str, ...]) -> str:
    """Name neighbouring links by their joints."""
    if first == last:
        return f"the link of {joints[first]}"
    if last == first + 1:
        return f"the link of {joints[first]} or {joints[last]}"
    return f"a link from {joints[first]} to {joints[last]}"


def links_words(links: Sequence[tuple[int, float]], joints: tuple[str, ...], guessed: bool = False) -> str:
    """Describe links: `the link of elbow`, `a link from lift to wrist_1 (most likely elbow)`.

    Args:
        links: as run_of() takes them.
        guessed: the shape of a link that may be touched is guessed.
    """
    first, last, _ = run_of(links)
    name = name_of(first, last, joints)
    best, probability = links[0]
    rest = [f"most likely {joints[best]}"] * (first != last and probability >= 0.5) + ["shapes guessed"] * guessed
    return f"{name} ({'; '.join(rest)})" if rest else name
