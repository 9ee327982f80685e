"""What `tauext check` reports of the masses and inertias of robot files, of makers and others.

    python packages/lab/benchmarks/inertias.py FOLDER OUT       # a minute for fifty files on one core

Of each URDF or MJCF in FOLDER and its folders, the longest chain of joints moves for two minutes between random poses,
with made friction and noise, and torques of the file's own inertias. *Links* are those with an inertia that no body can
have, each a fault unless its effect is weighed. *Effect*: the largest change of a torque if the nearest possible
inertia replaces it, beside what the recordings can show at that joint. OUT/inertias.md gets the table.
"""

import re
import sys
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import arguments, head, table_row, write_tables
from made_recordings import Drive, made_motion

from tauext.check.checks import CHECKS, run
from tauext.check.examination import Examination
from tauext.check.finding import Finding
from tauext.check.robot_file import model_findings
from tauext.errors import TauextError
from tauext.robot.read import carried_bodies, compiled, load_tree, movable_joints

CODE = "inertia-impossible"
MOTION = Drive(profile="trapezoid", presliding_rad=2e-3, noise=0.02, pause_s=1.0)
EFFECT = re.compile(r"by up to (\S+) Nm, (?:more|less) than (\S+) Nm")


def main() -> None:
    parser = arguments(__doc__, "folder", "out")
    options = parser.parse_args()
    files = sorted(path for path in options.folder.rglob("*") if path.suffix in (".urdf", ".xml", ".mjcf"))
    lines, counts = (
        head("file | joints | links | before | after | effect in N m, of what shows"),
        dict.fromkeys(KINDS, 0),
    )
    for path in files:
        try:
            joints = longest_chain(path)
            weighed = [one for one in model_findings(carried_bodies(path, joints)) if not isinstance(one, Finding)]
            found = findings_of(path, joints) if joints else []
        except TauextError as error:
            print(f"{path.relative_to(options.folder)}: {error}", flush=True)
            continue
        if not joints:
            continue
        faults = [one for one in found if one.severity == "fault"]
        before = "fault" if weighed or faults else "note" if found else "none"
        after = "fault" if faults else "note" if found else "none"
        counts[before, after] += 1
        if found:
            effects = [EFFECT.search(one.evidence) for one in found]
            cells = ", ".join(f"{e[1]} of {e[2]}" for e in effects if e) or "none computed"
            lines.append(table_row(path.stem, len(joints), len(found), before, after, cells))
    total = sum(counts.values())
    words = [f"{count} {before} before, {after} after" for (before, after), count in counts.items() if count]
    write_tables(options.out, [*lines, "", f"{total} files: {'; '.join(words)}."], name="inertias")


KINDS = [(before, after) for before in ("fault", "note", "none") for after in ("fault", "note", "none")]


def longest_chain(path: Path) -> list[str]:
    """Movable joints from the base to the body that most of them move; empty: none."""
    model, known = compiled(path), set(movable_joints(path))

    def above(body: int) -> Iterator[str]:
        while body > 0:
            first = model.body_jntadr[body]
            names = [model.joint(int(k)).name for k in range(first, first + model.body_jntnum[body])]
            yield from (name for name in reversed(names) if name in known)
            body = int(model.body_parentid[body])

    return max((list(above(body))[::-1] for body in range(model.nbody)), key=len)


def findings_of(path: Path, joints: list[str]) -> list[Finding]:
    """Findings of the links' inertias beside the motion of this arm."""
    recordings = made_motion(load_tree(path, joints), 2.0, pieces=2, drive=MOTION).recordings
    checks = [check for check in CHECKS if check.codes[:1] in (("joint-names",), (CODE,))]
    return [one for one in run(checks, Examination(recordings, path), lambda step: None) if one.code == CODE]


if __name__ == "__main__":
    main()
