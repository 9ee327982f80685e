"""Tables and figures of benchmarks/real_arms.py, from what its commands wrote in OUT/ARM."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tauext.bundle.estimates import load_estimates
from tauext.data.recording_file import load_recording

HEALTHY_FROM_S = 0.5
"""r is warm."""
UR3_SETS = {
    "no-tool": "URDF without the tool",
    "tool": "URDF with the tool",
    "tool-four-runs": "URDF with the tool, four runs of trajectory 1",
    "no-model": "no model",
}
"""Name of a dataset of the UR3: what it is made with."""
EVENTS = {"id2": ((12.15, 12.24), (36.55, 36.68), (40.78, 40.9)), "second10": ((11.62, 11.67),)}
"""What happened in runs of the UR3, [s]; only the last, the impact, is labelled in the dataset."""
NEAR_S = 0.2
"""An alarm so long before an event or after it belongs to it."""


def ur3_tables(folder: Path) -> str:
    errors, alarms = [], []
    for data, label in UR3_SETS.items():
        for bundle in results(folder / f"{data}-results")["bundles"]:
            errors.append([label, bundle["name"], *error_cells(bundle, folder / data, "id2-test")])
            found = bundle["collisions"][0]
            hit = f"after {1e3 * found['delay_s']:.0f} ms ({found['joint']})" if found["found"] else "missed"
            rose = rises(folder, f"run {data}-bundles/{bundle['name']}.tauext ")
            near, others = [], []
            for recording, time_s, joint, level in rose:
                spans = EVENTS.get(recording, ())
                inside = any(a - NEAR_S <= time_s <= b + NEAR_S for a, b in spans)
                if inside and not time_s >= 40.7:
                    near.append(f"{recording} {time_s:.2f} s ({joint}, {level})")
                elif not inside:
                    others.append(f"{time_s:.2f}" if recording == "id2" else f"{recording} {time_s:.2f}")
            counted = f"{len(others)}" + (f": {', '.join(others[:6])}{' ...' * (len(others) > 6)} s" if others else "")
            alarms.append([label, bundle["name"], hit, "; ".join(near) or "none", counted])
    head = ["model, trained on id1 unless said", "method"]
    return "\n\n".join(
        [
            "RMS of the error on `id2.bag` before 40 s, Nm, joints 1 to 6, and the same in percent of the torque's RMS",
            markdown([*head, "error, Nm", "of the torque"], errors),
            "Alarms (contact or collision) on all of `id2.bag`, the run `second10` and the run `slow`",
            markdown([*head, "impact at 40.78 s", "unlabelled disturbances", "other alarms"], alarms),
        ]
    )


def panda_tables(folder: Path) -> str:
    with_model, without = results(folder / "results"), results(folder / "no-model-results")
    rows = [event_cells(bundle["name"], bundle["events"]["all"]) for bundle in with_model["bundles"]]
    rows += [event_cells(f"{c['name']}, no model", c["events"]["all"]) for c in without["bundles"]]
    rows.append(
        event_cells("the robot's own tau_ext, over its largest at rest", with_model["own_torque"]["events"]["all"])
    )
    by_file = []
    verdicts = with_model["bundles"][0]["events"]["verdicts"]
    for name in sorted({v["recording"] for v in verdicts}):
        of = [v for v in verdicts if v["recording"] == name]
        delays = [1e3 * v["delay_s"] for v in of if v["found"]]
        joints = {joint: sum(v["joint"] == joint for v in of) for joint in {v["joint"] for v in of if v["found"]}}
        told = ", ".join(f"{joint} {n}" for joint, n in sorted(joints.items()))
        by_file.append([name, f"{len(delays)} of {len(of)}", f"{np.median(delays):.0f}", f"{max(delays):.0f}", told])
    head = ["", "found", "missed", "false", "delay from the label, ms, median (95 %)", "from the re-timed onset"]
    return "\n\n".join(
        [
            "Touches of the five recordings that limits were not found on",
            markdown(head, rows),
            "The observer by recording: a 7, b 6, c 5, d 4, f 2 is the touched link",
            markdown(["recording", "found", "delay, ms, median", "largest", "first joint over its limit"], by_file),
        ]
    )


def event_cells(name: str, told: dict) -> list[str]:
    def delays(kind: str) -> str:
        median, most = (told[f"{kind}_{which}_s"] for which in ("median", "p95"))
        return "-" if median is None else f"{1e3 * median:.0f} ({1e3 * most:.0f})"

    found, events = told["found"], told["events"]
    false = f"{told['false_alarms']} in {3600 * told['free_hours']:.0f} s"
    return [name, f"{found} of {events}", str(events - found), false, delays("delay"), delays("delay_from_onset")]


def short_tables(recording: str) -> Callable[[Path], str]:
    def tables(folder: Path) -> str:
        told = results(folder / "results")["bundles"]
        rows = [[bundle["name"], *error_cells(bundle, folder / "data", recording)] for bundle in told]
        words = f"RMS of the error on the held-out `{recording}`, Nm, and in percent of the torque's RMS"
        return words + "\n\n" + markdown(["method", "error, Nm", "of the torque"], rows)

    return tables


def results(folder: Path) -> dict:
    return json.loads((folder / "results.json").read_text())


def error_cells(bundle: dict, data: Path, recording: str) -> list[str]:
    """RMS of the error of each joint, and its share of the torque's RMS over the same samples."""
    told = load_recording(data / f"{recording}.parquet")
    torque = np.sqrt((told.tau[told.time_s >= HEALTHY_FROM_S] ** 2).mean(axis=0))
    error = np.array(bundle["free_motion"]["l2_nm"])
    return [" ".join(f"{e:.2f}" for e in error), " ".join(f"{100 * share:.0f}" for share in error / torque) + " %"]


def rises(folder: Path, command: str) -> list[tuple[str, float, str, str]]:
    """(recording, time, joint, level) of every alarm that began in a `tauext run --json`; a contact that becomes a
    collision within half a second is one."""
    found: list[tuple[str, float, str, str]] = []
    for line in said(folder, command).splitlines():
        if not line.startswith("{"):
            continue
        event = json.loads(line)
        if event["event"] != "alarm" or event["alarm"] == "none" or event["was"] == "collision":
            continue
        one = (event["recording"], event["time_s"], event["joint"], event["alarm"])
        if found and found[-1][0] == one[0] and event["was"] == "contact" and one[1] - found[-1][1] < 0.5:
            found[-1] = (*found[-1][:3], one[3])
        else:
            found.append(one)
    return found


def markdown(head: list[str], rows: list[list[str]]) -> str:
    return "\n".join([f"| {' | '.join(head)} |", "|---" * len(head) + "|", *(f"| {' | '.join(row)} |" for row in rows)])


def draw(recording: Path, estimates: Path, joints: list[int], spans: list[tuple[float, float]], path: Path) -> None:
    """The estimate of some joints over time, their limits, and where something happened."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    from tauext.report.style import CASE_COLOURS, CONTACT, GREY, RC, SENSOR

    told, said = load_recording(recording), load_estimates(estimates)
    with rc_context(RC):
        figure = Figure(figsize=(10, 0.6 + 1.15 * len(joints)), layout="constrained")
        for axes, j in zip(figure.subplots(len(joints), 1, sharex=True, squeeze=False)[:, 0], joints, strict=True):
            for span in spans:
                axes.axvspan(*span, color=CONTACT)
            if told.tau_ext is not None:
                axes.plot(told.time_s, told.tau_ext[:, j], color=SENSOR, lw=0.8, label="the robot's own tau_ext")
            axes.plot(told.time_s, said.tau_ext[:, j], color=CASE_COLOURS["exact"], lw=0.9, label="tauext")
            for sign in (-1, 1):
                label = "limit" if sign > 0 else None
                axes.plot(told.time_s, sign * said.limit_nm[:, j], color=GREY, lw=0.5, ls="--", zorder=1, label=label)
            top = 3 * float(np.median(said.limit_nm[:, j])) if told.tau_ext is None else None
            axes.set_ylim(*((-top, top) if top else (None, None)))
            axes.set_ylabel(f"{told.joints[j].removesuffix('_joint')}\nNm")
            axes.margins(x=0)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3)
        axes.set_xlabel("time, s")
        figure.savefig(path, dpi=110)


def ur3_figure(folder: Path, path: Path) -> None:
    estimates = folder / "tool-results/estimates/prior/id2.parquet"
    draw(folder / "tool/id2.parquet", estimates, list(range(6)), list(EVENTS["id2"]), path)


def panda_figure(folder: Path, path: Path) -> None:
    recording = folder / "data/c3.parquet"
    told = load_recording(recording)
    edges = np.flatnonzero(np.diff(np.r_[0, told.contact == 1, 0])).reshape(-1, 2)
    spans = [(told.time_s[a], told.time_s[b - 1]) for a, b in edges]
    draw(recording, folder / "results/estimates/observer/c3.parquet", [0, 1, 2, 3], spans, path)


def file_of(folder: Path, command: str) -> Path:
    return folder / "said" / f"{re.sub(r'[^A-Za-z0-9.-]+', '_', command)[:120]}.txt"


def said(folder: Path, begins: str) -> str:
    """What the one command that begins so said."""
    (path,) = (folder / "said").glob(file_of(folder, begins).stem + "*")
    return path.read_text()
