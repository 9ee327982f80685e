"""Positions of a stream without jumps of whole turns."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np

from tauext import _core
from tauext.data.recording import NEAR_TURN, TURN, runs_of
from tauext.monitor.source import Block, SourceSettings

MOST_TURNS = 100
"""A larger jump is a damaged number."""


class Turns:
    """Takes jumps of whole turns out of a stream's positions.

    A position that wraps at ±pi or at 0 and 2 pi jumps by a turn where the joint moves on; the encoder of a motor that
    restarts may lose turns. A step between two samples is such a jump if it differs from whole turns by no more than
    the joint can move in that time, at most a quarter of a turn, as for recordings (data.recording.unwrapped). A joint
    that has jumped stays in the nearest turn over a gap, too. The first position, and a first one after a silence, is
    put into the turn of the bundle's training. Other jumps stay: the monitor reports them.
    """

    fastest_rad_s = 20.0
    """No joint of an arm moves faster; what it may move between two samples is the tolerance of a jump."""
    silent_s = 1.0
    """Longer without a sample, an arm may have been moved by other means."""
    clearly_rad = 0.5
    """Distance by which another turn must be nearer to the trained positions."""

    def __init__(self, arm: SourceSettings, bundle: _core.Bundle | None = None):
        n = len(arm.joints)
        self._joints, self._period_s = arm.joints, arm.period_ns * 1e-9
        self._can_turn = [unit != "N" for unit in arm.torque_units or ("",) * n]
        self._low, self._high = np.full(n, np.nan), np.full(n, np.nan)
        self._last, self._step = np.full(n, np.nan), np.zeros(n)
        self._last_ns = 0
        self._turns = np.zeros(n)
        """Whole turns taken out of each position."""
        self._wraps, self._is_used = np.zeros(n, bool), np.zeros(n, bool)
        """Whether the position of a joint has jumped; whether turns were ever taken out of it."""
        self._any_used = False
        self._notes: list[str] = []
        if bundle is not None:
            self.follow(bundle)

    def follow(self, bundle: _core.Bundle) -> None:
        """Use the joints and the trained positions of this bundle from here on."""
        self._can_turn = [link.type == _core.JointType.revolute for link in bundle.links]
        self._low, self._high = trained_positions(bundle)

    def notes(self) -> list[str]:
        """New messages for the user: one at the first jump of each joint."""
        notes, self._notes = self._notes, []
        return notes

    def made(self, block: Block) -> Block:
        """The samples with continuous positions, and their goals in the same turns."""
        q, q_des = self.rows(block.t_ns, block.q, block.q_des)
        return block if q is block.q else replace(block, q=q, q_des=q_des)

    def rows(
        self, t_ns: np.ndarray, q: np.ndarray, q_des: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Positions and goals of successive samples, (samples, joints); unchanged where nothing jumps.

        Args:
            t_ns: stamps, (samples,), [ns].
        """
        given, goals = q, q_des
        if not len(given):
            return q, q_des
        begins = {0}
        if len(given) > 1:
            steps = np.abs(np.diff(given, axis=0))
            begins |= set((1 + np.flatnonzero(~(steps < math.pi).all(axis=1))).tolist())
        for begin, end in pairwise([*sorted(begins), len(given)]):
            self._see(int(t_ns[begin]), given[begin])
            if end > begin + 1:  # rows in which nothing jumps
                self._last[:], self._last_ns = given[end - 1], int(t_ns[end - 1])
            if not self._any_used:
                continue
            if q is given:
                q, q_des = q.copy(), None if goals is None else goals.copy()
            q[begin:end] -= TURN * self._turns
            if q_des is not None:
                q_des[begin:end] = self._goals(q_des[begin:end], q[begin:end])
        return q, q_des

    def _goals(self, q_des: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Goals in the turn of their positions."""
        return np.where(self._is_used, q_des + TURN * np.round((q - q_des) / TURN), q_des)

    def _see(self, t_ns: int, q: np.ndarray) -> None:
        """Update the turns for a position; runs once a sample."""
        np.subtract(q, self._last, out=self._step)
        np.abs(self._step, out=self._step)
        if self._step.max() < math.pi:  # False for NaN
            self._last[:], self._last_ns = q, t_ns
            return
        for joint in np.flatnonzero(~(self._step < math.pi)).tolist():
            value = float(q[joint])
            if self._can_turn[joint] and math.isfinite(value):
                self._take_out(joint, value, (t_ns - self._last_ns) * 1e-9)
        finite = np.isfinite(q)
        self._last[finite] = q[finite]
        if finite.all():
            self._last_ns = t_ns

    def _take_out(self, joint: int, value: float, since_s: float) -> None:
        """Judge a first position, or a step of more than half a turn, since_s after the last one."""
        before, wraps = float(self._last[joint]), self._wraps[joint]
        if math.isnan(before):
            self._land(joint, value)
            return
        whole = round((value - before) / TURN)
        was_away = since_s > self.silent_s and not wraps and not math.isnan(self._low[joint])
        most = NEAR_TURN[0] if was_away else math.pi if wraps else NEAR_TURN[1]
        near = min(max(NEAR_TURN[0], self.fastest_rad_s * max(since_s, self._period_s)), most)
        if 0 < abs(whole) <= MOST_TURNS and abs(value - before - TURN * whole) <= near:
            self._turn(joint, whole)
            self._wraps[joint] = True
            if not wraps:
                self._notes.append(f"position of {self._joints[joint]} jumped by a whole turn: unwrapped from here on")
        elif was_away:
            self._land(joint, value)

    def _land(self, joint: int, value: float) -> None:
        """Put a position into the turn of the trained ones where it is clearly nearer to them there."""
        low, high = float(self._low[joint]), float(self._high[joint])
        if math.isnan(low):
            return
        here = value - TURN * float(self._turns[joint])
        by = round((here - (low + high) / 2) / TURN)

        def away(q: float) -> float:
            return max(low - q, q - high, 0.0)

        if 0 < abs(by) <= MOST_TURNS and away(here - TURN * by) + self.clearly_rad < away(here):
            self._turn(joint, by)
            self._notes.append(
                f"position of {self._joints[joint]} begins at {value:.3g} rad, used as {here - TURN * by:.3g} rad: "
                "training was in that turn"
            )

    def _turn(self, joint: int, by: int) -> None:
        """Take so many more turns out of a position."""
        self._turns[joint] += by
        self._is_used[joint] = self._any_used = True


def trained_positions(bundle: _core.Bundle) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest position of each joint in training, (joints,) [rad]; NaN: unknown, or a prismatic joint.

    Coverage holds the trained positions within a turn, the reference is one of them. Where they cover the whole turn,
    the largest input of a network bounds them.
    """
    n = bundle.joints
    low, high = np.full(n, np.nan), np.full(n, np.nan)
    coverage, there = bundle.coverage, bundle.reference_q
    factors = bundle.input_factors if bundle.has_network else [0.0] * n
    for joint, link in enumerate(bundle.links):
        if link.type != _core.JointType.revolute:
            continue
        ends = None if coverage.empty or not there else _ends(coverage.seen[joint], there[joint])
        if ends is not None:
            low[joint], high[joint] = ends
        elif factors[joint]:
            low[joint], high[joint] = -1 / factors[joint], 1 / factors[joint]
    return low, high


def _ends(seen: int, there: float, least_gap: int = 6) -> tuple[float, float] | None:
    """Ends of the trained positions around one of them, [rad]; None: they cover the whole turn.

    Args:
        seen: bit of each cell of the turn from -pi to pi.
        there: a trained position.
        least_gap: least number of successive cells without a trained position, from which the others have two ends.
    """
    cells = _core.CoverageSettings.CELLS
    width = TURN / cells
    at = math.floor((there + math.pi) / width)
    gaps = runs_of(np.array([k > 0 and not seen >> (at + k) % cells & 1 for k in range(cells)]))
    begin, end = max(gaps.tolist(), key=lambda gap: gap[1] - gap[0], default=(0, 0))
    if end - begin < least_gap:
        return None
    return (at + end - cells) * width - math.pi, (at + begin) * width - math.pi
