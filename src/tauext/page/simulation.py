"""A simulated arm with its mover, its push, its load and its monitors, one sample after the other."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.data.recording import Recording
from tauext.errors import ConfigError, TauextError
from tauext.monitor.weighing import LoadEstimate, between, expect_weighable, identify, load_frame, load_sentences, see
from tauext.page.snapshot import Event, Hand, Placed, Places, Snapshot, Touch, Verdict, ball
from tauext.sim.arms import DemoArm
from tauext.sim.plant import REACTIONS, Drag, Mover, Plant, Reaction, Sample, estimated_force

# --- The load of the arm, weighed from the last seconds of its samples: `tauext load`, on the page.


WEIGHED_S = 4.0
"""Longest weighed motion: the latest samples."""
LEAD_S = 3.0
"""Samples before it: the prior needs them to find the joints' presliding state."""
SETTLED = 5.0
"""Multiple of 1/K0 after which the observer shows a new weight to 1 %."""
EVERY_S = 1.0
LEAST_S = 1.0
"""Shortest weighed motion: in less no joint moves far."""


@dataclass(frozen=True)
class Stretch:
    """Consecutive samples, and the time at which the load was put in."""

    t_ns: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    tau: np.ndarray
    since_ns: int


class Recent:
    """The last seconds of samples, in memory of a fixed size."""

    def __init__(self, arm: DemoArm):
        self._size = round((WEIGHED_S + LEAD_S) * arm.rate_hz)
        self._t_ns = np.zeros(self._size, np.int64)
        self._signals = np.zeros((3, self._size, len(arm.joints)))
        self._count = 0

    def add(self, sample: Sample) -> None:
        row = self._count % self._size
        self._t_ns[row] = sample.t_ns
        self._signals[0, row], self._signals[1, row], self._signals[2, row] = sample.q, sample.dq, sample.tau
        self._count += 1

    def stretch(self, since_ns: int) -> Stretch:
        """A copy of the samples, oldest first."""
        rows = np.arange(max(0, self._count - self._size), self._count) % self._size
        q, dq, tau = self._signals[:, rows]
        return Stretch(self._t_ns[rows], q, dq, tau, since_ns)


def weigh(bundle: _core.Bundle, arm: DemoArm, stretch: Stretch) -> LoadEstimate | None:
    """The load in the hand since it was put in, at most over WEIGHED_S; None: too little motion yet.

    Raises:
        TauextError: this bundle can weigh nothing.
    """
    expect_weighable(bundle)
    recording = Recording(
        name="the last seconds",
        joints=arm.joints,
        t_ns=stretch.t_ns,
        q=stretch.q,
        dq=stretch.dq,
        tau=stretch.tau,
        rate_hz=float(arm.rate_hz),
        torque_timing="held",
        source=arm.title,
        robot_sha256="",
    )
    end_s = 1e-9 * (stretch.t_ns[-1] - stretch.t_ns[0])
    known_s = 1e-9 * (stretch.since_ns - stretch.t_ns[0]) + SETTLED / bundle.observer.gain_per_s
    from_s = max(known_s, end_s - WEIGHED_S)
    if end_s - from_s < LEAST_S:
        return None
    return identify(bundle, load_frame(bundle), [between(see(bundle, recording, threads=1), from_s, None)])


SHORT = {
    "load": "A load, but these poses do not separate its mass from its lever.",
    "contact": "This does not turn as gravity would: something touches the arm.",
    "unclear": "Neither a load nor one constant push explains it.",
}
"""By verdict, for a narrow page; `tauext load` prints more."""


def weighed_words(found: LoadEstimate | None) -> str:
    """The result in one or two sentences."""
    if found is None:
        return "Weighing ..."
    if found.verdict == "load" and found.mass_seen:
        return f"Fits a load of {found.mass_kg:.2f} ± {found.mass_error_kg:.2f} kg."
    if found.verdict in SHORT:
        return SHORT[found.verdict]
    words = load_sentences(found, "the hand", "N m")[0]
    return f"{words[0].upper()}{words[1:]}."


class Weigher:
    """Weighs in a thread of its own, again and again while a weight is held and the arm moves."""

    def __init__(self, arm: DemoArm):
        self.words = ""
        self._arm = arm
        self._thread: threading.Thread | None = None
        self._bundles: dict[Path, _core.Bundle] = {}
        self._since_s = self._moved_s = self._started_s = -np.inf

    def wants(self, snapshot: Snapshot) -> bool:
        """Whether samples should be sent to start(); not after the arm has been at rest so long that the
        samples hold less information."""
        if snapshot.held is None:
            self.words, self._since_s = "", -np.inf
            return False
        if snapshot.held.since_s != self._since_s:
            self.words, self._since_s = weighed_words(None), snapshot.held.since_s
            self._moved_s = max(self._moved_s, self._since_s)
        if snapshot.doing == "moving":
            self._moved_s = snapshot.time_s
        busy = self._thread is not None and self._thread.is_alive()
        rests = snapshot.time_s - self._moved_s > WEIGHED_S - LEAST_S
        if busy or rests or snapshot.time_s - self._started_s < EVERY_S:
            return False
        self._started_s = snapshot.time_s
        return True

    def start(self, path: Path, stretch: Stretch) -> None:
        """Weigh by this bundle; `words` holds the result as soon as it exists."""
        self._thread = threading.Thread(target=self._weigh, args=(path, stretch, self._since_s), daemon=True)
        self._thread.start()

    def _weigh(self, path: Path, stretch: Stretch, since_s: float) -> None:
        try:
            if path not in self._bundles:
                self._bundles[path] = load_bundle(path)
            words = weighed_words(weigh(self._bundles[path], self._arm, stretch))
        except TauextError as refused:
            words = str(refused)
        if since_s == self._since_s:
            self.words = words


# --- Arm, mover, push and monitors together: one sample after the other, and its snapshots for viewers.


TRACE_EVERY_S = 0.02
TRACE_ROWS = 100
"""Rows that are kept until a viewer requests them: older ones are dropped."""
EVENTS = 20
RESUME_RAD, RESUME_S = 0.02, 1.2
"""After resume() a method that is blind to static friction is acknowledged at every sample until each joint has
moved so far, or for so long: the stress that a push leaves in the friction of a joint at rest looks like a push
until the joint slides, and would stop the arm again before that."""
MOVE_ON_S = WEIGHED_S + LEAST_S
"""Time for which the arm moves to be weighed, whatever the monitors report about its load."""
LET_GO_S = 0.5
"""For this time after a push, or after a weight was taken out, an alarm is attributed to it."""


class Simulation:
    """One demo; step() is one sample of the control loop, everything else may be called between two samples."""

    def __init__(self, arm: DemoArm, seed: int = 0):
        self.arm = arm
        self.plant = Plant(arm, seed)
        self.mover = Mover(arm, seed)
        self.monitors: dict[str, _core.Monitor] = {}
        """By method, all fed with the same samples; empty: none yet."""
        self.method = ""
        self.reaction: Reaction = "stop"
        self.sensitivity = 1.0
        self.hand = Hand()
        self.drag: Drag | None = None
        self._holder: object = None
        self._push_began_s = self._push_ended_s = -np.inf
        self._resumed_s = -np.inf
        self._emptied_s = self._moves_on_until_s = -np.inf
        self._unknown_weight: set[str] = set()
        self._load_due_tick, self._load_due = -1, False
        self._velocity_lag = round(arm.rate_hz / arm.sensors.velocity_cutoff_rad_s)
        self._stuck = np.zeros(len(arm.joints), bool)
        self._resumed_at = np.array(arm.home)
        self._places: dict[str, Places] = {}
        self._blind_to_stiction: list[str] = []
        """Methods without a prior: stress left in a joint's static friction raises none of their limits."""
        self._estimates: dict[str, _core.Estimate] = {}
        self._alarms: dict[str, _core.Alarm] = {}
        self._newtons: dict[str, float] = {}
        self._over_since_s: dict[tuple[str, _core.Alarm], float] = {}
        """By method and level: when the true torque of this push first exceeded the limit."""
        self._sample: Sample | None = None
        self._recent = Recent(arm)
        self._trace: deque[np.ndarray] = deque(maxlen=TRACE_ROWS)
        self._events: deque[Event] = deque(maxlen=EVENTS)
        self._ticks = 0

    # Commands of a viewer, see serve().

    def watch_with(self, bundles: Mapping[str, str], method: str) -> None:
        """Watch with these bundle files, by method, from now on; `method` is shown and reacted to."""
        loaded = {name: _core.Bundle.load(path) for name, path in bundles.items()}
        self.monitors = {name: _core.Monitor(bundle) for name, bundle in loaded.items()}
        self._places = {name: Places(bundle) for name, bundle in loaded.items()}
        self._blind_to_stiction = [name for name, bundle in loaded.items() if not bundle.prior.terms]
        self._estimates, self._alarms = {}, {}
        self.set_sensitivity(self.sensitivity)
        self.hand.set_load(self.hand.load_set, self.monitors)
        self.set_method(method)

    def watch_nothing(self) -> None:
        """Until other bundles are there."""
        self.monitors, self._places, self._estimates, self._alarms = {}, {}, {}, {}

    def set_method(self, method: str) -> None:
        if self.monitors and method not in self.monitors:
            raise ConfigError(f"method = {method} must be one of {', '.join(self.monitors)}")
        self.method = method

    def set_reaction(self, reaction: Reaction) -> None:
        if reaction not in REACTIONS:
            raise ConfigError(f"reaction = {reaction} must be one of {', '.join(REACTIONS)}")
        self.reaction = reaction

    def set_sensitivity(self, sensitivity: float) -> None:
        """Divide the trained limits by this from the next sample on; 0.1 to 10, the bounds of the monitor's factors."""
        if not 0.1 <= sensitivity <= 10:
            raise ConfigError(f"sensitivity = {sensitivity} must be 0.1 to 10")
        self.sensitivity = sensitivity
        for monitor in self.monitors.values():
            factors = np.full(monitor.joints, 1.0 / sensitivity)
            monitor.set_limit_factors(factors, factors)

    def set_friction(self, factor: float) -> None:
        self.plant.set_friction(factor)

    def grab(self, holder: object, joint: int, point_m: np.ndarray) -> None:
        """Take hold of the link of a joint at a point in the base frame; whoever held it before lets go."""
        self.drag, self._holder = Drag.grab(self.plant, joint, point_m), holder
        if self.plant.time_s - self._push_ended_s > 0.0:
            self._push_began_s = self.plant.time_s
            self._over_since_s = {}

    def pull(self, holder: object, target_m: np.ndarray) -> None:
        """Move the pointer to this point in the base frame."""
        if self.drag is not None and holder == self._holder:
            self.drag.target_m = np.asarray(target_m, float)

    def release(self, holder: object) -> None:
        if self.drag is not None and holder == self._holder:
            self.drag, self._push_ended_s = None, self.plant.time_s

    def resume(self) -> None:
        """End the collision and go on moving, once nothing pushes any more."""
        self._resumed_s = self.plant.time_s
        self._resumed_at, self._stuck[:] = self.plant.data.qpos.copy(), True
        for monitor in self.monitors.values():
            monitor.resume()
        self._alarms = dict.fromkeys(self._alarms, _core.Alarm.none)
        self._over_since_s = {}
        self.mover.resume()

    def rest(self) -> None:
        self.mover.rest()

    def hold(self, mass_kg: float, load_set: bool) -> None:
        """Put a weight into the hand, with or without setting it in the monitors; at most one is in it."""
        self._take(ball(self.arm, mass_kg), load_set)

    def let_go(self) -> None:
        """Take the weight out of the hand; monitors in which it was set are cleared."""
        self._unknown_weight = {name for name in self.monitors if not self.hand.right_in(name)}
        self._emptied_s = self.plant.time_s
        self._take(None, False)

    def set_load(self, load_set: bool) -> None:
        """Set the weight in the monitors from the time it was taken on, or clear it."""
        self._load_due_tick = -1
        self.hand.set_load(load_set, self.monitors, afterwards=True)

    def move_on(self) -> None:
        """Move for some seconds in spite of every alarm, so that the weight shows at other poses too."""
        self._moves_on_until_s = self.plant.time_s + MOVE_ON_S
        self.resume()

    def recent(self) -> Stretch:
        """The last samples, for weighing."""
        return self._recent.stretch(self.hand.since_ns)

    def _take(self, load: _core.Load | None, load_set: bool) -> None:
        """Set the load in the monitors once the low-pass of the measured velocity shows it. A weight appears from one
        sample to the next: the monitors would else expect torques that do not show yet, some 3 N m after 3 ms."""
        self.plant.hold(load)
        self.hand.take(load, -1 if self._sample is None else self._sample.t_ns)
        self._load_due_tick, self._load_due = self._ticks + self._velocity_lag, load_set

    # The loop.

    def step(self) -> bool:
        """One sample; True where an alarm was raised at it."""
        if self._ticks == self._load_due_tick:
            self.hand.set_load(self._load_due, self.monitors)
        plant = self.plant
        force, point = self.drag.force_n(plant) if self.drag else (None, None)
        measured = self._sample
        q, dq = (plant.data.qpos, plant.data.qvel) if measured is None else (measured.q, measured.dq)
        setpoints = self.mover.step(q, dq, plant.gravity_nm)
        sample = plant.step(*setpoints, force, point, self.drag.joint if self.drag else 0)
        self._sample = sample
        self._recent.add(sample)
        raised = False
        excused = self._blind_to_stiction if self.monitors and self._resuming() else ()
        for method in excused:
            self.monitors[method].acknowledge()
        for method, monitor in self.monitors.items():
            estimate = self._estimates[method] = monitor.step(sample.t_ns, sample.q, sample.dq, sample.tau)
            if self.drag is not None:
                self._note_onset(method, estimate, sample.tau_ext)
            alarm = _core.Alarm.none if method in excused else estimate.alarm
            raised |= self._judge(method, alarm, estimate.alarm_joint)
        if self._ticks % round(TRACE_EVERY_S * self.arm.rate_hz) == 0:
            tau_ext, sigma, limit = self._shown()
            self._trace.append(np.concatenate([[plant.time_s], tau_ext, sigma, limit, self.tau_ext_nm]))
        self._ticks += 1
        return raised

    def _note_onset(self, method: str, estimate: _core.Estimate, true_nm: np.ndarray) -> None:
        """Note when the true torque of a push first exceeds a limit of the method, for the delay of its alarms."""
        limits = ((_core.Alarm.contact, estimate.contact_limit_nm), (_core.Alarm.collision, estimate.limit_nm))
        for level, limit_nm in limits:
            if (method, level) not in self._over_since_s and (np.abs(true_nm) > limit_nm).any():
                self._over_since_s[method, level] = self.plant.time_s

    def _resuming(self) -> bool:
        """Whether some joint is still at its position of resume(), with the push's stress in its friction."""
        if self._stuck.any() and self._sample is not None:
            self._stuck &= np.abs(self._sample.q - self._resumed_at) < RESUME_RAD
            self._stuck &= self.plant.time_s < self._resumed_s + RESUME_S
        return bool(self._stuck.any())

    @property
    def tau_ext_nm(self) -> np.ndarray:
        """True external torque of the last sample, (joints,): a push's, and a weight's that is not set in the
        method shown."""
        if self._sample is None:
            return np.zeros(len(self.arm.joints))
        return self._sample.tau_ext + (0.0 if self.hand.right_in(self.method) else self._sample.tau_held)

    def take_events(self) -> list[Event]:
        """Alarms since they were last taken."""
        events = list(self._events)
        self._events.clear()
        return events

    def snapshot(self) -> Snapshot:
        """The present state, and the events since the last snapshot."""
        data = self.plant.data
        mujoco.mj_kinematics(self.plant.model, data)
        mujoco.mj_comPos(self.plant.model, data)
        tau_ext, _, limit = self._shown()
        trace, links = np.array(self._trace), 1 + len(self.arm.joints)
        self._trace.clear()
        placed = self._placed()
        return Snapshot(
            time_s=self.plant.time_s,
            poses=np.hstack([data.xpos[1:links], data.xquat[1:links]]),
            doing=self.mover.doing,
            method=self.method,
            tau_ext=tau_ext,
            limit_nm=limit,
            verdicts={
                name: Verdict(
                    estimate.health.name,
                    self._alarms[name].name,
                    estimate.alarm_joint,
                    estimate.touch.name,
                    self._newtons[name],
                )
                for name, estimate in self._estimates.items()
            },
            touch=self._touch(tau_ext),
            trace=trace.reshape(len(trace), 1 + 4 * len(self.arm.joints)),
            events=self.take_events(),
            held=self.hand.held(self.method),
            placed=placed.get(self.method),
            places_refused=self._places[self.method].refused if self._places else "",
        )

    def _placed(self) -> dict[str, Placed | None]:
        """Present place of the touch by each method; its force is kept until the alarm ends."""
        placed: dict[str, Placed | None] = {}
        for name, estimate in self._estimates.items():
            if self._alarms[name] == _core.Alarm.none:
                self._newtons[name] = np.nan
                continue
            assert self._sample is not None
            placed[name] = found = self._places[name].find(self._sample.q, estimate)
            self._newtons[name] = self._newtons.get(name, np.nan) if found is None else found.newtons
        return placed

    def _judge(self, method: str, alarm: _core.Alarm, joint: int) -> bool:
        """Note an alarm that rose, and react to a collision of the method shown."""
        was = self._alarms.get(method, _core.Alarm.none)
        self._alarms[method] = alarm
        if alarm.value <= was.value or alarm == _core.Alarm.none:
            return False
        now_s = self.plant.time_s
        pushed = self.drag is not None or now_s - self._push_ended_s < LET_GO_S
        after_s = now_s - self._push_began_s if pushed else None
        over_s = self._over_since_s.get((method, alarm)) if pushed else None
        just_gone = now_s - self._emptied_s < LET_GO_S and method in self._unknown_weight
        self._events.append(
            Event(
                time_s=now_s,
                method=method,
                alarm=alarm.name,
                joint=joint,
                after_push_s=after_s,
                after_limit_s=None if over_s is None else now_s - over_s,
                by_weight=just_gone or not self.hand.right_in(method),
            )
        )
        disturbs = now_s >= self._moves_on_until_s and self.mover.doing == "moving"
        if alarm == _core.Alarm.collision and method == self.method and disturbs:
            self.mover.react(self.reaction)
        return True

    def _shown(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Estimate, its standard error, 0 where unknown, and limit of the method shown."""
        estimate = self._estimates.get(self.method)
        if estimate is None:
            unknown = np.full(len(self.arm.joints), np.nan)
            return unknown, np.zeros(len(unknown)), unknown
        sigma = np.nan_to_num(np.array(estimate.contact_sigma_nm))
        return np.array(estimate.tau_ext), sigma, np.array(estimate.limit_nm)

    def _touch(self, tau_ext: np.ndarray) -> Touch | None:
        if self.drag is None:
            return None
        force, point = self.drag.force_n(self.plant)
        estimate, directions = np.zeros(3), 0
        if np.isfinite(tau_ext).all():
            estimate, directions = estimated_force(tau_ext, self.plant.jacobian(point, self.drag.joint))
        return Touch(self.drag.joint, point, self.drag.target_m, force, estimate, directions)
