"""Force pulses: collisions whose force is known beforehand, on a link and moving with it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tauext.errors import ConfigError
from tauext.sim.config import RigConfig
from tauext.sim.planar import force_torque, link_frames, to_world
from tauext.sim.schedule import log_uniform, spread
from tauext.sim.sensors import low_pass

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
