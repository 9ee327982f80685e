"""Collisions of the planar rig: force pulses of known force, and padded bodies, by a schedule."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tauext.errors import ConfigError
from tauext_lab.sim.config import RigConfig
from tauext_lab.sim.rig import LINK_RADIUS_M, LINK_SPACING_M, low_pass, quintic

# --- Geometry of a planar arm: where its links are, and the joint torque of a force on one of them.


def link_frames(config: RigConfig, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins (samples, links, 2) as (x, z) in [m], and angles (samples, links) about +y in [rad], at positions q."""
    angle = np.cumsum(q, axis=1)
    along = np.stack([np.sin(angle), np.cos(angle)], axis=2)
    lengths = np.array([link.length_m for link in config.links])
    ends = np.cumsum(lengths[:, None] * along, axis=1)
    return ends - lengths[:, None] * along, angle


def to_world(vector: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Turn (x, z) vectors (samples, 2) by the angles (samples,) about +y."""
    c, s = np.cos(angle), np.sin(angle)
    x, z = vector[..., 0], vector[..., 1]
    return np.stack([c * x + s * z, c * z - s * x], axis=-1)


def force_torque(config: RigConfig, q: np.ndarray, link: int, force: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Joint torque J^T f, (samples, joints) in [N m], of a force on `link`; force and point as (x, z) in the world.

    tau_j is the moment about joint j, (p - o_j) x f along +y; joints beyond the touched link feel nothing.
    """
    origins, _ = link_frames(config, q)
    arm = point[:, None, :] - origins
    torque = arm[..., 1] * force[:, None, 0] - arm[..., 0] * force[:, None, 1]
    torque[:, link + 1 :] = 0.0
    return torque


# --- When a recording's collisions happen: far enough apart that each is judged alone.


def log_uniform(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    """One draw whose logarithm is uniform between the bounds."""
    return float(np.exp(rng.uniform(*np.log(bounds))))


def spread(lengths_s: list[float], total_s: float, gap_s: float, rng: np.random.Generator) -> np.ndarray:
    """Random start times of events of these lengths, in order, [s]: every gap, first and last too, at least gap_s.

    Raises:
        ConfigError: the events and their gaps do not fit into the recording.
    """
    slack = total_s - sum(lengths_s) - gap_s * (len(lengths_s) + 1)
    if slack < 0.0:
        raise ConfigError(
            f"collision_recording_s = {total_s:g} must hold {len(lengths_s)} collisions of {sum(lengths_s):.1f} s in "
            f"all and gaps of gap_s = {gap_s:g}: lengthen the recording or request fewer collisions"
        )
    before = np.cumsum([0.0, *lengths_s])[:-1]
    return before + gap_s * np.arange(1, len(lengths_s) + 1) + slack * np.sort(rng.uniform(size=len(lengths_s)))


# --- A padded body for each link: real contacts, from a body that meets the moving arm, pushes and leaves.


ASIDE_M = 0.3
"""Distance from the link's plane at which a pad waits and changes place."""
ENTER_S, CHANGE_S = 0.5, 0.8
"""Time to enter or leave the plane, and to change place before that; both lie in the gap between collisions."""


class Track:
    """A signal that rests between quintic moves."""

    def __init__(self, samples: int, rate_hz: int, value: float) -> None:
        self.values = np.full(samples, float(value))
        self.rate_hz = rate_hz

    def move(self, start_s: float, length_s: float, target: float) -> None:
        """Go from where it rests to `target`; what follows rests there."""
        first = max(0, round(start_s * self.rate_hz))
        done, _ = quintic((np.arange(first, len(self.values)) / self.rate_hz - start_s) / length_s)
        self.values[first:] += (target - self.values[first:]) * done


def draw_pads(config: RigConfig, q_free: np.ndarray, settle: int, rng: np.random.Generator) -> np.ndarray:
    """Controls of the pads over a recording, (samples, 6 * links): per pad x, y, z the pair (position, velocity).

    A pad's path is planned in its link's frame, along the path `q_free` (samples, joints) that the arm takes untouched:
    wait aside, enter the plane at `clearance_m`, approach to `depth_m` past the surface, hold, withdraw, leave. The
    first `settle` samples count as no part of the recording.

    Raises:
        ConfigError: the gap between collisions is too short to change place, or the recording for its collisions.
    """
    if config.gap_s < 2.0 * ENTER_S + CHANGE_S:
        raise ConfigError(
            f"gap_s = {config.gap_s:g} must be >= {2.0 * ENTER_S + CHANGE_S:g}: a pad changes place in it"
        )
    pads, samples, rate = config.pads, len(q_free), config.rate_hz
    events = [_draw_push(config, rng) for _ in range(config.collisions_per_recording)]
    lengths = [approach + hold + approach for approach, hold, *_ in events]
    starts = settle / rate + spread(lengths, (samples - settle) / rate, config.gap_s, rng)
    tracks = [{name: Track(samples, rate, value) for name, value in _at_rest(config).items()} for _ in config.links]
    for start, (approach, hold, link, side, place, depth) in zip(starts, events, strict=True):
        track = tracks[link]
        leave, away = start + approach + hold, side * _surface_m(config)
        change = start - ENTER_S - CHANGE_S
        track["along"].move(change, CHANGE_S, place)
        track["across"].move(change, CHANGE_S, away + side * pads.clearance_m)
        track["aside"].move(start - ENTER_S, ENTER_S, 0.0)
        track["across"].move(start, approach, away - side * depth)
        track["across"].move(leave, approach, away + side * pads.clearance_m)
        track["aside"].move(leave + approach, ENTER_S, 1.0)
    origins, angles = link_frames(config, q_free)
    controls = np.empty((samples, len(tracks), 3, 2))
    for link, track in enumerate(tracks):
        in_link = np.column_stack([track["across"].values, track["along"].values])
        in_world = origins[:, link] + to_world(in_link, angles[:, link])
        plane = link * LINK_SPACING_M + _exit_side(link) * ASIDE_M * track["aside"].values
        controls[:, link, :, 0] = np.column_stack([in_world[:, 0], plane, in_world[:, 1]])
    controls[..., 1] = np.gradient(controls[..., 0], 1.0 / rate, axis=0)
    return controls.reshape(samples, -1)


def contact_torque(config: RigConfig, q: np.ndarray, touch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """True tau_ext = J^T f (samples, joints) and force on each link (samples, links), from the contact sensors."""
    tau_ext = np.zeros_like(q)
    for link in range(touch.shape[1]):
        force, point = touch[:, link, 1:4:2], touch[:, link, 7:10:2]
        tau_ext += force_torque(config, q, link, force, point)
    return tau_ext, np.linalg.norm(touch[:, :, 1:4], axis=2)


def _draw_push(config: RigConfig, rng: np.random.Generator) -> tuple[float, float, int, int, float, float]:
    """One push: approach and hold times, link, side (+1 or -1 along the link's x), place along it, depth."""
    pads = config.pads
    depth = log_uniform(rng, pads.depth_m)
    approach = 15.0 / 8.0 * (pads.clearance_m + depth) / log_uniform(rng, pads.speed_m_s)
    hold = log_uniform(rng, pads.hold_s)
    link, side = int(rng.integers(len(config.links))), int(1 - 2 * rng.integers(2))
    return approach, hold, link, side, rng.uniform(*pads.place) * config.links[link].length_m, depth


def _surface_m(config: RigConfig) -> float:
    """Distance between the axis of a link and the centre of a pad that just touches it."""
    return LINK_RADIUS_M + config.pads.radius_m


def _at_rest(config: RigConfig) -> dict[str, float]:
    """Where a pad waits before its first push: across and along its link, and aside of the plane (share of ASIDE_M)."""
    return {"across": _surface_m(config) + config.pads.clearance_m, "along": 0.5 * config.links[0].length_m, "aside": 1}


def _exit_side(link: int) -> float:
    """The first link's pad leaves toward -y, the last link's toward +y, so that neither crosses the other link."""
    return -1.0 if link == 0 else 1.0


# --- Force pulses: collisions whose force is known beforehand, on a link and moving with it.


SHAPES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "half_sine": lambda s: np.sin(np.pi * s),
    "smooth": lambda s: np.sin(np.pi * s) ** 2,
    "rectangle": lambda s: np.minimum(1.0, 10.0 * np.minimum(s, 1.0 - s)),
    "triangle": lambda s: 1.0 - np.abs(2.0 * s - 1.0),
    "strike": lambda s: np.minimum(s / 0.1, (1.0 - s) / 0.9),
    "swell": lambda s: np.minimum(s / 0.8, (1.0 - s) / 0.2),
}
"""Force over share s of a pulse's length, 0 < s < 1, peak 1. A rectangle's edges take a tenth of the length each."""


@dataclass(frozen=True)
class Pulse:
    """One force pulse; its place and direction stay fixed in the link's frame."""

    shape: str
    height_n: float
    length_s: float
    link: int
    place_m: float
    angle_rad: float
    """Direction of the force from the link's +x, toward its +z."""

    def wrench(self, rate_hz: int) -> np.ndarray:
        """Force x, force z and moment about +y at the link's joint, in its frame, (samples, 3); no sample is zero."""
        samples = max(1, round(self.length_s * rate_hz))
        level = self.height_n * SHAPES[self.shape]((np.arange(samples) + 0.5) / samples)
        x, z = np.cos(self.angle_rad), np.sin(self.angle_rad)
        return level[:, None] * [x, z, self.place_m * x]


def expected_peak(config: RigConfig, pulse: Pulse, q: np.ndarray) -> float:
    """Largest joint torque that the sensor reference would show if the pulse met the arm held at q (joints,), [N m]."""
    wrench = pulse.wrench(config.rate_hz)
    controls = np.zeros((len(wrench) + 1, 3 * len(config.links)))
    controls[1:, 3 * pulse.link : 3 * pulse.link + 3] = wrench
    torque, _ = pulse_torque(config, np.tile(q, (len(controls), 1)), controls)
    return float(np.abs(low_pass(torque, config.sensors.reference_cutoff_rad_s, 1.0 / config.rate_hz)).max())


def draw_pulses(config: RigConfig, q_des: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Controls of the pulse actuators over a recording, (samples, 3 * links): per link fx, fz, torque about +y."""
    controls = np.zeros((len(q_des), 3 * len(config.links)))
    lengths = [log_uniform(rng, config.pulses.length_s) for _ in range(config.collisions_per_recording)]
    for start_s, length_s in zip(spread(lengths, len(q_des) / config.rate_hz, config.gap_s, rng), lengths, strict=True):
        first = round(start_s * config.rate_hz)
        pulse = _sized_pulse(config, length_s, q_des[first], rng)
        wrench = pulse.wrench(config.rate_hz)
        controls[first : first + len(wrench), 3 * pulse.link : 3 * pulse.link + 3] = wrench
    return controls


def pulse_torque(config: RigConfig, q: np.ndarray, controls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """True tau_ext = J^T f (samples, joints) of these controls at the true q, and the force on each link, [N]."""
    origins, angles = link_frames(config, q)
    tau_ext, forces = np.zeros_like(q), np.zeros_like(q)
    for link in range(len(config.links)):
        force, moment = controls[:, 3 * link : 3 * link + 2], controls[:, 3 * link + 2]
        tau_ext += force_torque(config, q, link, to_world(force, angles[:, link]), origins[:, link])
        tau_ext[:, : link + 1] += moment[:, None]
        forces[:, link] = np.linalg.norm(force, axis=1)
    return tau_ext, forces


def _sized_pulse(config: RigConfig, length_s: float, q: np.ndarray, rng: np.random.Generator) -> Pulse:
    """A pulse on the arm at q whose expected peak lies in `peak_nm`: drawn again until it does."""
    low, high = config.pulses.peak_nm
    for _ in range(1000):
        pulse = _draw_pulse(config, length_s, rng)
        if low <= expected_peak(config, pulse, q) <= high:
            return pulse
    raise ConfigError(
        f"peak_nm = ({low:g}, {high:g}) must be within reach of pulses of height_n = {config.pulses.height_n} "
        f"that last {length_s:.3f} s"
    )


def _draw_pulse(config: RigConfig, length_s: float, rng: np.random.Generator) -> Pulse:
    """A random pulse of this length on a random link, from either side."""
    pulses = config.pulses
    link = int(rng.integers(len(config.links)))
    lean = np.deg2rad(rng.uniform(-pulses.cone_deg, pulses.cone_deg))
    return Pulse(
        shape=list(SHAPES)[rng.integers(len(SHAPES))],
        height_n=rng.uniform(*pulses.height_n),
        length_s=length_s,
        link=link,
        place_m=rng.uniform(*pulses.place) * config.links[link].length_m,
        angle_rad=lean + np.pi * rng.integers(2),
    )
