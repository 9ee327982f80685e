"""The virtual rig's parameters from a recording of the paper's own arm: value, standard error, and the rig's.

    python packages/lab/benchmarks/rig_fit.py DATA [BUNDLE.tauext ...]

DATA is the folder of collisions.csv (tauext_lab/bench/mocca_recording.py). docs/results/mocca/rig-fit.json
holds the tables that it prints.

Motor torque less the nominal model is friction plus the error of its gravity. Friction is the rig's own law (LuGre
bristles, Coulomb and static part, viscous part, growth with the load on the gear). Both pass the recorded observer's
filter and are compared with its output, outside collisions and the first 0.8 s of a segment, since the bristles' first
state is unknown. Standard errors are a jackknife over segments, because the errors of one segment are not independent.

Bundles of recipe paper, trained on `tauext simulate` alone, test the rig: they are judged on the recording, which has
100 Hz, so their observers are set to that rate; the network's steps of 10 ms stay as they are.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import COLLISION, arguments, error_cells, estimates, head, joined, table_row
from mocca import Tested
from scipy.optimize import least_squares
from tauext_lab.bench.mocca_recording import (
    RATE_HZ,
    RECORDED_GAIN_PER_S,
    Segment,
    nominal_tree,
    read_segments,
    recording,
)
from tauext_lab.sim.config import PAPER_FRICTION, RigConfig
from tauext_lab.sim.rig import low_pass

from tauext import _core
from tauext.bundle.bundle_file import load_bundle

SETTLED_S = 0.8
STRIBECK_RAD_S = 0.05
"""Stribeck velocity of the fit: the recording does not determine it."""
NEAR_STICTION_RAD_S = 0.02
SIZE_NM = (0.8, 0.4)
"""Size of each joint's errors, beyond which they count less: the loss is a pseudo-Huber."""
GRAVITY_NM = (38.90, 15.65)
"""Nominal gravity torque is -38.90 sin q1 - 15.65 sin(q1 + q2) and -15.65 sin(q1 + q2)."""
NAMES = ("gravity of joint 1", "gravity of joint 2", "offset of joint 1", "offset of joint 2")
PER_JOINT = ("coulomb", "static less coulomb", "viscous", "load share", "log10 of bristle stiffness")
START = np.array([2.0, 0.5, 0.0, 0.0, 4.0, 0.0, 3.0, 0.15, 4.8, 3.0, 0.0, 4.0, 0.08, 3.8])
STEP = np.array([1.0, 1.0, 0.3, 0.3, *[1.0, 1.0, 1.0, 0.05, 0.3] * 2])
LOW = np.array([-20, -20, -3, -3, *[0, -3, 0, 0, 3.0] * 2])
HIGH = np.array([20, 20, 3, 3, *[30, 20, 30, 0.6, 5.5] * 2])


def friction_nm(segment: Segment, joint: int, parameters: np.ndarray, load_nm: np.ndarray) -> np.ndarray:
    """Friction of one joint (samples,), [N m]: dz/dt = dq - sigma_0 |dq| z / g, exact for constant speed in a step."""
    coulomb, excess, viscous, share, log_stiffness = parameters
    stiffness, dq = 10.0**log_stiffness, segment.dq[:, joint]
    most = (coulomb + share * load_nm + excess * np.exp(-((dq / STRIBECK_RAD_S) ** 2))) / stiffness
    bristle, travel = np.zeros(len(dq)), np.diff(segment.q[:, joint])
    for k, step in enumerate(travel, start=1):
        end = np.sign(step) * most[k]
        bristle[k] = end + (bristle[k - 1] - end) * np.exp(-abs(step) / most[k])
    return stiffness * bristle + viscous * dq


def predicted_nm(segment: Segment, parameters: np.ndarray) -> np.ndarray:
    """Friction and the nominal gravity's error through the observer's filter, (samples, 2), [N m]."""
    own, both = np.sin(segment.q[:, 0]), np.sin(segment.q.sum(axis=1))
    error = np.column_stack([-parameters[0] * own - parameters[1] * both, -parameters[1] * both])
    gravity = np.column_stack([-GRAVITY_NM[0] * own - GRAVITY_NM[1] * both, -GRAVITY_NM[1] * both]) + error
    friction = [
        friction_nm(segment, joint, parameters[4 + 5 * joint : 9 + 5 * joint], np.abs(gravity[:, joint]))
        for joint in range(2)
    ]
    return low_pass(np.column_stack(friction) + error + parameters[2:4], RECORDED_GAIN_PER_S, 1.0 / RATE_HZ)


def used(segment: Segment) -> np.ndarray:
    """Rows that the fit uses."""
    return ~segment.near_contact & (segment.time_s > SETTLED_S)


def errors_nm(segments: list[Segment], parameters: np.ndarray) -> np.ndarray:
    """Observer less prediction, of all used rows, (rows, 2), [N m]."""
    return np.vstack([(-one.residual - predicted_nm(one, parameters))[used(one)] for one in segments])


def fit(segments: list[Segment], start: np.ndarray) -> np.ndarray:
    def loss(parameters: np.ndarray) -> np.ndarray:
        return np.asarray((errors_nm(segments, parameters) / SIZE_NM).ravel())

    found = least_squares(loss, start, x_scale=STEP, bounds=(LOW, HIGH), loss="soft_l1", diff_step=1e-3, xtol=1e-5)
    return np.asarray(found.x)


def jackknife(segments: list[Segment], best: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fits without one segment in turn (segments, parameters); the errors of each on that segment (rows, 2)."""
    left_out = [fit([s for s in segments if s is not out], best) for out in segments]
    unseen = np.vstack([errors_nm([out], found) for out, found in zip(segments, left_out, strict=True)])
    return np.array(left_out), unseen


# --- The test of the rig: networks trained on it alone.


def at_recorded_rate(path: Path, segments: list[Segment], tree: _core.Tree) -> _core.Bundle:
    """The bundle with the observer of the recording's rate and torque timing."""
    bundle = load_bundle(path)
    bundle.observer = _core.ObserverSettings(
        gain_per_s=bundle.observer.gain_per_s,
        timing=_core.TorqueTiming.averaged,
        sample_period_ns=round(1e9 / RATE_HZ),
        network_stride=1,
    )
    first = recording(segments[0], tree)
    samples = bundle.window_steps + 2
    bundle.set_reference(*(np.ascontiguousarray(a[:samples]) for a in (first.t_ns, first.q, first.dq, first.tau)))
    return bundle


def judged(bundle: _core.Bundle, segments: list[Segment], tree: _core.Tree) -> list[str]:
    """Cells: seconds, L1, L2, largest error; collisions found and false alarms at the bundle's limits; collisions whose
    estimate is larger than any error outside them."""
    tested = Tested()
    for segment in segments:
        found = estimates(bundle, recording(segment, tree))
        over = (np.abs(found["tau_ext"]) > found["limit_nm"]).any(axis=1)  # by one sample, as the paper counts
        tested.add(segment, found | {"held_alarm": np.where(over, COLLISION, 0)})
    errors = np.concatenate(tested.errors)
    above = sum((peak > errors.max(axis=0)).any() for peak in tested.peaks_nm)
    counts = f"{tested.found} of {tested.collisions}", tested.false_alarms, f"{above} of {tested.collisions}"
    limits = joined(bundle.sliding_limit_nm, ".1f", "/")
    return [f"{len(errors) / RATE_HZ:.0f}", *error_cells(errors), limits, *map(str, counts)]


def main() -> None:
    parser = arguments(__doc__, "data")
    parser.add_argument("bundles", nargs="*", type=Path, help="judged on the recording, instead of the fit")
    options = parser.parse_args()
    segments = read_segments(options.data)
    if options.bundles:
        columns = (
            "network | free motion, s | L1, N m | L2, N m | largest, N m | limits sliding, N m | found | false alarms"
        )
        print("\n".join(head(columns + " | above every error")))
        with tempfile.TemporaryDirectory() as folder:
            tree = nominal_tree(Path(folder) / "robot.xml")
            for path in options.bundles:
                bundle = at_recorded_rate(path, segments, tree)
                print(table_row(f"{path.parent.name}/{path.stem}", *judged(bundle, segments, tree)))
        return
    best = fit(segments, START)
    left_out, unseen = jackknife(segments, best)
    errors = np.sqrt((len(segments) - 1) * np.var(left_out, axis=0))
    rig = RigConfig()
    nominal = [link.com_m * link.mass_kg * 9.81 for link in rig.links]
    true = [link.true_com_m * link.mass_kg * 9.81 for link in rig.links]
    of_rig = [true[0] - nominal[0], true[1] - nominal[1], 0.0, 0.0]
    for joint in PAPER_FRICTION:
        of_rig += [
            joint.coulomb_nm,
            joint.static_nm - joint.coulomb_nm,
            joint.viscous_nm_s_rad,
            joint.load_share,
            float(np.log10(joint.bristle_nm_rad)),
        ]
    names = [*NAMES, *(f"{name}, joint {joint + 1}" for joint in range(2) for name in PER_JOINT)]
    print("\n".join(head("parameter (N m, rad, s) | recording | standard error | without one segment | rig")))
    for name, value, error, others, rigs in zip(names, best, errors, left_out.T, of_rig, strict=True):
        others_words = f"{others.min():.3f} to {others.max():.3f}"
        print(table_row(name, f"{value:.3f}", f"{error:.3f}", others_words, f"{rigs:.3f}"))
    print("\n" + "\n".join(head("joint | rows | L1, N m | RMS, N m | largest, N m")))
    left = errors_nm(segments, best)
    for joint in range(2):
        slow = np.concatenate([np.abs(one.dq[used(one), joint]) < NEAR_STICTION_RAD_S for one in segments])
        for rows, chosen in (("all", slow | True), ("sliding", ~slow), ("near stiction", slow)):
            e = np.abs(left[chosen, joint])
            print(table_row(joint + 1, rows, f"{e.mean():.3f}", f"{np.sqrt((e**2).mean()):.3f}", f"{e.max():.2f}"))
        e = np.abs(unseen[:, joint])
        print(table_row(joint + 1, "left out", f"{e.mean():.3f}", f"{np.sqrt((e**2).mean()):.3f}", f"{e.max():.2f}"))


if __name__ == "__main__":
    main()
