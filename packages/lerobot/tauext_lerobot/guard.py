"""A guard against stalls of servo arms, and against grips beyond the declared one."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.config import NOT_EMPTY, within
from tauext.data.description import Arm, load_arm
from tauext.data.recording import Recording
from tauext.errors import ConfigError
from tauext.files.plain_file import read_toml
from tauext.files.typed_table import Text, read_table
from tauext.monitor.source import CountedTime

BUNDLE, ARM, SETTINGS, CALIBRATION = "arm.tauext", "arm.toml", "guard.toml", "calibration.json"
"""Files of a guard's folder; the last is a copy of LeRobot's, where arm.toml needs one."""
HOLD_S = 0.3
"""Time of a stall before it is reported. Transients of free motion end sooner; motors burn in seconds."""
STILL_RAD = math.radians(1.0)
"""Largest travel of a joint that stalls: the backlash of a small servo."""
POSES = 2.0
"""Factor on the torque that training held at rest, since other poses and friction need more."""
MARGIN = 1.1
"""Factor on the largest torque of training, since minutes do not contain the largest of all motion."""
RELEASE_S = 0.5
"""Time without a stall after which it is over."""
BLIND_S = 2.0
"""Time without an estimate after which the guard reports that it does not guard; a warm-up takes up to a second."""

Amount = Annotated[float, within(0, 1e6)]


@dataclass(frozen=True)
class Usual:
    """Torque of a joint's motor in the training data, in the unit of tau_ext."""

    held: Amount
    """Largest that it held at rest for HOLD_S."""
    largest: Amount
    """Largest at any time."""


@dataclass(frozen=True)
class Grip:
    """Declared contact of the gripper: a torque of this joint alone."""

    joint: Text
    at_most_nm: Annotated[float, within(1e-6, 1e6)]
    """Largest torque, in the unit of the joint's tau_ext."""


@dataclass(frozen=True)
class GuardSettings:
    """Settings of a guard: its file."""

    joints: Annotated[dict[str, Usual], NOT_EMPTY]
    grip: Grip | None = None
    hold_s: Annotated[float, within(0.02, 10)] = HOLD_S


@dataclass(frozen=True)
class GuardEvent:
    """A stall or grip that begins or ends, or a guard that lost or regained its estimate."""

    kind: Literal["stall", "grip", "over", "blind", "guards"]
    """stall: a joint stalls. grip: the gripper pushes harder than declared. over: the joint is free again. blind: there
    is no estimate, so nothing is guarded. guards: there is one again."""
    t_ns: int
    joint: str = ""
    torque: float = math.nan
    """Torque of the motor, in the unit of tau_ext."""
    most: float = math.nan
    """Largest torque that is no stall."""
    unit: str = ""
    causes: tuple[str, ...] = ()

    def __str__(self) -> str:
        if self.kind == "blind":
            return f"the guard has no estimate: {', '.join(self.causes) or 'no sample'}; nothing is guarded"
        if self.kind == "guards":
            return "the guard has an estimate again"
        if self.kind == "over":
            return f"{self.joint} is free again"
        what = "stalls" if self.kind == "stall" else "grips beyond the expected torque"
        return f"{self.joint} {what}: {self.torque:.2g} {self.unit}, at most {self.most:.2g} {self.unit} is usual"


@dataclass
class StallRule:
    """Finds joints that exceed a torque for hold_s without moving by more than STILL_RAD."""

    joints: int
    hold_ns: int
    _since_ns: np.ndarray = field(init=False)
    _from: np.ndarray = field(init=False)
    _was: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self._since_ns, self._from = np.zeros(self.joints, np.int64), np.zeros(self.joints)
        self._was = np.zeros(self.joints, bool)

    def step(self, t_ns: int, q: np.ndarray, over: np.ndarray) -> np.ndarray:
        """Joints that stall at this sample, (joints,) bool.

        Args:
            t_ns: counted time of the sample, which never jumps.
            over: whether a joint exceeds its torque at this sample.
        """
        begins = over & (~self._was | (np.abs(q - self._from) > STILL_RAD))
        self._since_ns[begins] = t_ns
        self._from[begins] = q[begins]
        self._was = over
        return over & (t_ns - self._since_ns >= self.hold_ns)


class Guard:
    r"""Runs a bundle sample by sample and reports stalls.

    A joint stalls if it does not travel by more than STILL_RAD for hold_s and, all that time,

    .. math:: |\tau| > 1.1 m \quad\text{or}\quad |\tau| > 2 h + L \;\text{and}\; |\tau_{ext} - c| > L

    with the motor's torque :math:`\tau`, its largest in training m, the largest h that it held there at rest, and the
    collision limit L. Where training had fast motion, m is high and the second condition finds stalls of less torque.
    h keeps it from poses that training lacks: there tau_ext is wrong, but the motor's torque is usual. For the gripper,
    the declared grip takes the place of m and 2 h, and explains the part c of tau_ext.

    Raises:
        ConfigError: the settings' joints or grip do not fit the bundle.
    """

    def __init__(self, bundle: _core.Bundle, settings: GuardSettings):
        self.joints = tuple(link.joint_name for link in bundle.links)
        """Names, in the bundle's order."""
        if settings.joints.keys() != set(self.joints):
            named = ", ".join(settings.joints)
            raise ConfigError(f"[joints] names {named}; it must name {', '.join(self.joints)}")
        if settings.grip is not None and settings.grip.joint not in self.joints:
            raise ConfigError(
                f"[grip] joint = '{settings.grip.joint}' must be one of the bundle's joints: {', '.join(self.joints)}"
            )
        self.settings = settings
        self._units = tuple(bundle.estimate_units)
        self._nm_per_unit = nm_per_unit(bundle)
        self._grip = -1 if settings.grip is None else self.joints.index(settings.grip.joint)
        usual, g = [settings.joints[joint] for joint in self.joints], self._grip
        self._rest = POSES * np.array([one.held for one in usual])
        self._largest = MARGIN * np.array([one.largest for one in usual])
        if settings.grip is not None:
            self._rest[g], self._largest[g] = settings.grip.at_most_nm, MARGIN * settings.grip.at_most_nm
        self._guarded = np.isfinite(bundle.sliding_limit_nm)  # others never moved in training
        self._bundle = bundle
        self.reset()

    def reset(self) -> None:
        """Begin with the next sample as a new guard: the monitor warms up."""
        self._monitor = _core.Monitor(self._bundle)
        if (grip := self.settings.grip) is not None:
            self._monitor.expect_contact(_core.DeclaredContact(joint=grip.joint, at_most_nm=grip.at_most_nm))
        n = len(self.joints)
        self._rule = StallRule(n, round(self.settings.hold_s * 1e9))
        self._time = CountedTime(self._bundle.observer.sample_period_ns)
        self._last_ns = np.zeros(n, np.int64)
        self._stalls = np.zeros(n, bool)
        self._known_ns: int | None = None
        self._blind = False
        self.torque = np.full(n, math.nan)
        """Torque of the motors at the last sample, in the unit of tau_ext."""

    @property
    def stalled(self) -> tuple[str, ...]:
        """Joints whose stall or grip is not over."""
        return tuple(self.joints[j] for j in np.flatnonzero(self._stalls))

    def usual(self, joint: str) -> float:
        """Torque that is usual at rest: the largest that training held, or the declared grip; unit of tau_ext."""
        grip = self.settings.grip
        return grip.at_most_nm if grip is not None and grip.joint == joint else self.settings.joints[joint].held

    def step(self, t_ns: int, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> list[GuardEvent]:
        """Events of the next sample, in the units of the bundle's recordings."""
        estimate = self._monitor.step(t_ns, q, dq, tau)
        tau_ext, limit = np.array(estimate.tau_ext), np.array(estimate.limit_nm)
        self.torque = np.abs(tau) * self._nm_per_unit
        unexplained = np.array(estimate.margin_nm) < 0  # false where there is no estimate
        most = np.where(unexplained, np.fmin(self._rest + limit, self._largest), self._largest)
        over = self._guarded & np.isfinite(tau_ext) & (self.torque > most)
        now_ns = self._time.step(t_ns)
        stalls = self._rule.step(now_ns, q, over)
        events = list(self._sight(t_ns, now_ns, bool(np.isfinite(tau_ext).all()), estimate.causes))
        for j in np.flatnonzero(stalls & ~self._stalls):
            kind: Literal["stall", "grip"] = "grip" if j == self._grip else "stall"
            events.append(GuardEvent(kind, t_ns, self.joints[j], float(self.torque[j]), float(most[j]), self._units[j]))
        self._last_ns[stalls] = now_ns
        ended = self._stalls & (now_ns - self._last_ns > RELEASE_S * 1e9)
        events += [GuardEvent("over", t_ns, self.joints[j]) for j in np.flatnonzero(ended)]
        self._stalls = (self._stalls | stalls) & ~ended
        return events

    def _sight(self, t_ns: int, now_ns: int, known: bool, causes: Sequence[str]) -> Iterator[GuardEvent]:
        if known or self._known_ns is None:
            self._known_ns = now_ns
        if known and self._blind:
            yield GuardEvent("guards", t_ns)
            self._blind = False
        elif not self._blind and now_ns - self._known_ns > BLIND_S * 1e9:
            yield GuardEvent("blind", t_ns, causes=tuple(causes))
            self._blind = True


def nm_per_unit(bundle: _core.Bundle) -> np.ndarray:
    """Factor of each joint from the recordings' torque to tau_ext, (joints,)."""
    factors = np.array(bundle.observer.nm_per_unit, dtype=float)
    return factors if len(factors) else np.ones(len(bundle.links))


def watch(bundle: _core.Bundle, settings: GuardSettings, recording: Recording) -> list[GuardEvent]:
    """Events of a new guard on a recording."""
    guard, events = Guard(bundle, settings), list[GuardEvent]()
    for row in zip(recording.t_ns.tolist(), recording.q, recording.dq, recording.tau, strict=True):
        events += guard.step(*row)
    return events


def held_at_rest(values: np.ndarray, q: np.ndarray, rate_hz: float, hold_s: float = HOLD_S) -> np.ndarray:
    """Largest value that each joint held for hold_s at rest, (joints,); 0 where it never rested.

    Args:
        values: amounts, (samples, joints); NaN counts as 0.
        q: positions, (samples, joints), [rad].
    """
    window = max(round(hold_s * rate_hz), 1) + 1
    if len(q) < window:
        return np.zeros(q.shape[1])
    still = np.ptp(sliding_window_view(q, window, axis=0), axis=-1) <= STILL_RAD
    least = sliding_window_view(np.nan_to_num(values), window, axis=0).min(axis=-1)
    return np.where(still, least, 0.0).max(axis=0)


# --- A guard's folder.


def load_guard(folder: Path) -> tuple[_core.Bundle, Arm, GuardSettings]:
    """Load the folder that `tauext guard` writes.

    Raises:
        ConfigError: a file breaks a rule; the message names file, key and rule.
    """
    path = folder / SETTINGS
    settings = read_table(GuardSettings, read_toml(path, "`tauext guard` writes the folder"), f"{path}:")
    motors = folder / CALIBRATION if (folder / CALIBRATION).is_file() else None
    arm = load_arm(folder / ARM, motors)
    return load_bundle(folder / BUNDLE), arm, settings
