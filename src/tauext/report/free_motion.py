"""Figure 5: observer and uncertainty over time in free motion."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from tauext.report.drawing import Drawing, missing_bundles, uncertainty_words
from tauext.report.results import Results
from tauext.report.signals import NotAvailable, Signals
from tauext.report.style import OBSERVER, OBSERVER_WIDTH, WIDTH_IN, bundle_colours, label_joint

EXCERPT_S = 30.0
NARROWEST_IN = 6.0
"""Else the legend has no room."""


def draw_free_motion(results: Results, signals: Signals) -> Drawing:
    """One column a bundle, one row a joint: the first test recording, from where the estimate begins.

    Raises:
        NotAvailable: no test recording or no estimates of it.
    """
    names = [bundle.name for bundle in results.shown]
    recordings = [name for bundle in results.bundles for name in bundle.recordings]
    if not recordings:
        raise NotAvailable("the results name no test recording of free motion")
    recording = signals.recording(recordings[0])
    estimates, missing = signals.by_bundle(names, recording)
    healthy = np.flatnonzero(next(iter(estimates.values())).healthy)
    if len(healthy) == 0:
        raise NotAvailable(f"{recording.name} is shorter than the warm-up of observer and network")
    time_s = recording.time_s
    rows = (time_s >= time_s[healthy[0]]) & (time_s <= time_s[healthy[0]] + EXCERPT_S)
    colours, n = bundle_colours([bundle.name for bundle in results.bundles]), len(recording.joints)
    width = min(WIDTH_IN, max(NARROWEST_IN, 1.5 + 3.2 * len(estimates)))
    figure = Figure(figsize=(width, 0.7 + (1.75 if n <= 3 else 1.25) * n), layout="constrained")
    grid = figure.subplots(n, len(estimates), sharex=True, sharey="row", squeeze=False)
    for column, (bundle, said) in enumerate(estimates.items()):
        for joint in range(n):
            axes = grid[joint, column]
            axes.plot(time_s[rows], said.r[rows, joint], color=OBSERVER, linewidth=OBSERVER_WIDTH)
            axes.plot(time_s[rows], said.uncertainty[rows, joint], color=colours[bundle])
            axes.margins(x=0)
        grid[0, column].set_title(results.labels[bundle].replace(", ", ",\n"), color=colours[bundle], fontweight="bold")
        grid[-1, column].set_xlabel("time, s")
    for joint, name in enumerate(recording.joints):
        label_joint(grid[joint, 0], name, f"torque, {results.unit_of(joint)}")
    what = uncertainty_words(estimates.values())
    handles = [
        Line2D([], [], color=OBSERVER, linewidth=OBSERVER_WIDTH, label="observer r"),
        Line2D([], [], color="#333333", label=f"{what}, in the colour of its model"),
    ]
    figure.legend(handles=handles, loc="outside upper left", ncols=2)
    return Drawing(
        figure,
        f"Figure 5. Free motion, test recording {recording.name}: output of the momentum observer (grey) and what "
        f"was learned for that model ({what}). In free motion the observer shows what the model gets wrong: that is "
        f"learned. Axes of a row have one scale." + missing_bundles(results, missing) + results.shown_note,
    )
