"""`tauext label`: external torque, contact and collision added to an existing LeRobot dataset."""

from __future__ import annotations

from typing import Annotated, Literal

import tyro

from tauext.cli.place_argument import PlaceArg
from tauext.files.copies import local_file, local_folder, staged


def label(
    dataset: PlaceArg,
    bundle: PlaceArg,
    arm: PlaceArg,
    out: PlaceArg,
    calibration: PlaceArg | None = None,
    into: Literal["state", "features"] = "state",
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> None:
    """Add external torque, contact and collision to every frame of a LeRobot dataset that has state and action only.

    Reads and writes datasets of v3.0 (lerobot 0.4 and later) and v2.1 (0.3), without LeRobot. The torque comes from
    the goal (the action of the frame before) minus the state. Every episode begins with a monitor that knows nothing:
    for about a second contact and collision are -1, not known. The dataset itself is only read; what is written
    appears whole or not at all, with features and statistics brought up to date, and videos linked or copied as they
    are. The bundle comes from the same kind of data: `tauext import --source DATASET --arm arm.toml --out DIR`, then
    `tauext train --data DIR --out arm.tauext`.

    Args:
        dataset: folder of the LeRobot dataset, with meta/info.json in it.
        bundle: bundle (*.tauext) of this arm, trained on recordings of the same rate, with [servo] in its arm.toml.
        arm: arm.toml that the bundle's recordings were imported with: which elements of the state are joints, and in
            which unit.
        out: folder to write, which must be empty or not there.
        calibration: LeRobot's calibration file of the arm (*.json), for states from -100 to 100; instead of the one
            that arm.toml names.
        into: where labels go. state: elements of observation.state, as a robot wrapped by lerobot_robot_tauext records
            them; features: observation.tau_ext, observation.contact and observation.collision, which leaves the state
            as policies trained on it know it.
        as_json: print the counts as one JSON object.
    """
    from tauext.bundle.bundle_file import load_bundle
    from tauext.cli.progress import Terminal
    from tauext.data.description import load_arm
    from tauext.sources.lerobot_labels import label_dataset

    described = load_arm(arm, None if calibration is None else local_file(calibration))
    loaded = load_bundle(bundle)
    with staged(out, fresh=True) as folder:
        report = label_dataset(local_folder(dataset), loaded, described, folder, into, Terminal())
    if as_json:
        import json
        from dataclasses import asdict

        print(json.dumps({"out": str(out), **asdict(report)}))
        return
    known = report.frames - report.unknown
    share = f"{report.contact / known:.1%} of them in contact" if known else "none: every episode is over too soon"
    print(f"{report.episodes} episodes, {report.frames} frames; {known} with an estimate, {share}")
    print(f"{report.collisions} collisions")
    if report.held:
        print(f"{report.equal} of {report.held} frames held these very values before")
    print(out)
