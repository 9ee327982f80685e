"""Limits during declared contacts: by how much what a contact explains may be wrong.

What is explained is wrong by a share of it: `declared_spread` of the bundle is how many standard errors of that share
are admitted, by a rest that stands and by limits that rise while the force changes. A joint that rests meanwhile may
hide its friction, too; noticed_standing() is what is then noticed.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from tauext import _core
from tauext.bundle.estimates import COLLISION
from tauext.data.free_motion import free_pieces
from tauext.data.recording import Recording
from tauext.errors import ConfigError
from tauext.fit.tail import duration, upper_rate
from tauext.train.hits import end_and_forearm, kept_poses, points, torques
from tauext.train.wrench import outermost

Contacts = Sequence[tuple[_core.DeclaredContact, int, float]]
"""Contact, start [ns] and duration [s], by rising start."""


@dataclass(frozen=True)
class SpreadConfig:
    """How the spread is found, and the tool that presses in free motion where no declared contacts are recorded."""

    usual: float = 3.0
    """Spread without a measurement: by errors of their torque constants, 98 of 100 arms of seven joints stay within
    it. A smaller one detects more beside a contact."""
    enough_h: float = 1.0
    """Hours of declared contact from which on a spread below `usual` is believed, [h]."""
    tried: tuple[float, ...] = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 9.0, 14.0, 20.0)
    """Spreads that are tried, from the smallest on."""
    force_n: tuple[float, float] = (5.0, 60.0)
    """Least and largest force that is added, [N]."""
    of_largest: float = 0.5
    """Share of the largest torque of training beyond which no force loads a joint."""
    rubbing: float = 0.04
    """Gear friction under a load, as a share of it: 2 to 6 % (Bittencourt et al. 2010)."""


@dataclass(frozen=True)
class SpreadFound:
    """The spread of a bundle, and the motion behind it."""

    spread: float
    needed: float
    """Least spread of those tried without a false collision."""
    hours: float
    """In which a declared force acted."""
    injected: bool
    """Whether forces were added to free motion."""

    def facts(self) -> dict:
        return asdict(self) | {"sentence": self.sentence()}

    def sentence(self) -> str:
        """What is promised during declared contacts."""
        if not self.hours:
            return "no expected contact acted in these recordings: thresholds during expected contacts stay as they are"
        how = "of tool forces added to free motion" if self.injected else "of expected contacts"
        rate = float(format(upper_rate(0, self.hours), ".2g"))
        return (
            f"during an expected contact what is explained may be wrong by {self.spread:g} of its standard errors: no "
            f"false collision in {duration(self.hours)} {how}, at most {rate:g} an hour (95%)"
        )


def needed(
    bundle: _core.Bundle,
    recording: Recording,
    contacts: Contacts,
    threads: int = 0,
    tried: Sequence[float] = SpreadConfig.tried,
) -> tuple[float, float]:
    """Least spread of those tried without a false collision in this recording, infinite if there is none, and the hours
    in which a declared force acted.

    Args:
        tried: spreads, from the smallest on.
    """
    own, threads, hours = _core.Bundle.from_bytes(bundle.to_bytes()), threads or os.cpu_count() or 1, 0.0
    for spread in tried:
        own.declared_spread = spread
        found = _core.estimate(own, *recording.signals, threads, recording.temperature, contacts=contacts)
        acts = found["declared_size"] > 2 * found["declared_sigma"]
        hours = float(acts.sum() / recording.rate_hz / 3600)
        if not ((found["held_alarm"] == COLLISION) & (found["declared"] > 0)).any():
            return spread, hours
    return math.inf, hours


def put_spread(
    bundle: _core.Bundle,
    motion: Iterable[tuple[Recording, Contacts]],
    injected: bool,
    threads: int = 0,
    config: SpreadConfig = SpreadConfig(),
) -> SpreadFound:
    """Set the bundle's spread so that this motion has no false collision.

    It falls below the usual one by hours of declared contacts only, not by injected forces, whose errors are drawn.

    Raises:
        ConfigError: no spread is enough for declared contacts. With injected forces such a recording is left out.
    """
    most, hours = 0.0, 0.0
    for recording, contacts in motion:
        of_this, time_h = needed(bundle, recording, contacts, threads, config.tried)
        if math.isinf(of_this) and injected:
            continue  # a false alarm of free motion: a glitch, say
        if math.isinf(of_this):
            raise ConfigError(
                f"{recording.name}: the expected contact leaves torques over the thresholds, even with "
                f"{config.tried[-1]:g} standard errors of what it explains: something hits the arm, or the contact is "
                "not as declared"
            )
        most, hours = max(most, of_this), hours + time_h
    if hours:
        bundle.declared_spread = max(most, 0.0 if not injected and hours >= config.enough_h else config.usual)
    return SpreadFound(bundle.declared_spread, most, hours, injected)


# --- Tool forces added to free motion.


def pressed(
    bundle: _core.Bundle, recording: Recording, rng: np.random.Generator, config: SpreadConfig = SpreadConfig()
) -> tuple[Recording, _core.DeclaredContact, float] | None:
    """The recording with a tool that presses, off and on, its declared contact and its force, [N]; None: no joint shows
    a force.

    A stiff arm keeps its path, so the motors take the force up, as in `Injection`. Torque constants are wrong by their
    standard errors, drawn for this recording, and gear friction grows with the load.
    """
    model = _core.WrenchModel(bundle)
    if model.refused:
        return None
    frame, way = outermost(bundle), rng.standard_normal(3)
    way /= np.linalg.norm(way)
    lever = np.array([way @ model.columns(frame, q)[:3] for q in recording.q.tolist()])
    reach = np.abs(lever).max(axis=0)
    joints = np.array(bundle.in_newtons) & np.isfinite(bundle.largest_torque_nm)
    strong = np.array(bundle.largest_torque_nm)[joints] / np.maximum(reach[joints], 1e-9)
    most_n = min(config.force_n[1], config.of_largest * float(np.min(strong, initial=np.inf)))
    if not (reach[joints] > 1e-3).any():
        return None
    force_n = rng.uniform(min(config.force_n[0], most_n), most_n)
    share = np.array([bundle.wrench_settings.own_share(j) for j in range(bundle.joints)])
    # It presses for 5 s and lifts for 1 s; its force rises and falls within 0.2 s.
    of_cycle = np.mod(recording.time_s - rng.uniform(0, 5.0), 6.0)
    shape = np.clip(np.minimum(of_cycle, 5.0 - of_cycle) / 0.2, 0.0, 1.0)
    torque = force_n * shape[:, None] * lever
    torque[:, ~np.array(bundle.in_newtons)] = 0
    measured = (1 + rng.normal(0, share)) * torque - config.rubbing * np.abs(torque) * np.tanh(recording.dq / 0.05)
    tau = recording.tau - measured / np.array(bundle.observer.nm_per_unit or 1.0)
    bounds = {"frame": frame, "axis": way.tolist(), "axes": _core.WrenchAxes.base, "at_most_n": 1.25 * force_n}
    monitor = _core.Monitor(bundle)
    for half_angle_deg in (30.0, 0.0):
        contact = _core.DeclaredContact(**bounds, half_angle_deg=half_angle_deg)
        if not monitor.why_no_contact(contact):
            touched = replace(recording, tau=tau, contact=None, contact_link=None, tau_ext=None, tau_ext_sensor=None)
            return touched, contact, force_n
    return None


def with_tool_forces(
    bundle: _core.Bundle, loaders: Sequence[Callable[[], Recording]], most_hours: float = 1.0
) -> Iterable[tuple[Recording, Contacts]]:
    """Some hours of these recordings' free motion with a tool that presses; each has a force and errors of its own."""
    hours = 0.0
    for number, load in enumerate(loaders):
        if hours >= most_hours:
            return
        for k, recording in enumerate(free_pieces([load()])):
            hours += recording.duration_s / 3600
            found = pressed(bundle, recording, np.random.default_rng([0, number, 65] + [k] * (k > 0)))
            if found is not None:
                yield found[0], [(found[1], int(recording.t_ns[0]), math.inf)]


# --- What is noticed while the tool presses and the arm stands.


STANDS_S = 0.7
"""Time constant with which the core follows what a resting joint hides: DeclaredContacts::kStandsS, [s]."""


def noticed_standing(bundle: _core.Bundle, poses: Sequence[Sequence[float]] | None = None) -> dict:
    """Facts of pushes that are noticed at rest during a declared contact; empty where no forces can be estimated, or
    none is noticed.

    A push that rises slowly is noticed on a resting joint from its limit and the friction that it may hide, a sudden
    one from its limit and what is followed meanwhile. Each is the median over directions and poses, beside what the
    contact itself explains.

    Args:
        poses: (poses, joints); None: those that the bundle keeps.
    """
    if _core.WrenchModel(bundle).refused:
        return {}
    q = kept_poses(bundle) if poses is None else np.asarray(poses, dtype=float)
    if not len(q):
        return {}
    limit_nm = np.maximum(bundle.near_stiction_limit_nm, 1e-9)
    hidden_nm = np.array([bundle.prior.friction_at_rest_nm(j) for j in range(bundle.joints)])
    faster = max(bundle.observer.gain_per_s * STANDS_S, 1.001)
    left = faster ** (-1 / (faster - 1))  # most of a step that the observer shows before it is followed
    ends, facts = points(bundle), []
    for point in (ends[k] for k in end_and_forearm(ends)):
        felt = np.abs(torques(bundle, q, point))
        with np.errstate(divide="ignore"):
            slow_n, sudden_n = (
                float(np.median(1 / (felt / nm).max(axis=2))) for nm in (limit_nm + hidden_nm, limit_nm / left)
            )
        if np.isfinite(slow_n):  # else most directions load no monitored joint
            facts.append({"at": point.name, "slow_n": slow_n, "sudden_n": min(sudden_n, slow_n)})
    if not facts:
        return {}
    words = ", ".join(f"from {one['slow_n']:.0f} N at the {one['at']} ({one['sudden_n']:.0f} N)" for one in facts)
    return {
        "places": facts,
        "sentence": "at rest in an expected contact, where a resting joint may hide its friction, pushes are detected "
        f"{words}; in brackets sudden ones",
    }
