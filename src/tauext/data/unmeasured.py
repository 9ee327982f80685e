"""Rows in which a driver measured nothing: constant before it was ready, after it stopped, or in between."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tauext.data.recording import runs_of

UNMEASURED = "samples dropped: constant, beside a jump that no motion makes: the driver measured nothing"


@dataclass(frozen=True)
class Rules:
    """When constant values are no measurement."""

    least_s: float = 0.2
    least_rows: int = 5
    """A shorter run is a repeated sample ..."""
    jump: float = 3.0
    """... and a smaller step at its end, as a multiple of the largest usual step, is motion after a rest ..."""
    least_share: float = 0.02
    """... as is a step below this share of the range: a joint that rests steps by a count now and then."""
    gap: float = 2.5
    """A step over a longer time, in sample periods, is no jump: the arm moved meanwhile."""
    usual: float = 99.9
    """Percentile of the steps between other rows that is the largest usual one: spikes are rarer."""
    most_runs: int = 5
    """More runs of constant torques are a trait: torques of few steps, a dead band, or rests without noise."""


def unmeasured(
    t_ns: np.ndarray, q: np.ndarray, tau: np.ndarray, turn: float | None = None, rules: Rules = Rules()
) -> np.ndarray:
    """Rows, (samples,) bool, in which positions or torques are no measurements.

    They are equal to the last bit for a while, and beside the run some value jumps further than it ever does between
    two other rows. A single position suffices: no joint jumps. Torques must be constant at all joints at once, and the
    positions must not, unless the torques are 0: an arm that rests without noise has constant torques.

    Args:
        q, tau: (samples, joints), in any unit; tau may be empty.
        turn: a whole turn in the unit of q; steps of whole turns are no jumps.
    """
    found = np.zeros(len(t_ns), dtype=bool)
    if len(t_ns) < 3 * rules.least_rows:
        return found
    same_q = q[1:] == q[:-1]
    runs_q = [_long(t_ns, same, rules) for same in same_q.T]
    if any(map(len, runs_q)):
        steps = np.abs(np.diff(q, axis=0))
        steps = np.abs(steps - turn * np.round(steps / turn)) if turn else steps
        # the fastest joint bounds the steps of those that rest
        usual = max(_usual(steps[:, j], ~same_q[:, j], runs, rules) for j, runs in enumerate(runs_q))
        for j, runs in enumerate(runs_q if usual else ()):
            least = max(rules.jump * usual, rules.least_share * float(np.ptp(q[:, j])))
            _mark(found, runs, _jumps(t_ns, steps[:, j : j + 1], np.array([least]), rules))
    if not tau.shape[1]:
        return found
    same = tau[1:, 0] == tau[:-1, 0]
    at = np.flatnonzero(same)  # most rows drop out here
    same[at] = (tau[at + 1] == tau[at]).all(axis=1)
    runs = _long(t_ns, same, rules)
    if 0 < len(runs) <= rules.most_runs:
        steps = np.abs(np.diff(tau, axis=0))
        usual_nm = np.array([_usual(column, ~same, runs, rules) for column in steps.T])
        least_nm = np.maximum(rules.jump * usual_nm, rules.least_share * np.ptp(tau, axis=0))
        jumps = _jumps(t_ns, steps, np.where(usual_nm > 0, least_nm, np.inf), rules)
        moves = [not same_q[first : after - 1].all() or not tau[first].any() for first, after in runs]
        _mark(found, runs[moves], jumps)
    return found


def _long(t_ns: np.ndarray, same: np.ndarray, rules: Rules) -> np.ndarray:
    """First row, and the row after the last, of each long run of rows that equal the one before, (runs, 2)."""
    runs = runs_of(same)
    runs = runs[np.ptp(runs, axis=1) >= rules.least_rows - 1] if len(runs) else runs
    return runs[(t_ns[runs[:, 1]] - t_ns[runs[:, 0]]) * 1e-9 >= rules.least_s] + [0, 1]


def _usual(steps: np.ndarray, moved: np.ndarray, runs: np.ndarray, rules: Rules) -> float:
    """Largest usual step of a signal apart from those into and out of the runs; 0 where there are few."""
    moved = moved.copy()
    moved[np.r_[np.maximum(runs[:, 0] - 1, 0), np.minimum(runs[:, 1] - 1, len(moved) - 1)]] = False
    return float(np.percentile(steps[moved], rules.usual)) if moved.sum() >= 10 * rules.least_rows else 0.0


def _jumps(t_ns: np.ndarray, steps: np.ndarray, least: np.ndarray, rules: Rules) -> np.ndarray:
    """Whether some column jumps between each row and the next, (samples - 1,) bool."""
    times = np.diff(t_ns)
    return (steps > np.maximum(least, 1e-300)).any(axis=1) & (times <= rules.gap * np.median(times))


def _mark(found: np.ndarray, runs: np.ndarray, jumps: np.ndarray) -> None:
    """Mark the runs at either end of which there is a jump."""
    for first, after in runs.tolist():
        if (first > 0 and jumps[first - 1]) or (after <= len(jumps) and jumps[after - 1]):
            found[first:after] = True
