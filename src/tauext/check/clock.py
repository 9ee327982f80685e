"""Time stamps and rows: gaps, irregular steps, rows that repeat the one before."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext.check.finding import Finding, Severity
from tauext.check.motion import repeated_rows
from tauext.data.recording import Recording
from tauext.data.stamps import GAP_STEPS, fitted_period_ns

GAP = 3.0
"""Steps of more than three periods: one lost sample, even two, a controller's cycle may lose."""
IRREGULAR = 0.25
"""Spread of the steps, 1 to 99 %, as a share of the period: a clock on a busy computer stays below a tenth."""
IRREGULAR_BADLY = GAP_STEPS - 1
"""Beyond it jitter cannot be told from lost samples; below it training and monitor take it as it is."""
REPEATED = 0.005
"""Share of rows: in a measurement of several joints whole rows hardly ever agree in every bit."""
REPEATED_BADLY = 0.05


def clock_findings(recordings: Sequence[Recording]) -> list[Finding]:
    """Findings about all recordings together, [ms]."""
    steps = [np.diff(r.t_ns) * 1e-6 for r in recordings if r.samples > 2]
    if not steps:
        return []
    found = _gaps(recordings) + _spread(recordings)
    return found + _repeats(recordings)


def _gaps(recordings: Sequence[Recording]) -> list[Finding]:
    longest, count, period_ms = 0.0, 0, 0.0
    for recording in recordings:
        steps = np.diff(recording.t_ns) * 1e-6
        if not len(steps):
            continue
        period_ms = 1e-6 * fitted_period_ns(recording.t_ns)
        gaps = steps[steps > GAP * period_ms]
        count += len(gaps)
        longest = max(longest, float(gaps.max(initial=0)))
    if not count:
        return []
    evidence = f"{count} gaps of more than {GAP:g} sample periods ({period_ms:.3g} ms), the longest {longest:.4g} ms"
    advice = "the observer starts anew after each; look for lost packets, or record on the controller"
    return [Finding("clock-gaps", "warning", None, evidence, advice)]


def _spread(recordings: Sequence[Recording]) -> list[Finding]:
    worst: tuple[float, str] = (0.0, "")
    for recording in recordings:
        if recording.samples < 100:
            continue
        low, high = np.percentile(np.diff(recording.t_ns) * 1e-6, [1, 99])
        period_ms = 1e-6 * fitted_period_ns(recording.t_ns)
        spread = float(high - low) / period_ms
        told = f"'{recording.name}': steps of {low:.2f} to {high:.2f} ms (1 to 99 %), period {period_ms:.2f} ms"
        worst = max(worst, (spread, told))
    if worst[0] <= IRREGULAR:
        return []
    advice = (
        "stamp samples where they are measured, not where they arrive; velocities and r are only as good as the clock"
    )
    severity: Severity = "warning" if worst[0] > IRREGULAR_BADLY else "note"
    return [Finding("clock-irregular", severity, None, worst[1], advice)]


def _repeats(recordings: Sequence[Recording]) -> list[Finding]:
    repeats = [repeated_rows(r) for r in recordings]
    count, rows = sum(int(x.sum()) for x in repeats), sum(len(x) for x in repeats)
    if count < 3 or count / rows < REPEATED:
        return []
    runs = np.concatenate([_run_lengths(x) for x in repeats])
    fresh = np.concatenate([np.diff(r.t_ns[~x]) * 1e-6 for r, x in zip(recordings, repeats, strict=True)])
    severity: Severity = "warning" if count / rows >= REPEATED_BADLY else "note"
    evidence = f"{count / rows:.1%} of the rows equal the row before ({len(runs)} runs, up to {runs.max()} repeats)"
    if len(fresh):
        evidence += (
            f"; distinct rows are {np.median(fresh):.3g} ms apart, "
            f"99 % within {np.percentile(fresh, 99):.3g} ms, {1e3 / fresh.mean():.0f} a second on average"
        )
    advice = (
        "the state is refreshed more slowly than it is logged: log it at its own rate; where it is several times "
        'slower, drop repeats at import ([time] repeats = "drop")'
    )
    return [Finding("repeated-rows", severity, None, evidence, advice)]


def _run_lengths(flags: np.ndarray) -> np.ndarray:
    edges = np.flatnonzero(np.diff(np.r_[0, flags.astype(np.int8), 0]))
    return edges[1::2] - edges[::2]
