"""Faults that `tauext check` finds: injected faults, faults named, false findings on good data.

    python benchmarks/check_faults.py OUT                     # half an hour on one core
    python benchmarks/check_faults.py OUT --arms rig [--data FILE ... --robot FILE] [--urdf FILE ...]

Every way of tests/check_cases.py to break recordings is tried on made motion of several arms with known friction, and
on recordings of the virtual rig. A finding beside the fault counts as other, unless it follows from it (`follows`
there). Other arms and drives (`SETTINGS` there) are good data. Of each recording in --data, real ones, whatever is
found is listed. OUT/check.md gets the tables.
"""

import argparse
import re
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from check_cases import (
    CURRENTS,
    FAULTS,
    SETTINGS,
    Case,
    Made,
    NotApplicable,
    Setting,
    beside,
    is_named,
    parallel,
    scara,
)
from common import arguments, head, table_row, write_tables
from made_arms import Part, six_axis, urdf
from made_recordings import made_motion
from tauext_lab.sim.collect import simulate_recording
from tauext_lab.sim.config import RigConfig
from tauext_lab.sim.rig import arm_xml

from tauext.check.examine import Diagnosis, examine
from tauext.data.recording_file import load_recording
from tauext.robot.read import load_tree

RATE_HZ = 100.0
PLANAR = ("rig", "parallel")
SETTING_MINUTES = 8.0
"""Of each setting: friction is followed from seven minutes on."""
UNIT_CODES = ("effort-scale", "effort-motor-side")
"""What is to be found with a model where the effort is a current, or before the gear."""


def main() -> None:
    parser = arguments(__doc__, "out")
    parser.add_argument("--minutes", type=float, default=1.2, help="of the data that are broken")
    parser.add_argument("--good-minutes", type=float, default=12.0, help="long enough for no finding at all")
    parser.add_argument("--arms", default="six,seven,scara,parallel,rig", help="whose recordings are broken")
    parser.add_argument("--seeds", type=int, default=1, help="good data of so many seeds")
    parser.add_argument("--settings", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--urdf", type=Path, nargs="*", default=[], help="arms whose recordings are broken, too")
    parser.add_argument("--data", type=Path, nargs="*", default=[], help="real recordings, each checked alone")
    parser.add_argument("--robot", type=Path, help="of the real recordings")
    options = parser.parse_args()
    lines = head("arm | faults reported | other findings | findings on good data | not reported")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for arm in [*filter(None, options.arms.split(",")), *options.urdf]:
            lines.append(print_faults(str(arm), folder, options))
        if options.settings:
            lines += ["", *head("arm | with a model | without a model")]
            lines += [setting_row(one, folder) for one in (*SETTINGS, *CURRENTS)]
    for path in options.data:
        print(f"\n{path.stem}")
        for f in examine([load_recording(path)], options.robot).findings:
            print(f"- {f.severity} `{f.code}` {f.joint or ''}: {f.evidence}")
    write_tables(options.out, lines, name="check")


def print_faults(arm: str, folder: Path, options: argparse.Namespace) -> str:
    """Print the table of one arm; returns the arm's row of the summary."""
    print("\n".join(["", *head(f"{Path(arm).stem}: fault | reported as | joints | other findings")]))
    named = tried = others = false = 0
    missed = []
    case = make_case(arm, folder, options.minutes, 0)
    for fault in FAULTS:
        if arm in PLANAR and not fault.planar:
            continue
        try:
            recordings, text = fault.broken(case)
        except NotApplicable:
            continue
        file = folder / f"broken{case.urdf.suffix}"
        file.write_text(text)
        diagnosis = examine(recordings, file)
        tried, found = tried + 1, is_named(fault, recordings, diagnosis)
        named, besides = named + found, beside(fault, diagnosis)
        others += len(besides)
        missed += [] if found else [fault.name]
        joints = ", ".join(dict.fromkeys(f.joint or "all" for f in diagnosis.findings if f.code == fault.code))
        told = ", ".join(sorted({f"{f.code} ({f.joint})" for f in besides}))
        print(table_row(fault.name, fault.code if found else "NOT REPORTED", joints, told), flush=True)
    for seed in range(options.seeds):
        good = make_case(arm, folder, options.good_minutes, seed)
        findings = [f for f in examine(good.made.recordings, good.urdf).findings if f.code != "too-short"]
        false += len(findings)
        for f in findings:
            print(f"- good data, seed {seed}: {f.severity} `{f.code}` {f.joint}: {f.evidence}")
    return table_row(Path(arm).stem, f"{named} of {tried}", others, false, "; ".join(missed) or "none")


def setting_row(setting: Setting, folder: Path) -> str:
    """Findings on good data of another arm or drive, with a model and without."""
    expected = UNIT_CODES if setting in CURRENTS else ()
    path, recordings = good_data(setting, folder, SETTING_MINUTES)
    return table_row(setting.name, *(told_findings(examine(recordings, robot), expected) for robot in (path, None)))


def good_data(setting: Setting, folder: Path, minutes: float) -> tuple[Path, list]:
    path = urdf_file(folder / "setting.urdf", setting.parts)
    return path, made_motion(load_tree(path), minutes, setting.rate_hz, seed=3, drive=setting.drive).recordings


def told_findings(diagnosis: Diagnosis, expected: tuple[str, ...]) -> str:
    right = sum(f.code in expected for f in diagnosis.findings)
    rest = [f for f in diagnosis.findings if f.code not in (*expected, "too-short")]
    parts = [f"{right} joints reported"] if right else []
    return ", ".join([*parts, *(f"{f.code} ({f.joint})" for f in rest)]) or "none"


def urdf_file(path: Path, parts: list[Part]) -> Path:
    path.write_text(urdf(parts).replace('effort="100"', 'effort="5000"'))
    return path


def make_case(arm: str, folder: Path, minutes: float, seed: int) -> Case:
    if arm == "rig":
        path = folder / "rig.xml"
        path.write_text(arm_xml(RigConfig()))
        count = max(2, round(minutes / 1.5))
        recordings = [simulate_recording(RigConfig(), "free", 60 * minutes / count, seed, k) for k in range(count)]
        tree = load_tree(path)
        gravity = [tree.momentum(r.q, 0 * r.q)[1] for r in recordings]
        return Case(Made(recordings, gravity, []), path, minutes, 1000.0)
    path = folder / "arm.urdf"
    if arm.endswith(".urdf"):
        path.write_text(re.sub('effort="[^"]*"', 'effort="5000"', Path(arm).read_text()))
    elif arm == "seven":
        path.write_text((Path(__file__).parent / "seven_axis.urdf").read_text())
    else:
        urdf_file(path, {"six": six_axis, "scara": scara, "parallel": parallel}[arm]())
    return Case(made_motion(load_tree(path), minutes, RATE_HZ, seed), path, minutes, RATE_HZ)


if __name__ == "__main__":
    main()
