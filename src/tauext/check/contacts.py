"""Contacts in free motion, found from labels or from torque that the motion does not explain."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from tauext import _core
from tauext.check.finding import Finding
from tauext.check.joint_fit import (
    CONSTANT,
    FRICTION,
    LEAST_ROWS,
    PRESLIDING_RAD,
    FitRows,
    columns_of,
    picked,
    robust_solve,
    robust_spread,
    rows_of,
)
from tauext.check.motion import MOVING_RAD_S, POSITION_CUTOFF_HZ, Stretch, low_pass, stretches
from tauext.config import FreeMotionConfig
from tauext.data.recording import Recording, runs_of
from tauext.data.servo import torque_unit

CUTOFF_HZ, ROWS_HZ = 10.0, 50.0
"""Cut-off, [Hz]: an impact lasts 50 to 200 ms, and the low-pass of the fits would halve it."""
END_S = 0.1
"""Left out at the ends of a stretch, four filter time constants: the filter lacks data there. A longer margin would
hide an impact that ends a program."""
USUAL = 90
"""Percentile of the windows' largest errors that counts as usual; friction at reversals makes it several times their
spread."""
ALONE, SPREADS_ALONE = 5.0, 8.0
"""Thresholds at one joint: multiples of the usual error and of the spread. Good recordings reached 4.1 times the usual
error."""
TOGETHER, SPREADS_TOGETHER = 4.0, 6.0
"""The same thresholds for two joints in one window: a contact also acts on the joints before its link."""


def contact_findings(recordings: Sequence[Recording], called_free: Collection[str] = ()) -> list[Finding]:
    """Recordings that are called free, by `called_free` or by what made them, and hold samples labelled contact.

    No fault: what is labelled is left out of training and limits; what the label misses at its ends is not.
    """
    found = []
    for r in recordings:
        free = r.name in called_free or r.provenance.get("contacts") == "none"
        if not free or r.contact is None or not (r.contact == 1).any():
            continue
        touched = r.contact == 1
        first = r.time_s[int(touched.argmax())]
        evidence = f"'{r.name}': {touched.mean():.1%} of the samples are labelled contact, the first at {first:.2f} s"
        advice = (
            "they are left out of training and limits; list the recording with the collisions, or exclude the "
            "interval, if the labels may begin late or end early"
        )
        found.append(Finding("contact-in-free-motion", "warning", None, evidence, advice, r.name))
    return found


def unlabelled_findings(recordings: Sequence[Recording], tree: _core.Tree | None, lag_s: float = 0.0) -> list[Finding]:
    """Find disturbances far beyond the usual error that training would use as free motion; one finding for all.

    The check covers all motion that training uses. It excludes the surroundings of a label, as training does; a label
    that comes later is found. Without a model there is no finding, since an error of gravity at a rare pose resembles a
    push. Impacts and pushes below a few times the error at friction reversals are not found.

    Args:
        recordings: without faults of their signals.
        tree: the model, or None.
        lag_s: delay of the torque, [s].
    """
    # the torque through the positions' own filter, or steps of acceleration would appear in the torque alone
    motion = [
        replace(s, tau=low_pass(s.tau, min(POSITION_CUTOFF_HZ, 0.3 * s.rate_hz), s.rate_hz))
        for s in stretches(recordings, contacts=True)
    ]
    if not motion or tree is None:
        return []
    rows = rows_of(motion, tree, lag_s, CUTOFF_HZ, ROWS_HZ, END_S)
    free = ~near_label(rows, recordings)
    known = np.concatenate([picked(has_moved(s), s.rate_hz, ROWS_HZ, END_S) for s in motion])
    if free.sum() < LEAST_ROWS:
        return []
    errors, friction = (
        np.stack(x, axis=1) for x in zip(*(_error(rows, j, free) for j in range(rows.joints)), strict=True)
    )
    spread = np.maximum([robust_spread(x) for x in errors[free].T], 1e-12)
    errors[~(known & free[:, None])] = 0.0
    number = np.unique((rows.time_s // 0.5).astype(int), return_inverse=True)[1]
    windows = np.split(np.arange(len(number)), np.flatnonzero(np.diff(number)) + 1)
    largest = np.stack([np.abs(errors[at]).max(axis=0) for at in windows])
    moving = np.array([(np.abs(rows.dq[at]) > MOVING_RAD_S).any() for at in windows])
    if moving.sum() < 60:  # half a minute
        return []
    usual = np.maximum(np.percentile(largest[moving], USUAL, axis=0), 1e-12)
    swings = np.stack([np.ptp(rows.tau[at], axis=0) for at in windows])
    crawls = np.stack([np.abs(rows.dq[at]).min(axis=0) < 0.05 for at in windows])
    # steps of acceleration leave errors, too
    least = 0.1 * np.maximum(swings, rows.tau.std(axis=0))
    # slow joints may stick and slip: their errors must exceed half of the friction as well
    seen = largest > least + 0.5 * crawls * np.percentile(np.abs(friction), USUAL, axis=0)
    times, spreads = largest / usual, largest / spread
    alone = seen & (times > ALONE) & (spreads > SPREADS_ALONE)
    together = seen & (times > TOGETHER) & (spreads > SPREADS_TOGETHER)
    touched = alone.any(axis=1) | (together.sum(axis=1) >= 2)
    if not touched.any():
        return []
    begins = np.flatnonzero(touched & ~np.r_[False, touched[:-1]])
    strongest = begins[np.argsort(-times[begins].max(axis=1))][:3]
    listed = [_described(rows, errors, windows[k], int(np.argmax(times[k])), times[k].max(), recordings)
            for k in strongest]  # fmt: skip
    what = "disturbance" if len(begins) == 1 else "disturbances"
    evidence = f"{len(begins)} {what} of the torque that the motion does not explain: {'; '.join(listed)}"
    advice = "inspect these times: keep contacts out of training and limits, by a label or by cutting the recording"
    return [Finding("contact-in-free-motion", "warning", None, evidence, advice)]


def has_moved(stretch: Stretch) -> np.ndarray:
    """(samples, joints) bool: the joint has moved far enough to determine the direction of friction."""
    gone = np.maximum.accumulate(np.abs(stretch.q - stretch.q[0]), axis=0)
    return gone > 2 * max(PRESLIDING_RAD)


def is_unlabelled_contact(finding: Finding) -> bool:
    """Whether `unlabelled_findings` made this finding."""
    return finding.code == "contact-in-free-motion" and finding.recording is None


def near_label(rows: FitRows, recordings: Sequence[Recording]) -> np.ndarray:
    """Rows (rows,) bool that training leaves out because a labelled contact is near."""
    margins, start_s = FreeMotionConfig(), 0.0
    near = np.zeros(len(rows.time_s), dtype=bool)
    for r in recordings:
        for first, after in [] if r.contact is None else runs_of(r.contact == 1).tolist():
            begin, end = start_s + r.time_s[first] - margins.before_s, start_s + r.time_s[after - 1] + margins.after_s
            near |= (rows.time_s >= begin) & (rows.time_s <= end)
        start_s += r.duration_s
    return near


def _error(rows: FitRows, j: int, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Error of one joint's torque after a fit of gravity, inertia and friction to free rows, and the friction; (rows,),
    [N m]."""
    columns, torque = columns_of(rows, j), rows.tau[:, j]
    weights = robust_solve(columns[free], torque[free])[0]
    error = torque - columns @ weights
    resists = slice(CONSTANT + 1, CONSTANT + FRICTION)
    return error - np.median(error[free]), columns[:, resists] @ weights[resists]


def _described(
    rows: FitRows,
    errors: np.ndarray,
    at: np.ndarray,
    joint: int,
    times: float,
    recordings: Sequence[Recording],
) -> str:
    peak = at[int(np.argmax(np.abs(errors[at, joint])))]
    recording = int(rows.recording[peak])
    since = rows.time_s[peak] - sum(r.duration_s for r in recordings[:recording])
    r = recordings[recording]
    where = f"'{r.joints[joint]}' at {since:.1f} s of '{r.name}'"
    return f"{errors[peak, joint]:.3g} {torque_unit(recordings)} at {where}, {times:.0f} times the usual error"
