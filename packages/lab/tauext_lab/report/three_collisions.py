"""Figure 8: three collisions on one joint; the sensor's torque, every bundle's estimate, limit and delays."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from tauext.bundle.estimates import Estimates
from tauext.data.recording import Recording
from tauext_lab.evaluate.results import CollisionVerdict, EvaluatedBundle, LabelledCollision, Results
from tauext_lab.report.signals import NotAvailable, Signals
from tauext_lab.report.style import (
    CONTACT,
    LIMIT,
    SENSOR,
    WIDTH_IN,
    Drawing,
    bundle_colours,
    draw_band,
    label_joint,
    missing_bundles,
    sigma_words,
)

SHOWN = 3
BEFORE_S, AFTER_S = 0.2, 0.45
CLOSE_BEFORE_S, CLOSE_AFTER_S = 0.02, 0.025
SENSOR_MARK = {"marker": "s", "markersize": 5, "markerfacecolor": "white", "markeredgewidth": 1.4, "zorder": 6}
FOUND_MARK = {"marker": "o", "markersize": 5.5, "zorder": 7}


@dataclass(frozen=True)
class Scene:
    """One collision on one joint: the sensor's reference and every available bundle's estimates."""

    collision: LabelledCollision
    recording: Recording
    estimates: dict[str, Estimates]
    verdicts: dict[str, CollisionVerdict]
    joint: int

    def rows(self, begin_s: float, end_s: float) -> np.ndarray:
        """Samples between two times that count from the onset of contact."""
        since_s = self.since_s()
        return (since_s >= begin_s) & (since_s <= end_s)

    def since_s(self) -> np.ndarray:
        return self.recording.time_s - self.collision.start_s

    def side(self) -> int:
        """+1 or -1: where the sensor goes, or the first estimate where there is none."""
        shown = self.sensor
        torque = next(iter(self.estimates.values())).tau_ext[:, self.joint] if shown is None else shown
        torque = np.nan_to_num(torque[self.rows(0, self.length_s + AFTER_S)])
        return 1 if torque[np.argmax(np.abs(torque))] >= 0 else -1

    @property
    def sensor(self) -> np.ndarray | None:
        """The joint's sensor, (samples,); without one the robot's own external torque; None without either."""
        known = self.recording.tau_ext_sensor
        known = self.recording.tau_ext if known is None else known
        return None if known is None else known[:, self.joint]

    @property
    def length_s(self) -> float:
        return self.collision.end_s - self.collision.start_s

    def impact_end_s(self) -> float:
        """End of the close-up, from the onset: shortly after sensor and every bundle have gone over the limit."""
        delays_s = [t for v in self.verdicts.values() for t in (v.delay_s, v.sensor_delay_s) if t is not None]
        return max(delays_s, default=0.1) + CLOSE_AFTER_S


def draw_three_collisions(results: Results, signals: Signals) -> Drawing:
    """Whole collisions above; the moment of impact and every bundle's delay below. One column per collision.

    Raises:
        NotAvailable: no collision was chosen or found, or the files of one are missing.
    """
    joint, collisions = choose(results)
    names = [bundle.name for bundle in results.shown]
    colours = bundle_colours([bundle.name for bundle in results.bundles])
    figure = Figure(figsize=(WIDTH_IN, 5.9 + 0.2 * len(names)), layout="constrained")
    heights = [2.6, 2.6, 0.25 * len(names) + 0.2]
    grid = figure.subplots(3, len(collisions), squeeze=False, height_ratios=heights)
    missing: set[str] = set()
    sensed, bands = True, ""
    for column, collision in enumerate(collisions):
        recording = signals.recording(collision.recording)
        sensed &= recording.tau_ext_sensor is not None
        estimates, without = signals.by_bundle(names, recording)
        missing |= set(without)
        bands = bands or sigma_words(estimates.values())
        if not ((recording.time_s >= collision.start_s) & (recording.time_s <= collision.end_s)).any():
            raise NotAvailable(f"collision {collision.id} lies outside its recording")
        verdicts = {c.name: c.verdicts[collision.id] for c in results.shown if collision.id in c.verdicts}
        scene = Scene(collision, recording, estimates, verdicts, joint)
        draw_whole(grid[0, column], scene, colours)
        draw_impact(grid[1, column], scene, colours, results.joints[joint])
        draw_delays(
            grid[2, column],
            scene,
            names,
            colours,
            results.joints[joint],
            labels=[] if column else [results.labels[name] for name in names],
        )
        grid[2, column].sharex(grid[1, column])
        grid[1, column].tick_params(labelbottom=False)
    for row in grid[:2]:
        label_joint(row[0], results.joints[joint], f"external torque, {results.unit_of(joint)}")
    grid[2, 0].set_ylabel("delay")
    drawn = [name for name in names if name not in missing]
    figure.legend(handles=legend(results, drawn, colours, sensed), loc="outside upper left", ncols=5)
    return Drawing(
        figure,
        f"Figure 8. {results.joints[joint]}, {len(collisions)} collisions: above, the external torque from the joint "
        f"torque sensor and the estimate of every bundle; below, the moment of impact. Each bundle has its own "
        f"threshold; a bar runs from where the sensor exceeds that threshold to where the estimate does, and the "
        f"number is the delay against the sensor; the first joint over its threshold counts. Time 0 is the onset of "
        f"contact."
        + missed_words(results, joint, collisions)
        + ("" if sensed else " There is no sensor here: delays count from the onset, as it is labelled.")
        + bands
        + missing_bundles(results, [n for n in names if n in missing])
        + results.shown_note,
    )


def missed_words(results: Results, joint: int, collisions: list[LabelledCollision]) -> str:
    """States that no bundle shown found what is drawn; empty where one did."""
    name = results.joints[joint]
    found = any(b.verdicts[c.id].joint == name for b in results.shown for c in collisions if c.id in b.verdicts)
    return "" if found else " No bundle shown found a collision here: the strongest one is drawn."


def choose(results: Results) -> tuple[int, list[LabelledCollision]]:
    """The first joint if three of the ten collisions were found there, else the joint with most; by that of the
    bundles shown which found most of them, of several the first.

    Of those, the three whose sensor peaks are largest, in order of time; fewer where there are fewer.
    """

    def found_by(bundle: EvaluatedBundle) -> list[LabelledCollision]:
        return [c for c in results.ten if c.id in bundle.verdicts and bundle.verdicts[c.id].joint in results.joints]

    best = max(results.shown, key=lambda bundle: len(found_by(bundle)))
    found, verdicts = found_by(best), best.verdicts
    if not found:
        return strongest_missed(results)
    counts = Counter(verdicts[c.id].joint for c in found)
    name = results.joints[0] if counts[results.joints[0]] >= SHOWN else counts.most_common(1)[0][0]
    joint = results.joints.index(name)
    there = [c for c in found if verdicts[c.id].joint == name]
    strongest = sorted(there, key=lambda c: -(c.sensor_peak_nm[joint] or 0.0))[:SHOWN]
    return joint, [c for c in there if c in strongest]


def strongest_missed(results: Results) -> tuple[int, list[LabelledCollision]]:
    """The joint and the collision with the largest sensor peak, where no collision was found.

    Raises:
        NotAvailable: no collision has a sensor peak.
    """
    peaks = [
        (peak, joint, collision)
        for collision in results.ten or results.collisions
        for joint, peak in enumerate(collision.sensor_peak_nm)
        if peak is not None
    ]
    if not peaks:
        raise NotAvailable("no bundle shown found a chosen collision, and none has a sensor peak")
    _, joint, collision = max(peaks, key=lambda one: one[0])
    return joint, [collision]


def draw_curves(axes: Axes, scene: Scene, rows: np.ndarray, colours: dict[str, str], unit_s: float) -> None:
    """Sensor, estimates and the first bundle's limit, on the side where the sensor goes."""
    time = scene.since_s()[rows] / unit_s
    for bundle, estimates in scene.estimates.items():
        tau_ext = estimates.tau_ext[rows, scene.joint]
        axes.plot(time, tau_ext, color=colours[bundle], zorder=4)
        sigma = None if estimates.band_nm is None else estimates.band_nm[rows, scene.joint]
        draw_band(axes, time, tau_ext, sigma, colours[bundle])
    if scene.sensor is not None:
        axes.plot(time, scene.sensor[rows], color=SENSOR, linewidth=2, zorder=3)
    limit = next(iter(scene.estimates.values())).limit_nm[rows, scene.joint]
    axes.plot(time, scene.side() * limit, color=LIMIT, linestyle="--", linewidth=1, zorder=2)
    axes.margins(x=0)


def draw_whole(axes: Axes, scene: Scene, colours: dict[str, str]) -> None:
    """The collision from before it until the estimate has come back."""
    axes.axvspan(0, scene.length_s, color=CONTACT, linewidth=0, zorder=0)
    draw_curves(axes, scene, scene.rows(-BEFORE_S, scene.length_s + AFTER_S), colours, unit_s=1.0)
    axes.set_title(f"{scene.recording.name}, {scene.collision.start_s:.2f} s")
    axes.set_xlabel("time since contact, s")


def draw_impact(axes: Axes, scene: Scene, colours: dict[str, str], joint: str) -> None:
    """From shortly before the contact until every bundle has found it; a dot where one goes over its limit here."""
    end_s = scene.impact_end_s()
    axes.axvspan(0, min(end_s, scene.length_s) * 1e3, color=CONTACT, linewidth=0, zorder=0)
    draw_curves(axes, scene, scene.rows(-CLOSE_BEFORE_S, end_s), colours, unit_s=1e-3)
    for bundle, estimates in scene.estimates.items():
        verdict = scene.verdicts.get(bundle)
        if verdict and verdict.delay_s is not None and verdict.joint == joint:
            at = min(int(np.searchsorted(scene.since_s(), verdict.delay_s - 1e-6)), scene.recording.samples - 1)
            height = estimates.tau_ext[at, scene.joint]
            axes.plot(verdict.delay_s * 1e3, height, color=colours[bundle], **FOUND_MARK)


def draw_delays(
    axes: Axes, scene: Scene, names: list[str], colours: dict[str, str], joint: str, labels: list[str]
) -> None:
    """One lane a bundle, from where the sensor goes over the limit to where the estimate does."""
    middle_ms = 500 * (scene.impact_end_s() - CLOSE_BEFORE_S)
    for lane, bundle in enumerate(names):
        verdict = scene.verdicts.get(bundle)
        times_ms = [t * 1e3 for t in (verdict.sensor_delay_s, verdict.delay_s) if t is not None] if verdict else []
        if verdict and verdict.found and verdict.sensor_delay_s is None:
            axes.plot(times_ms[0], lane, color=colours[bundle], **FOUND_MARK)
        if verdict and verdict.found and len(times_ms) == 2:
            axes.plot(times_ms, [lane, lane], color=colours[bundle], linewidth=2)
            axes.plot(times_ms[0], lane, color=colours[bundle], **SENSOR_MARK)
            axes.plot(times_ms[1], lane, color=colours[bundle], **FOUND_MARK)
        late = min(times_ms, default=0.0) > middle_ms
        axes.annotate(
            delay_text(verdict, joint, scene.recording.tau_ext_sensor is not None),
            (min(times_ms) if late else max(times_ms, default=0.0), lane),
            xytext=(-7 if late else 7, 0),
            textcoords="offset points",
            ha="right" if late else "left",
            va="center",
        )
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_yticks(range(len(names)), labels or [""] * len(names))
    axes.tick_params(axis="y", length=0)
    axes.set_xlabel("time since contact, ms")


def delay_text(verdict: CollisionVerdict | None, joint: str, sensed: bool) -> str:
    """Text of a lane; names the joint if another one found the collision.

    Without a sensor the delay is counted from the onset of contact as labelled.
    """
    if verdict is None:
        return "not available"
    if not verdict.found:
        return "not found"
    against = verdict.delay_against_sensor_s
    if against is None and not sensed:
        assert verdict.delay_s is not None  # of every one that was found
        text = f"{round(verdict.delay_s * 1e3)} ms"
    elif against is None:
        text = "sensor below"
    else:
        text = f"{round(against * 1e3):+d} ms".replace("+0", "0").replace("-", "−")
    return text if verdict.joint in (joint, None) else f"{text} ({verdict.joint})"


def legend(results: Results, drawn: list[str], colours: dict[str, str], sensed: bool) -> list[Line2D | Patch]:
    """Sensor first, then the bundles, then the marks."""
    grey = "#555555"
    reference = "sensor reference" if sensed else "recorded tau_ext, if any"
    lines = [Line2D([], [], color=SENSOR, linewidth=2, label=reference)]
    lines += [Line2D([], [], color=colours[name], label=results.labels[name]) for name in drawn]
    over = [Line2D([], [], color=grey, linestyle="none", **SENSOR_MARK, label="sensor over the threshold")]
    lines += [
        Line2D([], [], color=LIMIT, linestyle="--", label=f"threshold ({results.labels[drawn[0]]})"),
        Patch(color=CONTACT, label="contact"),
        *(over if sensed else []),
        Line2D([], [], color=grey, linestyle="none", **FOUND_MARK, label="estimate over the threshold"),
    ]
    return lines
