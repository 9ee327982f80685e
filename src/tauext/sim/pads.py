"""A padded body for each link: real contacts, from a body that meets the moving arm, pushes and leaves."""

import numpy as np

from tauext.errors import ConfigError
from tauext.sim.arm import LINK_RADIUS_M, LINK_SPACING_M
from tauext.sim.config import RigConfig
from tauext.sim.motions import quintic
from tauext.sim.planar import force_torque, link_frames, to_world
from tauext.sim.schedule import log_uniform, spread

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
