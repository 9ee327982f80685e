"""Load of an arm from recordings: frame, rows, windows, mass, centre of mass, and messages."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tauext import _core
from tauext._core import LoadFound
from tauext.bundle.estimates import OK
from tauext.bundle.match import expect_fit
from tauext.data.recording import Recording
from tauext.errors import ConfigError, RecordingError
from tauext.monitor.loads import NOTHING

# --- The frame to which a load is fixed.


@dataclass(frozen=True)
class NamedFrame:
    """A load frame, and its name in messages."""

    frame: _core.LoadFrame
    name: str


def load_frame(bundle: _core.Bundle, joint: str | None = None) -> NamedFrame:
    """Frame of the bundle's loads, or of the link that a joint carries: its origin is on the joint's axis, z along it.

    Args:
        joint: joint whose link carries the load; None: the bundle's frame or, if it names none, the link carried by
            most joints.

    Raises:
        ConfigError: the joint does not exist.
    """
    joints = [link.joint_name for link in bundle.links]
    known = bundle.load_settings
    if joint is None and known.link >= 0:
        named = known.frame if known.frame.startswith("link of ") else f"frame {known.frame}"
        return NamedFrame(_core.LoadFrame(known.link, known.rotation, known.translation), f"the {named}")
    if joint is None:
        joint = joints[max(range(len(joints)), key=lambda link: (carriers(bundle, link), link))]
    if joint not in joints:
        raise ConfigError(
            f"frame = {joint!r}: must be the joint whose link carries the payload, of {', '.join(joints)}"
        )
    return NamedFrame(_core.LoadFrame(joints.index(joint)), f"the link of {joint}")


def carriers(bundle: _core.Bundle, link: int) -> int:
    """Number of joints that carry a link."""
    count = 0
    while link >= 0:
        link, count = bundle.links[link].parent, count + 1
    return count


# --- Bundles and joints that can weigh a load.


def expect_weighable(bundle: _core.Bundle) -> None:
    """Raise ConfigError if tau_ext does not contain the weight of a load."""
    if bundle.observer.method.name != "momentum":
        raise ConfigError(
            f"bundle '{bundle.name}' follows the {bundle.observer.method.name} residual; a payload is identified by "
            "the momentum observer's (recipes tauext, prior, friction, observer)"
        )
    if not any(link.mass > 0 for link in [*bundle.links, *bundle.prior.corrected_links]):
        raise ConfigError(
            f"bundle '{bundle.name}' has no model of the arm, neither given nor found in its motion: no levers"
        )
    if not weighing_joints(bundle).any():
        raise ConfigError(
            f"bundle '{bundle.name}' has no torque constant of any joint; a payload is identified by joints whose "
            "torque is in N m: give the constants (--torque-constants of train)"
        )


def weighing_joints(bundle: _core.Bundle) -> np.ndarray:
    """Joints whose torques can be combined, (n,) bool: those in N m or N; else those in one common unit.

    An ampere is a different number of N m at every joint.
    """
    newtons = np.array(bundle.in_newtons)
    if newtons.any():
        return newtons
    own = np.array(bundle.observer.unknown_constant or [0] * bundle.joints, dtype=bool)
    return ~own & np.array([unit != "A" for unit in bundle.estimate_units])


# --- Recordings and the rows of them that weigh.


ROW_S = 0.01
"""Period of the rows, equal to the network period: r changes little in less."""


Arrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class WeighedMotion:
    """A recording and its estimates, at the rows that weigh."""

    recording: Recording
    samples: np.ndarray  # (rows,) of the recording
    tau_ext: np.ndarray  # (rows, n): without drift tracking, which would absorb the load
    sigma: np.ndarray  # (rows, n)
    worth: np.ndarray  # (rows, n): 1, decreasing while a joint rests, 0 if its torque is in another unit

    @property
    def rows(self) -> int:
        return len(self.samples)

    @property
    def time_s(self) -> np.ndarray:
        """Times of the rows from the recording's first sample, (rows,)."""
        return self.recording.time_s[self.samples]

    @classmethod
    def of(
        cls, recording: Recording, samples: np.ndarray, tau_ext: np.ndarray, sigma: np.ndarray, near: np.ndarray
    ) -> WeighedMotion:
        """Select samples of a recording.

        Args:
            samples: (rows,) of the recording.
            tau_ext, sigma: (samples, n) of the whole recording.
            near: (samples, n) uint8: near stiction.
        """
        worth = _core.worth_of_samples(recording.t_ns, near)
        return cls(recording, samples, tau_ext[samples], np.maximum(sigma[samples], 1e-9), worth[samples])

    def part(self, keep: np.ndarray) -> WeighedMotion:
        """Select rows; keep: (rows,) bool."""
        fields = (self.samples, self.tau_ext, self.sigma, self.worth)
        return WeighedMotion(self.recording, *(values[keep] for values in fields))

    @property
    def arrays(self) -> Arrays:
        """The motion for `_core.weigh_load` and `_core.weigh_known`."""
        r = self.recording
        return r.t_ns, r.q, r.dq, self.samples, self.tau_ext, self.sigma, self.worth


def see(bundle: _core.Bundle, recording: Recording, threads: int = 0) -> WeighedMotion:
    """Run the chain on a recording and return its healthy rows.

    Raises:
        BundleError: the recording does not fit the bundle.
    """
    expect_fit(bundle, recording)
    recorded = (recording.t_ns, recording.q, recording.dq, recording.tau)
    estimates = _core.estimate(bundle, *recorded, threads or os.cpu_count() or 1)
    stride = max(1, round(ROW_S * recording.rate_hz))
    samples = np.arange(0, recording.samples, stride)
    samples = samples[(estimates["health"] == OK)[samples]]
    sigma = estimates["sigma_nm"] if bundle.error_scale.on else LoadFound.SIGMA_OF_LIMIT * estimates["limit_nm"]
    tau_ext = estimates["tau_ext"] + estimates["drift"]
    motion = WeighedMotion.of(recording, samples, tau_ext, sigma, estimates["near_stiction"])
    return replace(motion, worth=motion.worth * weighing_joints(bundle))


# --- A load from recordings: mass and centre of mass, their errors, and the verdict.


def identify(
    bundle: _core.Bundle,
    frame: NamedFrame,
    parts: Sequence[WeighedMotion],
    reach_m: float = LoadFound.USUAL_REACH_M,
    phi: Sequence[float] = (0.0,) * 10,
    beside: _core.Load = NOTHING,
) -> LoadFound:
    """Estimate the load from these rows by weighted least squares on tau_ext.

        tau_ext_j = X_j(m, h) + offset_j + Coulomb_j tanh(dq_j / v) + error,   weights worth / (scale_j sigma_j)^2

    X contains gravity, inertia and added friction of the load, through the observer's filter. The centre of mass is
    within the reach: h is regularised to 0 with a standard deviation of m reach / 2.

    Args:
        phi: initial load, (10,).
        beside: load that is set, of which the arm may carry less.

    Raises:
        RecordingError: fewer than LEAST_ROWS rows.
    """
    if sum(part.rows for part in parts) < LoadFound.LEAST_ROWS:
        raise RecordingError(
            f"{parts[0].recording.name if parts else 'nothing'}: too few healthy samples to identify a payload; it "
            f"takes {LoadFound.LEAST_ROWS * ROW_S:g} s behind the observer's warm-up"
        )
    return _core.weigh_load(bundle, frame.frame, [part.arrays for part in parts], reach_m, list(phi), beside)


# --- Sections of recordings for weighing.


WINDOW_S = 4.0
"""Length of a window: about the time between two grasps, and short enough to detect a changed load."""


def between(motion: WeighedMotion, from_s: float | None, to_s: float | None) -> WeighedMotion:
    """Select the rows within these times of the recording.

    Raises:
        RecordingError: fewer than LEAST_ROWS.
    """
    low, high = from_s if from_s is not None else -np.inf, to_s if to_s is not None else np.inf
    part = motion.part((motion.time_s >= low) & (motion.time_s <= high))
    if part.rows < LoadFound.LEAST_ROWS:
        raise RecordingError(
            f"{motion.recording.name}: {part.rows} healthy rows from {max(low, 0):g} s on are too few to "
            "identify a payload"
        )
    return part


def expect_different(recordings: Sequence[Recording]) -> None:
    """Raise ConfigError if two recordings have the same motion, which would make the errors too small."""
    for k, one in enumerate(recordings):
        for other in recordings[:k]:
            if np.array_equal(one.q, other.q) and np.array_equal(one.tau, other.tau):
                raise ConfigError(f"recordings {other.name} and {one.name} are the same motion; give each one once")


def each_window(
    bundle: _core.Bundle, frame: NamedFrame, parts: Sequence[WeighedMotion], whole: LoadFound
) -> list[tuple[str, float, LoadFound]]:
    """Estimate the load in each whole window: recording, begin, and load."""
    windows = []
    for part in parts:
        start = part.time_s[0]
        while start + WINDOW_S <= part.time_s[-1] + 0.05:
            rows = part.part((part.time_s >= start) & (part.time_s < start + WINDOW_S))
            if rows.rows >= LoadFound.LEAST_ROWS:
                own = identify(bundle, frame, [rows], whole.reach_m, whole.phi.tolist())
                windows.append((part.recording.name, float(start), own))
            start += WINDOW_S
    return windows


# --- Messages on the load and on what the motion does not determine.


def load_sentences(found: LoadFound, where: str, unit: str) -> list[str]:
    """Sentences on mass, centre of mass, and what the motion does not determine.

    Args:
        where: name of the frame.
        unit: unit of the bundle's estimates; a mass is in kg only if that is N m.
    """
    kg = "kg" if unit == "N m" else f"kg times {unit} a N m"
    mass = mass_words(found.mass_kg, found.mass_error_kg, kg)
    if found.mass_error_kg > 100:  # without motion it is 1000 kg
        return [
            f"no weight is visible there: gravity never pulls a payload at {where} against a joint that weighs it; is "
            "the payload fixed to a link farther out (--frame)?"
        ]
    if found.verdict == "too little":
        return [f"{found.seconds:.2f} s of healthy motion are too little to identify a payload"]
    if found.verdict == "nothing":
        hidden_kg = LoadFound.MASS_SHOWS * found.mass_error_kg
        return [f"no payload is visible: {mass}; one of less than {hidden_kg:.2g} {kg} would not"]
    if found.verdict == "lifts":
        lift = -found.fits["load"].values[0]
        return [f"the estimated force pulls up, as {lift:.2f} {kg} less would: no payload, or one present in training"]
    if found.verdict == "contact":
        return [contact_sentence(found, unit)]
    if found.verdict == "unclear":
        left = found.misfit**0.5
        return [
            f"neither a payload nor a constant force explains it: the best payload, {mass}, leaves {left:.1f} times "
            "the bundle's error; several contacts, a force that changes, or an arm that has changed itself"
        ]
    return [*weighed(found, where, kg), *unseen_sentences(found)]


def mass_error(found: LoadFound) -> float:
    """Standard error of the mass from motion and torque constants, [kg]."""
    return math.hypot(found.mass_error_kg, found.constants_error_kg)


def mass_words(mass_kg: float, error_kg: float, kg: str = "kg") -> str:
    """A mass with its standard error, to the error's first digits: `3.2 ± 0.4 kg`, `2.61 ± 0.02 kg`."""
    digits = 1 if error_kg >= 0.1 else 2
    return f"{mass_kg:.{digits}f} ± {error_kg:.{digits}f} {kg}"


def weighed_words(found: LoadFound, kg: str) -> str:
    """A mass with both of its errors: that of the torque constants changes all weights alike."""
    if found.constants_error_kg < found.mass_error_kg / 2:  # it adds at most a tenth
        return mass_words(found.mass_kg, mass_error(found), kg)
    # No known weight is advised where the constants are as sure as such a weight finds them: to 3 %.
    share = found.constants_error_kg / max(abs(found.mass_kg), 1e-9)
    advice = " (identify a known payload: tauext load --known-kg)" if share > 0.03 else ""
    return (
        f"{found.mass_kg:.2f} {kg} ± {100 * share:.2g} % common to all masses found with this bundle{advice}, "
        f"± {found.mass_error_kg:.2f} {kg} from motion"
    )


def constants_errors(bundle: _core.Bundle, found: LoadFound) -> dict[str, float]:
    """Standard error of the mass from each joint's own torque constant, and from the factor common to all, [kg].

    Before a known weight, their root of the sum of squares is `found.constants_error_kg`. After it the errors of the
    joints depend on each other; a joint's is then what its exact constant would take off, in squares.
    """
    given, n = bundle.wrench_settings, bundle.joints
    own = np.array([given.own_share(joint) for joint in range(n)])
    alike = np.reshape(given.torque_correlation, (n, n)) if given.torque_correlation else np.eye(n)
    changes = found.mass_by_constant_kg[:n]
    errors = np.abs(alike @ (own * changes)).tolist()
    names = [link.joint_name for link in bundle.links]
    return dict(zip(names, errors, strict=True)) | {COMMON: abs(given.common_share * float(changes.sum()))}


COMMON = "the factor common to all joints"


def constants_sentence(found: LoadFound, errors: dict[str, float]) -> str | None:
    """Which torque constants make the error of the mass, and what lowers it; None: the motion makes most of it, or the
    mass is 0.

    Args:
        errors: of constants_errors().
    """
    mass = abs(found.mass_kg)
    if not (mass > 0 and found.constants_error_kg >= max(found.mass_error_kg / 2, 0.002 * mass)):
        return None
    largest = sorted(errors, key=lambda name: -errors[name])[:3]
    shares = ", ".join(f"{name} {100 * errors[name] / mass:.2g} %" for name in largest if errors[name] > 0)
    first = "every joint turns" if largest[0] == COMMON else f"{largest[0]} turns through its range"
    return (
        f"of the {100 * found.constants_error_kg / mass:.2g} % from torque constants: {shares}. A known payload "
        f"lowers it, in half a minute of motion in which {first}, with its mass far from its axis"
    )


def weighed(found: LoadFound, where: str, kg: str) -> list[str]:
    """Sentences on mass and centre of mass, as far as the motion determines them."""
    mass = weighed_words(found, kg)
    if not found.mass_seen:
        return [
            f"a payload, but this motion does not separate its mass from its lever: {mass}. Only its pull at the "
            "joints in these poses is known; turn the wrist to other ones"
        ]
    centre = ", ".join(
        f"{axis} {1e3 * c:.0f} ± {max(1e3 * e, 1):.0f}"
        for axis, c, e in zip("xyz", found.com_m, found.com_error_m, strict=True)
    )
    lines = [f"load {mass}, centre of mass at {centre} mm of {where}"]
    if found.at_bound:
        lines.append(
            f"the centre of mass is at the bound of {found.reach_m:g} m that was stated (--reach-m): the payload "
            "reaches farther, or is fixed to another link (--frame)"
        )
    return lines


def unseen_sentences(found: LoadFound) -> list[str]:
    """Sentence on directions of the centre of mass across which gravity never turned."""
    lines = []
    for direction in found.unseen:
        named = axis_name(direction)
        error = 1e3 * float(np.sqrt(direction @ found.com_covariance @ direction))
        lines.append(
            f"the centre of mass along {named} is not visible in this motion (± {error:.0f} mm): gravity never turned "
            "across it, and nothing sped it up enough"
        )
    return lines


def contact_sentence(found: LoadFound, unit: str) -> str:
    """Sentence on a force that fits better than a load."""
    force_unit = "N" if unit == "N m" else "units of force"
    base, frame = found.fits["base"], found.fits["frame"]
    best, axes = (base, "the base") if base.cost <= frame.cost else (frame, "the frame")
    force = ", ".join(f"{value:.1f}" for value in best.values)
    load = found.fits["load"]
    return (
        f"this does not turn as gravity would: a constant force of ({force}) {force_unit} along the axes of {axes} "
        f"fits better than any payload (it leaves {best.misfit**0.5:.1f} of the bundle's error, the payload "
        f"{load.misfit**0.5:.1f}). Something touches the arm"
    )


def axis_name(direction: np.ndarray) -> str:
    """Name a direction: `the z axis of the frame`, or in numbers."""
    k = int(np.abs(direction).argmax())
    if abs(direction[k]) >= 0.9:
        return f"the {'xyz'[k]} axis of the frame"
    turned = direction * np.sign(direction[k])
    return f"the direction ({', '.join(f'{c:.2f}' for c in turned)}) of the frame"


def found_facts(found: LoadFound) -> dict:
    """The result as plain JSON."""
    return {
        "verdict": found.verdict,
        "mass_kg": found.mass_kg,
        "mass_error_kg": found.mass_error_kg,
        "constants_error_kg": found.constants_error_kg,
        "com_m": found.com_m.tolist(),
        "com_error_m": found.com_error_m.tolist(),
        "inertia_kg_m2": found.phi[4:].tolist(),
        "mass_seen": found.mass_seen,
        "com_unseen": [direction.tolist() for direction in found.unseen],
        "at_bound": found.at_bound,
        "misfit": found.misfit,
        "seconds": found.seconds,
    }
