"""Touches on every link of a simulated arm, and what the monitor says of them."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from unseen.arms import Maker, makers
from unseen.contacts import Contact
from unseen.motions import draw_motion
from unseen.of_type import arm_of
from unseen.simulation import RATE_HZ, simulate
from unseen.surfaces import SURFACES, capsules_of, draw_touch
from wrench import WARM_S, logged, told

from tauext import _core
from tauext.monitor.places import PlaceChange, PlaceFinder
from tauext.monitor.replay import replay
from tauext.robot.load import load_tree

SLOT_S, FIRST_S, HELD_S = 3.0, 8.0, 1.2
ACKNOWLEDGED_S = 1.4
"""After the alarm: a touch's own has ended by then, and the next finds none."""
RATIOS = (1.5, 10.0)
"""Of the limit that a touch exceeds most, even in its logarithm."""
FORCES_N = (8.0, 120.0)
"""Less is no touch that matters; more takes a small arm's drives to their limits."""
CONE_RAD = np.radians(45)
"""From the surface's normal: friction of 1."""
REJECTED = 0.05
FLANGE_EVERY = 8
DATASETS_SEED = 0
"""Of the arms that the datasets were made with."""
SAID_AT_S = 0.5
"""After the alarm: what the monitor has said by then is what it says."""


@dataclass(frozen=True)
class Arm:
    maker: Maker
    bundle: _core.Bundle

    @property
    def names(self) -> list[str]:
        return [link.joint_name for link in self.bundle.links]

    @property
    def surface(self):
        return SURFACES[self.maker.name]


def ready(models: Path, unseen: Path, out: Path, name: str) -> Arm:
    """With a bundle of recipe prior, trained where there is none, that knows what the links look like."""
    maker = makers(models)[name]
    path = out / f"{name}.tauext"
    if not path.exists():
        words = [sys.executable, "-m", "tauext", "train", "--data", unseen / name / "urdf", "--recipe", "prior"]
        subprocess.run([str(word) for word in [*words, "--out", path]], check=True, capture_output=True)
    bundle = _core.Bundle.load(str(path))
    bundle.capsules = capsules_of(SURFACES[name])
    return Arm(maker, bundle)


@dataclass(frozen=True)
class Touch:
    """In the link's axes."""

    link: int
    point_m: np.ndarray
    direction: np.ndarray
    angle_rad: float
    force_n: float
    start_s: float
    flange: bool = False
    """Held at the origin of the last link's frame, in any direction, and no touch of the surface."""


@dataclass(frozen=True)
class Samples:
    """As the monitor gets them, with what the simulation knows."""

    t_ns: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    tau: np.ndarray
    true_nm: np.ndarray


def touched(arm: Arm, count: int, rng: np.random.Generator) -> tuple[list[Touch], Samples]:
    """A simulation with a touch a slot, in motion and in pauses; every FLANGE_EVERY-th holds the flange."""
    maker, real = arm.maker, arm_of(arm.maker, DATASETS_SEED)
    setpoints = draw_motion(maker, round((FIRST_S + count * SLOT_S) * RATE_HZ), RATE_HZ, rng)
    touches = [
        drawn(arm, setpoints[0], FIRST_S + k * SLOT_S + rng.uniform(0, 0.8), rng, k % FLANGE_EVERY == 0)
        for k in range(count)
    ]
    contacts = [
        Contact(
            "push",
            one.start_s,
            one.start_s + HELD_S,
            one.link,
            0.5,
            tuple(one.direction.tolist()),
            one.force_n,
            (one.start_s, one.start_s + HELD_S),
            tuple(one.point_m.tolist()),
            in_link=True,
        )
        for one in touches
    ]
    run = simulate(real, load_tree(maker.model, maker.joints), setpoints, maker.torque_nm, contacts, WARM_S)
    signals = logged(maker, real, run, told(maker, DATASETS_SEED), rng)
    return touches, Samples(*signals, run.tau_ext[:: RATE_HZ // maker.rate_hz])


def drawn(arm: Arm, q: np.ndarray, start_s: float, rng: np.random.Generator, flange: bool) -> Touch:
    """A touch on any link, at a point of its surface, that exceeds a limit by a ratio drawn from RATIOS."""
    model, limits = _core.WrenchModel(arm.bundle), np.array(arm.bundle.sliding_limit_nm)
    pose = q[round((start_s + 0.5) * RATE_HZ)]
    while True:
        link = len(arm.names) - 1 if flange else int(rng.integers(len(arm.names)))
        for _ in range(20):  # a link that no joint feels there is left for another one
            point, direction, angle = draw_touch(arm.surface, link, CONE_RAD, rng)
            if flange:
                point, direction = np.zeros(3), rng.standard_normal(3)
                direction /= np.linalg.norm(direction)
            columns = model.columns(arm.names[link], pose.tolist(), point.tolist(), _core.WrenchAxes.frame)[:3]
            ratio = np.exp(rng.uniform(*np.log(RATIOS)))
            force = ratio / max(np.abs(direction @ columns / limits).max(), 1e-9)
            if FORCES_N[0] <= force <= FORCES_N[1]:
                return Touch(link, point, direction, angle, float(force), start_s, flange)


def look_at(arm: Arm, touches: list[Touch], samples: Samples) -> list[dict]:
    """What is said of each touch by SAID_AT_S after its alarm."""
    finder, changes = PlaceFinder(arm.bundle), []
    assert not finder.refused, finder.refused
    monitor = _core.Monitor(arm.bundle)
    for chunk in replay(monitor, samples, acknowledge_after_s=ACKNOWLEDGED_S, places=finder):
        changes += [change for change in chunk.changes if isinstance(change, PlaceChange)]
    said = _core.estimate(arm.bundle, samples.t_ns, samples.q, samples.dq, samples.tau, 1)
    return [told_of(arm, touch, samples, said, changes) for touch in touches]


def told_of(arm: Arm, touch: Touch, samples: Samples, said: dict, changes: list[PlaceChange]) -> dict:
    """One row."""
    start_ns = round(touch.start_s * 1e9) + int(samples.t_ns[0])
    own = [
        one
        for one in changes
        if start_ns <= one.t_ns - one.since_s * 1e9 < start_ns + HELD_S * 1e9 and one.since_s <= SAID_AT_S
    ]
    row = {
        "arm": arm.maker.name,
        "link": touch.link,
        "point_m": touch.point_m.tolist(),
        "force_n": touch.force_n,
        "angle_deg": float(np.degrees(touch.angle_rad)),
        "flange": touch.flange,
        "seen": bool(own),
    }
    if not own:
        return row
    last = own[-1]
    strength = np.square(said["tau_ext"] / said["sigma_nm"]).sum(axis=1)
    first = int(np.searchsorted(samples.t_ns, last.t_ns - round(last.since_s * 1e9)))
    at = first + int(np.nanargmax(strength[first : last.row + 1]))
    sample = (samples.q[at].tolist(), said["tau_ext"][at].tolist(), said["sigma_nm"][at].tolist())
    contact_sigma = said["contact_sigma_nm"][at].tolist()
    found = _core.PlaceModel(arm.bundle).find(
        *sample, contact_sigma, link=touch.link, frame=arm.names[-1], dq=samples.dq[at].tolist()
    )
    given = found.places
    probability = [0.0] * len(arm.names)
    for link, share in last.links:
        probability[link] = share
    wrenches = _core.WrenchModel(arm.bundle)
    flange = wrenches.wrenches(
        arm.names[-1],
        *(np.array([one]) for one in sample),
        [0.0, 0.0, 0.0],
        contact_sigma_nm=said["contact_sigma_nm"][at : at + 1],
        dq=samples.dq[at : at + 1],
    )
    return row | {
        "probability": probability,
        "since_s": last.since_s,
        "moving": bool(np.abs(samples.dq[at]).max() > 0.01),
        "off_m": float(np.linalg.norm(np.subtract(given[0].on_link, touch.point_m))),
        "spread_m": given[0].spread_m,
        "said_n": float(np.linalg.norm(given[0].force)),
        "consistent": last.consistent,
        "ratio": float(np.abs(samples.true_nm[at] / said["limit_nm"][at]).max()),
        "flange_rejected": bool(flange["consistent"][0] < REJECTED),
        "at_flange": found.at_frame,
        "_q": samples.q[at],
        "_tau_ext": said["tau_ext"][at],
        "_true_nm": samples.true_nm[at],
    }
