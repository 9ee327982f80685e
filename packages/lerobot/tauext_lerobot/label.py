"""`tauext label`: external torque, contact and collision added to an existing LeRobot dataset."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Literal

from tauext.cli.arguments import JsonArg
from tauext.cli.progress import Terminal


def label(
    dataset: Path,
    bundle: Path,
    arm: Path,
    out: Path,
    calibration: Path | None = None,
    into: Literal["state", "features"] = "state",
    as_json: JsonArg = False,
) -> None:
    """Add external torque, contact and collision to every frame of a LeRobot dataset that has state and action only.

    Reads and writes datasets of v3.0 (lerobot 0.4 and later) and v2.1 (0.3); LeRobot itself is not needed. The torque
    follows from the goal (the action of the frame before) minus the state. Each episode starts a new monitor: while it
    warms up, for about a second, contact and collision are -1 (unknown). The input dataset is only read. The output
    appears complete or not at all; features and statistics are updated, videos linked or copied. Train the bundle on
    the same kind of data: `tauext import --source DATASET --arm arm.toml --out DIR`, then
    `tauext train --data DIR --out arm.tauext`.

    Args:
        dataset: folder of the LeRobot dataset, with meta/info.json in it.
        bundle: bundle (*.tauext) of this arm, trained on recordings of the same rate, with [servo] in its arm.toml.
        arm: arm.toml with which the bundle's recordings were imported; it names the joints in the state, and their
            units.
        out: folder to write; it must be empty or missing.
        calibration: LeRobot's calibration file of the arm (*.json), for states from -100 to 100; it replaces the one
            that arm.toml names.
        into: place of the labels. state: elements of observation.state, as a robot wrapped by lerobot_robot_tauext
            records them. features: observation.tau_ext, observation.contact and observation.collision; the state stays
            as policies were trained on it.
        as_json: print the counts as one JSON object.
    """
    from tauext.bundle.bundle_file import load_bundle
    from tauext.data.description import load_arm
    from tauext_lerobot.labels import label_dataset

    described = load_arm(arm, calibration)
    loaded = load_bundle(bundle)
    report = label_dataset(dataset, loaded, described, out, into, Terminal())
    if as_json:
        print(json.dumps({"out": str(out), **asdict(report)}))
        return
    known = report.frames - report.unknown
    share = f"{report.contact / known:.1%} of them in contact" if known else "every episode is shorter than the warm-up"
    print(f"{report.episodes} episodes, {report.frames} frames; {known} with an estimate, {share}")
    print(f"{report.collisions} collisions")
    if report.held:
        print(f"{report.equal} of {report.held} frames had the same values before")
    print(out)
