"""What keeps felt torques passive: a tank holds the energy that a leader's motors may still give to the hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class TankSettings:
    """How much energy a leader may give, and how its motion is judged; see EnergyTank."""

    most_j: float
    """What is allowed at first and kept at most, [J]."""
    friction_nm: np.ndarray
    """(joints,), no more than the leader's gears take at any time, [N m]."""
    acceleration_rad_s2: float
    """Most acceleration of a joint."""
    rest_w: float
    """What flows in while the leader rests, [W]."""
    rest_s: float
    """Time without motion after which it rests, [s]."""
    rest_rad: float
    """What is no motion, [rad]."""


class EnergyTank:
    r"""Energy that torques on a leader may still give away, and the torques that it allows.

    Torques u that are held over a tick, while the joints move by :math:`\Delta q`, give the hand exactly
    :math:`u \cdot \Delta q`, whatever made them and however late: follower, wall and delay are one black box behind the
    leader's motors. That energy is observed [HannafordRyu2002]_, by positions [Stramigioli2005]_:

    .. math:: E_k = \min(E_{most}, E_{k-1} - u_{k-1} \cdot \Delta q_k + \sum_i f_i |\Delta q_{k,i}| + p_k)

    f is the Coulomb friction of the leader's own gears, which takes at least that; p_k is a trickle while the leader
    rests, and 0 else: without it, a press that began with a bounce would stay weak until the leader moves. The next
    torques are as large as the tank can pay for, as in the passivity layer of [Franken2011]_:

    .. math:: \lambda \sum_i |u_i| \rho_i \le E_k, \quad \rho_i = sign(u_i) \Delta q_{k,i} + a \Delta t^2

    with one factor :math:`\lambda \le 1` for all joints, so that the direction of what is felt stays;
    :math:`\rho_i` is how far joint i may move along its torque until the next tick. So while no joint accelerates by
    more than a, E >= 0: between two rests the torques together give no more than the tank held and the gears took. A
    rougher motion may overdraw the tank by what it was rougher; then it stays shut until that is paid back.
    """

    def __init__(self, settings: TankSettings):
        """Full at the start."""
        joints = len(settings.friction_nm)
        self.energy_j = settings.most_j
        """E, [J]."""
        self.given_j = 0.0
        """Sum of u dq since the start, [J]: positive: the hand has got it."""
        self.share = 1.0
        """The factor on the torques since the last tick: 1 where the tank could pay for them."""
        self._settings = settings
        self._torque, self._moved = np.zeros(joints), np.zeros(joints)
        self._q, self._rest_q, self._rested_s = np.full(joints, np.nan), np.full(joints, np.nan), 0.0

    def settle(self, q: np.ndarray, dt_s: float) -> None:
        """Book the tick of dt_s that ends at the leader's position q, (joints,), [rad].

        Where q is NaN the held torque counts as if the joint had moved along it as far as it may have; the next
        position that is known begins anew.
        """
        moved = q - self._q
        unknown = ~np.isfinite(moved)
        farthest = np.maximum(np.sign(self._torque) * self._moved, 0) + self._settings.acceleration_rad_s2 * dt_s**2
        work = float(np.sum(np.where(unknown, np.abs(self._torque) * farthest, self._torque * np.nan_to_num(moved))))
        self._q, self._moved = q.copy(), np.where(unknown, 0.0, moved)
        self.given_j += work
        taken = float(np.sum(self._settings.friction_nm * np.abs(self._moved)))
        self.energy_j = min(self.energy_j - work + taken + self._trickle(dt_s), self._settings.most_j)

    def hold(self, torque: np.ndarray, dt_s: float) -> np.ndarray:
        """What of the torque, (joints,), [N m], the tank can pay for over the next dt_s; it counts as held so long.

        0 for a joint whose position is not known.
        """
        torque = np.where(np.isfinite(self._q), torque, 0.0)
        reach = np.sign(torque) * self._moved + self._settings.acceleration_rad_s2 * dt_s**2
        asked = float(np.sum(np.abs(torque) * reach))
        self.share = min(1.0, max(self.energy_j, 0.0) / asked) if asked > 0 else 1.0
        self._torque = self.share * torque
        return self._torque.copy()

    def _trickle(self, dt_s: float) -> float:
        """p_k, [J]: once no joint has been farther than rest_rad from one place for rest_s."""
        still = bool(np.all(np.abs(self._q - self._rest_q) <= self._settings.rest_rad))
        self._rested_s = self._rested_s + dt_s if still else 0.0
        if not still:
            self._rest_q = self._q.copy()
        return self._settings.rest_w * dt_s if self._rested_s > self._settings.rest_s else 0.0
