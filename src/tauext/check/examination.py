"""The recordings under examination, as the checks so far have corrected them."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from tauext import _core
from tauext.check.finding import Finding, Found
from tauext.check.joint_fit import LEAST_ROWS, FitRows, JointFit, fit_joint, rows_of
from tauext.check.motion import Stretch, VelocityFit, stretches
from tauext.data.recording import Recording
from tauext.data.servo import torque_unit

SEARCH_S = 30.0
"""Motion needed to judge order, axes and delay of the torque: with less, some arrangement fits by chance."""


@dataclass
class Examination:
    """Recordings of one arm, corrected by the checks so far, and what follows from them."""

    recordings: Sequence[Recording]
    robot: Path | None = None
    gravity: Sequence[float] | None = None  # acceleration of free fall in the base frame; None: the robot file's
    called_free: Collection[str] = ()  # names of recordings declared free of contact
    torque_limits_nm: np.ndarray | None = None
    """(joints,) of the robot file, infinite where it has none; None: no robot file."""
    position_limits_rad: np.ndarray | None = None
    """(joints, 2) of the robot file, infinite where it has none; None: no robot file."""
    found: dict[str, list[Finding]] = field(default_factory=dict)  # findings so far, by step
    spoiled: bool = False  # whether a fault of the signals may look like a contact
    tree: _core.Tree | None = None
    model_joints: Sequence[str] = ()
    """Names of the joints in the robot file."""
    impossible: Sequence[Any] = ()
    """Links with inertias that no body can have: `robot_file.ImpossibleInertia`."""
    recorded: Sequence[Recording] = ()  # the recordings before corrections of their torque
    added: list[Found] = field(default_factory=list)  # results of the checks of packages
    velocities: list[VelocityFit | None] = field(default_factory=list)
    lags: list[tuple[float, float, float]] = field(default_factory=list)
    """Lag of each joint's torque, see `effort.torque_lags`."""
    lag_s: float = 0.0  # delay of the torque, [s]

    @cached_property
    def motion(self) -> list[Stretch]:
        return stretches(self.recordings)

    @cached_property
    def rows(self) -> FitRows:
        """Rows of the fits, of a motion that is not empty."""
        return rows_of(self.motion, self.tree, self.lag_s)

    @cached_property
    def fits(self) -> list[JointFit]:
        return [fit_joint(self.rows, j) for j in range(self.rows.joints)]

    @property
    def joints(self) -> tuple[str, ...]:
        return self.recordings[0].joints

    @property
    def model(self) -> _core.Tree:
        """The tree, for checks that need one."""
        assert self.tree is not None
        return self.tree

    @property
    def unit(self) -> str:
        """Unit of the torque."""
        return torque_unit(self.recordings)

    @property
    def unsigned(self) -> bool:
        """Whether a torque has no sign, so that no other check of it applies."""
        return any(one.unsigned for one in self.added)

    @property
    def all_found(self) -> list[Finding]:
        return [finding for of_step in self.found.values() for finding in of_step]

    @property
    def has_fit(self) -> bool:
        """Whether the torques can be fitted: the arm moves, for long enough."""
        stands = any(finding.code == "never-moves" for finding in self.all_found)
        return not (stands or self.unsigned) and bool(self.motion) and len(self.rows.time_s) >= LEAST_ROWS

    @property
    def moving_s(self) -> float:
        """Time in which some joint moves, [s]."""
        return sum(float(s.moves.sum()) / s.rate_hz for s in self.motion)

    def correct(self, **corrected: Any) -> None:
        """Set corrected recordings, motion, tree or lag; what follows from them is computed again when needed."""
        for name in ("rows", "fits", *(["motion"] if "recordings" in corrected else [])):
            vars(self).pop(name, None)
        vars(self).update(corrected)

    def leave_out(self, odd: Sequence[Finding]) -> Sequence[Finding]:
        """Leave out the recordings of these findings, and return the findings."""
        names = {finding.recording for finding in odd}
        if odd:
            self.correct(recordings=[r for r in self.recordings if r.name not in names])
        return odd
