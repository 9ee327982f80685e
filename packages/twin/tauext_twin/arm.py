"""What a twin is made of: a bundle, the recordings it was trained on, and the user's robot file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import butter, sosfiltfilt

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.bundle.match import expect_fit
from tauext.data.dataset import FILE_NAME, Dataset, load_dataset
from tauext.data.free_motion import cut, free_pieces
from tauext.data.recording import Recording, fitted_period_ns, periods_of
from tauext.errors import ConfigError
from tauext.fit.prior_facts import SHARED
from tauext.fit.torque_constants import ConstantsConfig
from tauext.fit.training_set import Setup
from tauext.robot.read import load_tree
from tauext.train.suspects import Suspect, without_suspects
from tauext_twin.model_file import KINDS

MOST_GAIN_PER_S = 10.0
"""Of the observer: a faster one passes more of a differentiated encoder's noise, which hides inertia."""
MOST_HZ = 10.0
"""Bandwidth of positions from which friction and inertia are found."""
GAP_S = 1.0
"""Lost samples of at most this time are filled, so that positions can be smoothed across them."""
HELD_OUT = 0.2
"""Share of each training recording that judges the twin where the dataset has no test recordings."""
PLACE_M, TURN = 2e-3, 2e-3
"""Differences of joints' places [m] and axes between two files of the same arm: rounding."""


@dataclass(frozen=True)
class Arm:
    """An arm's motion and its robot file."""

    bundle: _core.Bundle
    robot: Path
    usd: Path | None
    """The user's own stage; the robot file is then the dataset's."""
    setup: Setup
    """The robot file's tree, an observer with at most MOST_GAIN_PER_S, and the bundle's presliding states."""
    names: tuple[str, ...]
    """Joints as recorded; the tree has the robot file's names ..."""
    of_out: tuple[str, ...]
    """... and this is what the file that is written calls them."""
    terms: list[list[_core.Term]]
    """Friction terms of each joint."""
    training: list[Recording]
    test: list[Recording]
    """Free motion that the twin is not made of: the dataset's test recordings, or the ends of the training ones."""
    torque_error: np.ndarray
    """Standard error of each joint's torque constant beside the others, (n,), as a share ..."""
    torque_common: float
    """... and of all of them together."""

    @property
    def given(self) -> Path:
        """The user's file."""
        return self.usd or self.robot

    @property
    def units(self) -> np.ndarray:
        """Of the recorded torques, (n,), [N m]; 1 where unknown."""
        return np.array(self.setup.observer.nm_per_unit or [1.0] * len(self.names))

    @property
    def in_nm(self) -> np.ndarray:
        """Joints whose torque is known in N m, (n,) bool."""
        return ~np.array(self.setup.observer.unknown_constant or [False] * len(self.names), dtype=bool)

    @property
    def speed(self) -> float:
        """Narrowest smoothing of Coulomb friction, with which files are judged, [rad/s]."""
        return min(term.speed for of in self.terms for term in of if term.kind == _core.TermKind.coulomb)


def read_arm(bundle_file: Path, robot: Path | None, data: Path | None, names: Mapping[str, str]) -> Arm:
    """Read bundle, recordings and robot file, and refuse what cannot become a twin.

    Args:
        robot: URDF or MJCF, or the user's USD of the arm; None: the dataset's.
        data: dataset; None: the one near the bundle whose training recordings the bundle names.
        names: joint in the robot file by joint as recorded; the others have one name.

    Raises:
        TauextError: the bundle has no model or no prior; another arm's file; no dataset, or two.
    """
    bundle = load_bundle(bundle_file)
    if not bundle.prior.corrected_links or not any(link.mass > 0 for link in bundle.links):
        raise ConfigError(
            f"{bundle_file}: it has no model of the arm, or no prior; a twin needs a bundle of recipe prior or tauext "
            "that was trained with the arm's URDF or MJCF"
        )
    facts = json.loads(bundle.provenance or "{}")
    dataset = load_dataset(data) if data is not None else find_dataset(bundle_file, facts)
    usd = robot if robot is not None and KINDS.get(robot.suffix) == "USD" else None
    if usd is not None and not usd.is_file():
        raise ConfigError(f"{usd}: there is no such file")
    robot = dataset.robot_file(None if usd is not None else robot)
    joints = tuple(link.joint_name for link in bundle.links)
    if unknown := [name for name in names if name not in joints]:
        raise ConfigError(f"--names {unknown[0]}: no such joint was recorded; they are {', '.join(joints)}")
    in_file = joints if usd is not None else [names.get(name, name) for name in joints]
    tree = load_tree(robot, in_file, gravity=bundle.gravity)
    expect_same_arm(tree, bundle, robot)
    old = bundle.observer
    observer = _core.ObserverSettings(
        gain_per_s=min(old.gain_per_s, MOST_GAIN_PER_S), timing=old.timing, sample_period_ns=old.sample_period_ns,
        network_stride=old.network_stride, nm_per_unit=list(old.nm_per_unit or []),
        unknown_constant=list(old.unknown_constant or []),
    )  # fmt: skip
    training = dataset.training()
    training = free_pieces(without_suspects(training, suspects_of(facts, training)))
    test = free_pieces(dataset.recordings("test"))
    if not test:  # the end of each recording; the rest makes the twin
        ends = [round((1 - HELD_OUT) * one.samples) for one in training]
        test = [cut(one, slice(end, None)) for one, end in zip(training, ends, strict=True)]
        training = [cut(one, slice(0, end)) for one, end in zip(training, ends, strict=True)]
    for recording in (*training, *test):
        expect_fit(bundle, recording)
    training, test = [smooth(one) for one in training], [smooth(one) for one in test]
    own = [[term for term in bundle.prior.terms if term.a == j and term.kind not in SHARED] for j in range(len(joints))]
    setup = Setup(tree, observer, bundle.window_steps, bundle.prior)
    constants = facts.get("torque_constants") or {}
    error, common = torque_error(constants, joints), float(constants.get("common_share", 0.0))
    of_out = tuple(names.get(name, name) for name in joints)
    return Arm(bundle, robot, usd, setup, joints, of_out, own, training, test, error, common)


def smooth(recording: Recording) -> Recording:
    """A recording with even stamps, and positions and velocities without noise above MOST_HZ, without delay; the
    motion before and after a gap is smoothed by itself.

    A differentiated encoder and stamps that jitter make accelerations so noisy that inertia seems smaller than it is;
    torques stay as they are.
    """
    period_ns = fitted_period_ns(recording.t_ns)
    steps, rate_hz = periods_of(np.diff(recording.t_ns), period_ns), 1e9 / period_ns
    ticks, q, dq = np.r_[0.0, np.cumsum(steps)], recording.q.copy(), recording.dq.copy()
    low_pass = butter(2, min(MOST_HZ, rate_hz / 5), fs=rate_hz, output="sos")
    for rows in np.split(np.arange(recording.samples), np.flatnonzero(steps > GAP_S * rate_hz) + 1):
        at = (ticks[rows] - ticks[rows[0]]).astype(int)
        if at[-1] < 3 * rate_hz / MOST_HZ + 10:  # too short for the filter
            continue
        even = np.column_stack([np.interp(np.arange(at[-1] + 1), at, of_joint) for of_joint in q[rows].T])
        even = sosfiltfilt(low_pass, even, axis=0)
        q[rows], dq[rows] = even[at], np.gradient(even, 1 / rate_hz, axis=0)[at]
    return replace(recording, t_ns=recording.t_ns[0] + np.round(ticks * period_ns).astype(np.int64), q=q, dq=dq)


def find_dataset(bundle_file: Path, facts: Mapping[str, Any]) -> Dataset:
    """The dataset near a bundle that it was trained on, by the names of its recordings.

    Raises:
        ConfigError: none, or several.
    """
    trained_on = set(facts.get("recordings", {}).get("train", []))
    here = bundle_file.resolve().parent
    folders = {
        path.parent.resolve() for near in (here, here.parent, Path.cwd()) for path in near.glob(f"*/{FILE_NAME}")
    }
    folders |= {here} if (here / FILE_NAME).is_file() else set()
    found = []
    for folder in sorted(folders):
        try:
            dataset = load_dataset(folder)
        except ConfigError:  # a damaged neighbour is no reason to stop
            continue
        if trained_on and {Path(name).stem for name in dataset.split.train} == trained_on:
            found.append(dataset)
    if len(found) == 1:
        return found[0]
    which = "several datasets near it have" if found else "no dataset near it has"
    raise ConfigError(f"{bundle_file}: {which} the recordings that training used; name their folder with --data")


def expect_same_arm(tree: _core.Tree, bundle: _core.Bundle, robot: Path) -> None:
    """Raise ConfigError where the robot file's joints lie elsewhere than those of the bundle."""
    for link, known in zip(tree.links, bundle.links, strict=True):
        apart = float(np.abs(np.subtract(link.translation, known.translation)).max())
        turned = float(np.abs(np.subtract(link.rotation, known.rotation)).max())
        if apart > PLACE_M or turned > TURN or link.parent != known.parent or link.type != known.type:
            raise ConfigError(
                f"{robot}: joint '{link.joint_name}' lies {1e3 * apart:.0f} mm off its place in the bundle, or is "
                "turned; it is another arm's file, or --names is wrong"
            )


def suspects_of(facts: Mapping[str, Any], recordings: Sequence[Recording]) -> list[Suspect]:
    """The unlabelled contacts that training left out."""
    begins = {one.name: int(one.t_ns[0]) for one in reversed(recordings)}
    listed = [one for one in facts.get("suspects", {}).get("listed", []) if one["recording"] in begins]
    return [Suspect(**one, number=0, at_ns=0, begin_ns=begins[one["recording"]]) for one in listed]


def torque_error(constants: Mapping[str, Any], joints: tuple[str, ...]) -> np.ndarray:
    """Standard error of each joint's torque constant as a share, (n,): what training states, or that of a data sheet;
    0 where the recordings are in N m."""
    error = np.zeros(len(joints))
    for j, name in enumerate(joints if constants else ()):
        one = constants["found"][name]
        known = one["standard_error"] is not None and one["nm_per_unit"]
        error[j] = one["standard_error"] / one["nm_per_unit"] if known else ConstantsConfig.given_to
    return error
