"""Which link of a standing Panda people touched: our estimates and the robot's own, link by link.

    python benchmarks/panda_touches.py DATASET BUNDLES OUT [--meshes ROBOT]

DATASET: the panda_mindlab recordings as `benchmarks/real_arms.py` imports them (runs/real-arms/panda/data; a file a
link, with labels and the robot's own estimate). BUNDLES: its folder bundles (observer.tauext, bandpass.tauext). OUT
gets panda_touches.md. Nothing is tuned here: links are found by the observer's bundle, whose standard error is that of
its own limits. The other two estimates get the standard error of their samples without a touch. Shapes are those of the
simulated Panda, guesses, and with --meshes those of a Panda's robot file whose meshes are there.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from common import arguments, head, runs, table_row, write_tables
from links import GIVEN, GUESSED, THIN, thin_capsules
from unseen.surfaces import SURFACES, capsules_of

from tauext import _core
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording
from tauext.monitor.touch_place import STATED, run_of
from tauext.robot.capsules import body_capsules, link_capsules
from tauext.robot.read import load_tree, placed_bodies

TOUCHED = {"a4": 7, "a6": 7, "b8": 6, "b9": 6, "c3": 5, "d3": 4, "f2": 2, "f4": 2}
"""Link that people touched in each recording, from 1."""
FREE_S = 0.15
"""From a label: samples nearer to it are neither touched nor free."""
LATE_S = 0.1
"""Labels begin up to so long before a touch shows."""
OWN_SHOWS = 3.0
"""Standard errors from which on the touched link's own joint shows a touch."""


def main() -> None:
    parser = arguments(__doc__, "dataset", "bundles", "out")
    parser.add_argument("--meshes", type=Path, help="robot file with panda_joint1 to 7, whose meshes can be read")
    options = parser.parse_args()
    bundles = {name: _core.Bundle.load(str(options.bundles / f"{name}.tauext")) for name in ("observer", "bandpass")}
    recordings = {name: load_recording(options.dataset / f"{name}.parquet") for name in TOUCHED}
    arm = bundles["observer"]
    thin, joints = thin_capsules(arm), [link.joint_name for link in arm.links]
    shapes = {GIVEN: capsules_of(SURFACES["panda"]), GUESSED: [], THIN: thin}
    parts = parts_of(options.dataset / "robot.urdf", joints)
    shapes[FINGERS] = [one for one in thin if one.link not in {part.link for part in parts}] + parts
    if options.meshes is not None:
        shapes["meshes"], lost = link_capsules(options.meshes, load_tree(options.meshes, joints))
        assert not lost, lost
    tables: dict[str, dict[str, dict]] = {}
    for title, name in (("observer", "observer"), ("observer with a band-pass", "bandpass")):
        told = {}
        for key, one in recordings.items():
            told[key] = _core.estimate(bundles[name], one.t_ns, one.q, one.dq, one.tau, 1)["tau_ext"]
        tables[title] = by_shapes(arm, shapes, recordings, told, own=name == "observer")
    own = {name: one.tau_ext for name, one in recordings.items() if one.tau_ext is not None}
    tables["the robot's own estimate"] = by_shapes(arm, shapes, recordings, own, own=False)
    write_tables(options.out, markdown(tables), name="panda_touches")


FINGERS = "5 cm capsules and fingers"


def parts_of(robot: Path, joints: list[str]) -> list[_core.Capsule]:
    """What a robot file without its meshes still has: of the Panda's, boxes of the two fingers."""
    bodies, found = body_capsules(robot).bodies, []
    for body in placed_bodies(robot, load_tree(robot, joints))[2]:
        for start, end, radius in bodies.get(body.name, []):
            ends = [(body.translation + body.rotation @ np.array(one)).tolist() for one in (start, end)]
            found.append(_core.Capsule(body.link, *ends, radius))
    return found


def by_shapes(
    arm: _core.Bundle,
    shapes: Mapping[str, list[_core.Capsule]],
    recordings: dict[str, Recording],
    told: dict[str, np.ndarray],
    own: bool,
) -> dict[str, dict]:
    """table_of() for each kind of shapes."""
    tables = {}
    for kind, capsules in shapes.items():
        arm.capsules = capsules
        tables[kind] = table_of(arm, recordings, told, own)
    return tables


def touches_of(recording: Recording) -> list[slice]:
    """Rows of each labelled touch, from its label to LATE_S after it."""
    late = round(LATE_S * recording.rate_hz)
    return [slice(begin, end + late) for begin, end in runs(np.asarray(recording.contact) > 0)]


def free_rows(recording: Recording) -> np.ndarray:
    """Of samples that no touch is near."""
    label = np.asarray(recording.contact) > 0
    reach = round(FREE_S * recording.rate_hz)
    near = np.convolve(label, np.ones(2 * reach + 1), "same") > 0
    near[: 2 * reach] = True  # the observer begins
    return ~near


def table_of(bundle: _core.Bundle, recordings: dict[str, Recording], told: dict[str, np.ndarray], own: bool) -> dict:
    """Links by the arm of this bundle. own: with the bundle's standard error, else with that of the free samples."""
    model = _core.PlaceModel(bundle)
    assert not model.refused, model.refused
    free = np.concatenate([told[name][free_rows(one)] for name, one in recordings.items()])
    held = np.array(bundle.error_scale.sigma_near_weights)
    sigma = held if own else np.sqrt(np.nanmean(free**2, axis=0))
    confusion, two, stated, sure, shows = np.zeros((7, 7), dtype=int), 0, 0, 0, 0
    in_runs: list[bool] = []
    for name, recording in recordings.items():
        touched = TOUCHED[name] - 1
        for rows in touches_of(recording):
            tau = told[name][rows]
            strength = np.square(tau / sigma).sum(axis=1)
            if not np.isfinite(strength).any():
                continue
            at = int(np.nanargmax(strength))
            found = model.find(recording.q[rows][at].tolist(), tau[at].tolist(), sigma.tolist(), places=False)
            confusion[touched, found.ranked[0]] += 1
            two += touched in found.ranked[:2]
            if found.probability[found.ranked[0]] >= STATED:
                stated, sure = stated + 1, sure + (found.ranked[0] == touched)
            first, last, probability = run_of([(link, found.probability[link]) for link in found.ranked])
            if probability >= STATED:
                in_runs.append(first <= touched <= last)
            shows += abs(tau[at, touched]) >= OWN_SHOWS * sigma[touched]
    return {
        "confusion": confusion,
        "two": two,
        "stated": stated,
        "sure": sure,
        "runs": len(in_runs),
        "in runs": sum(in_runs),
        "own": shows,
        "sigma": sigma,
    }


def markdown(tables: dict[str, dict[str, dict]]) -> list[str]:
    """By estimate and shapes, then touched and most probable links."""
    columns = ("estimate", "shapes", "touches", "right", "among two", "stated", "of these right", "link or run")
    lines = head(" | ".join([*columns, "of these right", "own joint over three standard errors"]))
    for by, kinds in tables.items():
        for kind, one in kinds.items():
            confusion = one["confusion"]
            counts = (one[key] for key in ("two", "stated", "sure", "runs", "in runs", "own"))
            lines.append(table_row(by, kind, confusion.sum(), np.trace(confusion), *counts))
    for by, kinds in tables.items():
        for kind in (GIVEN, GUESSED):
            lines += ["", f"{by}, {kind}", "", *head(" | ".join(["touched", *(str(k + 1) for k in range(7))]))]
            confusion = kinds[kind]["confusion"]
            lines += [table_row(k, *(n or "" for n in confusion[k - 1])) for k in sorted(set(TOUCHED.values()))]
    return lines


if __name__ == "__main__":
    main()
