"""`tauext twin`: a robot file for simulation, made of a bundle."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from tauext.cli.arguments import BundleArg, JsonArg, print_replaced
from tauext.cli.progress import Terminal
from tauext.config import require, require_seed
from tauext.errors import ConfigError
from tauext_twin.model_file import KINDS


def twin(
    bundle: BundleArg,
    out: Path,
    robot: Path | None = None,
    data: Path | None = None,
    names: Annotated[tuple[str, ...], tyro.conf.arg(metavar="RECORDED=FILE ...")] = (),
    draws: int = 0,
    seed: int = 0,
    as_json: JsonArg = False,
) -> None:
    """Write the arm's robot file with friction, rotor inertia, masses and servo gains that its motion showed.

    A value within two standard errors of the file's stays as it is. Beside OUT are NAME.twin.json, with values, their
    standard errors and what a simulator's joint cannot hold, and NAME.html, a page of both.

    Args:
        bundle: bundle of recipe prior or tauext, trained with the arm's URDF or MJCF.
        out: file to write: .xml (MJCF), .urdf, or .usd, .usda, .usdc.
        robot: URDF or MJCF to change, or the arm's USD, over which a layer is written; default: the dataset's.
        data: dataset that the bundle was trained on; default: the one near the bundle that has its recordings.
        names: joints that have another name in the robot file.
        draws: also write so many files NAME-000, ..., drawn from the joint posterior, for training in simulation.
        seed: seed of the draws.
        as_json: print the content of NAME.twin.json.
    """
    from tauext.files.provenance import json_text
    from tauext_twin.arm import read_arm
    from tauext_twin.page import table, write_page
    from tauext_twin.twin import make_twin, side_file

    require_seed(seed)
    require(0 <= draws <= 100_000, "draws", draws, "0 to 100000")
    if out.suffix not in KINDS:
        raise ConfigError(f"{out}: its name must end in one of {', '.join(KINDS)}")
    pairs = [pair.partition("=") for pair in names]
    if wrong := [pair for pair, (_, found, _) in zip(names, pairs, strict=True) if not found]:
        raise ConfigError(f"--names {wrong[0]}: must be RECORDED=FILE, the joint as recorded and in the robot file")
    if robot is not None and robot.exists() and out.exists() and out.samefile(robot):
        raise ConfigError(f"{out}: it is the robot file, which stays as it is; choose another --out")
    print_replaced(out, side_file(out), out.with_suffix(".html"))
    arm = read_arm(bundle, robot, data, {recorded: of_file for recorded, _, of_file in pairs})
    content = make_twin(arm, out, draws, seed, Terminal())
    write_page(content, arm, out.with_suffix(".html"))
    print(json_text(content) if as_json else "\n".join([*table(content), *content["warnings"], str(out)]))
