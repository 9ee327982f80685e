"""`tauext check`: the signal doctor, before anyone trains."""

from __future__ import annotations

from typing import Annotated

import tyro

from tauext.cli.place_argument import PlaceArg


def check(
    data: tuple[PlaceArg, ...],
    robot: PlaceArg | None = None,
    out: PlaceArg | None = None,
    gravity: tuple[float, float, float] | None = None,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """Look for mistakes of units, signs, order and timing in recordings, and in the robot file.

    Prints each finding with its evidence and what to do. Exit status: 0 no fault (there may be warnings), 1 a fault,
    2 bad input.

    Args:
        data: a dataset folder, a folder of recordings, or recordings (*.parquet), of free motion.
        robot: URDF or MJCF of the arm; default: the dataset's own. Without any, what needs a model is not looked for.
        out: folder to write: check.txt, check.json, and measured against predicted torque as pictures; those that are
            there are replaced, and said to be.
        gravity: acceleration of free fall in the base frame, m/s^2; default: the robot file's.
        as_json: print the findings as JSON for scripts.
    """
    import json

    from tauext.check.examine import as_files, examine, gather
    from tauext.cli.place_argument import tell_replaced
    from tauext.cli.progress import Terminal
    from tauext.files.room import expect_folder
    from tauext.files.whole_file import whole_folder

    if out is not None:
        expect_folder(out)
        tell_replaced(out / "check.json")
    recordings, free, robot = gather(data, robot, Terminal())
    diagnosis = examine(recordings, robot, gravity, free, Terminal())
    text, content = as_files(diagnosis, (recording.name for recording in recordings), robot is None)
    if out is not None:
        from tauext.report.check_picture import draw

        with whole_folder(out) as part:
            (part / "check.txt").write_text(text + "\n")
            (part / "check.json").write_text(json.dumps(content, indent=1) + "\n")
            draw(diagnosis, part, Terminal())
    print(json.dumps(content, indent=1) if as_json else text)
    return 1 if diagnosis.faulty else 0
