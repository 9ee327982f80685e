"""Feedback torque of a leader arm from contacts of its follower, made passive by an energy tank."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from tauext.errors import ConfigError

# --- Feedback torque of a leader's motors from contacts of the follower: 0 in free motion, and passive.


PerJoint = float | tuple[float, ...]
"""One number for all joints or one a joint."""


@dataclass(frozen=True)
class FeedbackSettings:
    """Settings of the leader's torque from the follower's tau_ext; a single number applies to all joints."""

    gain: PerJoint = 1.0
    """Torque of the leader per tau_ext beyond the dead band: [N m] over its unit; negative if the leader's joint turns
    the other way."""
    cap_nm: PerJoint = 0.1
    """Largest torque of the leader's motors, [N m]: a tenth of that of small servos, which a hand easily resists."""
    dead_band_sigmas: PerJoint = 8.0
    """Half width of the dead band in standard errors of tau_ext. Friction errors have heavier tails than a normal
    distribution; `free_motion_sigmas` computes the value for an arm."""
    least_dead_band: PerJoint = 0.0
    """Least half width of the dead band, in the unit of tau_ext; the whole dead band where sigma is 0."""
    dead_band_fade_s: float = 0.1
    """Time constant with which the dead band narrows, [s]; it widens at once. sigma falls with the motion, but the
    observer keeps the earlier error for 1/K0."""
    slew_nm_s: PerJoint = 10.0
    """Fastest change of the torque, [N m/s], also when it fades after a fault."""
    damping_nm_s_rad: PerJoint = 0.0
    """Damping of the leader's motion during feedback, in full at the cap, [N m s/rad]."""
    tank_j: float = 0.03
    """Initial and largest energy of the tank, [J]: the most that a release may return at once."""
    friction_nm: PerJoint = 0.0
    """Constant friction of the leader's gears, [N m]; the motors may supply the energy that it dissipates."""
    acceleration_rad_s2: float = 20.0
    """Largest acceleration of a leader's joint in a hand, [rad/s^2]; feedback fades in rougher motion."""
    rest_w: float = 0.002
    """Power into the tank while the leader rests, [W], so that a steady press is fed back in full; 0: none."""
    rest_s: float = 0.25
    """Time without motion after which the leader rests, [s]: longer than an oscillation's pause at its reversals."""
    rest_rad: float = 0.005
    """Largest travel at rest, [rad]: three steps of a 12-bit encoder."""

    def __post_init__(self) -> None:
        positive = ("cap_nm", "dead_band_fade_s", "slew_nm_s", "tank_j", "acceleration_rad_s2", "rest_s", "rest_rad")
        for field in fields(self):
            value = getattr(self, field.name)
            numbers = value if isinstance(value, tuple) else (value,)
            if field.name == "gain":
                ok, rule = all(math.isfinite(v) and v != 0 for v in numbers), "finite and not 0"
            elif field.name in positive:
                ok, rule = all(0 < v < math.inf for v in numbers), "> 0 and finite"
            else:
                ok, rule = all(0 <= v < math.inf for v in numbers), ">= 0 and finite"
            if not ok or not numbers:
                raise ConfigError(f"{field.name} = {value} must be {rule}")

    def of_joints(self, name: str, joints: int) -> np.ndarray:
        """The setting `name` as an array, (joints,); ConfigError where it has another count."""
        value = np.array(getattr(self, name), dtype=float)
        if value.ndim and len(value) != joints:
            raise ConfigError(f"{name} has {len(value)} values and the arm {joints} joints: give one, or one a joint")
        return np.broadcast_to(value, (joints,)).copy()


class EnergyTank:
    r"""Energy that the leader's motors may still supply, and the torques that it allows.

    Torques u held over a tick, while the joints move by :math:`\Delta q`, give the hand exactly the energy :math:`u
    \cdot \Delta q`, independent of their origin and delay: follower, wall and delay are a black box behind the leader's
    motors. That energy is observed [HannafordRyu2002]_ from positions [Stramigioli2005]_:

    .. math:: E_k = \min(E_{most}, E_{k-1} - u_{k-1} \cdot \Delta q_k + \sum_i f_i |\Delta q_{k,i}| + p_k)

    f is the Coulomb friction of the leader's gears, a lower bound of dissipation. p_k is a small inflow while the
    leader rests, and 0 otherwise: without it, a press that began with a bounce would stay weak until the leader moves.
    The tank limits the next torques as in the passivity layer of [Franken2011]_:

    .. math:: \lambda \sum_i |u_i| \rho_i \le E_k, \quad \rho_i = sign(u_i) \Delta q_{k,i} + a \Delta t^2

    with one factor :math:`\lambda \le 1` for all joints, so that the direction of the feedback is kept; :math:`\rho_i`
    bounds the travel of joint i along its torque until the next tick. While no joint accelerates by more than a, E >=
    0: between two rests the torques supply no more energy than the tank had and the gears dissipated. A rougher motion
    may overdraw the tank; it then stays closed until the deficit is recovered.
    """

    def __init__(self, joints: int, settings: FeedbackSettings):
        """The tank is full at the start."""
        self.energy_j = settings.tank_j
        """Energy E in the tank, [J]."""
        self.given_j = 0.0
        """Energy given to the hand since the start, the sum of u dq, [J]."""
        self.share = 1.0
        """Factor on the torques since the last tick; 1: not limited by the tank."""
        self._settings, self._friction_nm = settings, settings.of_joints("friction_nm", joints)
        self._torque, self._moved = np.zeros(joints), np.zeros(joints)
        self._q, self._rest_q, self._rested_s = np.full(joints, np.nan), np.full(joints, np.nan), 0.0

    def settle(self, q: np.ndarray, dt_s: float) -> None:
        """Update the energy for the tick of dt_s that ends at the leader's position q, (joints,), [rad].

        Where q is NaN the joint counts as moved along the held torque as far as possible; the next known position
        restarts.
        """
        moved = q - self._q
        unknown = ~np.isfinite(moved)
        farthest = np.maximum(np.sign(self._torque) * self._moved, 0) + self._settings.acceleration_rad_s2 * dt_s**2
        work = float(np.sum(np.where(unknown, np.abs(self._torque) * farthest, self._torque * np.nan_to_num(moved))))
        self._q, self._moved = q.copy(), np.where(unknown, 0.0, moved)
        self.given_j += work
        taken = float(np.sum(self._friction_nm * np.abs(self._moved)))
        self.energy_j = min(self.energy_j - work + taken + self._trickle(dt_s), self._settings.tank_j)

    def hold(self, torque: np.ndarray, dt_s: float) -> np.ndarray:
        """Limit the torque, (joints,), [N m], by the tank's energy; the result counts as held for the next dt_s.

        0 for a joint whose position is unknown.
        """
        torque = np.where(np.isfinite(self._q), torque, 0.0)
        reach = np.sign(torque) * self._moved + self._settings.acceleration_rad_s2 * dt_s**2
        needed = float(np.sum(np.abs(torque) * reach))
        self.share = min(1.0, max(self.energy_j, 0.0) / needed) if needed > 0 else 1.0
        self._torque = self.share * torque
        return self._torque.copy()

    def _trickle(self, dt_s: float) -> float:
        """p_k, [J]: positive once every joint has stayed within rest_rad of one place for rest_s."""
        still = bool(np.all(np.abs(self._q - self._rest_q) <= self._settings.rest_rad))
        self._rested_s = self._rested_s + dt_s if still else 0.0
        if not still:
            self._rest_q = self._q.copy()
        return self._settings.rest_w * dt_s if self._rested_s > self._settings.rest_s else 0.0


class LeaderFeedback:
    r"""Torque of a leader's motors, tick by tick, from the monitor's estimates of the follower.

    .. math::
        w_k &= \max(k \sigma, b, w_{k-1} e^{-\Delta t / T}), \quad f = sign(\tau_{ext}) \max(0, |\tau_{ext}| - w_k) \\
        u^* &= clip(g f, \pm c), \quad d = u^* - D \dot q |u^*| / c \\
        u_k &= tank(u_{k-1} + clip(d - u_{k-1}, \pm s \Delta t))

    f is continuous in tau_ext: it is 0 at the edge w of the dead band. The tank (EnergyTank) makes the torque passive
    at the hand, so that no delay or wall can cause growing oscillations. **Sign:** with a positive gain the hand is
    pushed in the direction in which the surroundings push the follower.

    Faults cause no jumps: while the arm is not healthy, or tau_ext or sigma of a joint is NaN, the torque goes to 0 at
    the slew rate. Only a leader with unknown position gets 0 at once, since its energy cannot be observed.
    """

    def __init__(self, joints: int, settings: FeedbackSettings = FeedbackSettings()):
        """Raises ConfigError if a setting has another number of joints."""
        self._joints = joints
        self._gain, self._cap = settings.of_joints("gain", joints), settings.of_joints("cap_nm", joints)
        self._sigmas = settings.of_joints("dead_band_sigmas", joints)
        self._least = settings.of_joints("least_dead_band", joints)
        self._slew = settings.of_joints("slew_nm_s", joints)
        self._damping = settings.of_joints("damping_nm_s_rad", joints)
        self.tank = EnergyTank(joints, settings)
        """Energy tank of the motors."""
        self.torque_nm = np.zeros(joints)
        """Last commanded torque, (joints,), [N m]."""
        self._q: np.ndarray | None = None
        self._band, self._fade_s = self._least.copy(), settings.dead_band_fade_s

    def step(
        self, tau_ext: np.ndarray, sigma: np.ndarray, q_leader: np.ndarray, dt_s: float, healthy: bool = True
    ) -> np.ndarray:
        """Return the torque to hold until the next tick, (joints,), [N m].

        Args:
            tau_ext: latest estimate of the follower, (joints,), in a unit that the gain converts to N m.
            sigma: its standard error in free motion (Estimate.sigma_nm), the same unit.
            q_leader: present position of the leader, (joints,), [rad]; the velocity is its difference, since energy
                given by a held torque follows exactly only from positions.
            dt_s: time since the last call and until the next one, [s].
            healthy: whether the monitor's health is ok.

        Raises:
            ConfigError: dt_s is not a positive number, or an array has another number of joints.
        """
        tau_ext, sigma, q = (np.asarray(v, dtype=float) for v in (tau_ext, sigma, q_leader))
        for name, value in (("tau_ext", tau_ext), ("sigma", sigma), ("q_leader", q)):
            if value.shape != (self._joints,):
                raise ConfigError(f"{name} has shape {value.shape} and must have ({self._joints},)")
        if not 0 < dt_s < math.inf:
            raise ConfigError(f"dt_s = {dt_s} must be > 0 and finite")
        self.tank.settle(q, dt_s)
        wished = np.clip(self._gain * self._felt(tau_ext, sigma, dt_s), -self._cap, self._cap)
        velocity = (q - self._q) / dt_s if self._q is not None else np.zeros(self._joints)
        self._q = q.copy()
        wished = wished - self._damping * np.nan_to_num(velocity) * np.abs(wished) / self._cap
        wished = np.where(np.isfinite(wished) & healthy, np.clip(wished, -self._cap, self._cap), 0.0)
        most = self._slew * dt_s
        slewed = self.torque_nm + np.clip(wished - self.torque_nm, -most, most)
        self.torque_nm = self.tank.hold(slewed, dt_s)
        return self.torque_nm.copy()

    def _felt(self, tau_ext: np.ndarray, sigma: np.ndarray, dt_s: float) -> np.ndarray:
        """tau_ext beyond its dead band, (joints,), in its unit; NaN where tau_ext or sigma is NaN."""
        narrowed = np.maximum(self._band * math.exp(-dt_s / self._fade_s), self._least)
        self._band = np.fmax(self._sigmas * sigma, narrowed)  # NaN keeps the band
        beyond = np.maximum(np.abs(tau_ext) - self._band, 0)
        return np.where(np.isnan(sigma), np.nan, np.sign(tau_ext) * beyond)


def free_motion_sigmas(tau_ext: np.ndarray, sigma: np.ndarray, margin: float = 1.5) -> tuple[float, ...]:
    """Dead band of each joint in standard errors: the largest in free motion, times a margin.

    Args:
        tau_ext: estimates on free motion not in the training data, (samples, joints); rows with NaN are left out.
        sigma: its standard error there, (samples, joints).

    Raises:
        ConfigError: no sample has tau_ext and sigma.
    """
    known = np.isfinite(tau_ext) & np.isfinite(sigma) & (sigma > 0)
    if not known.any(axis=0).all():
        raise ConfigError(
            "the dead band needs samples of every joint with tau_ext and its standard error: there are none"
        )
    times = np.where(known, np.abs(tau_ext) / np.where(known, sigma, 1.0), 0.0)
    return tuple(float(most) for most in margin * times.max(axis=0))
