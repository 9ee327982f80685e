"""Faults that `tauext check` finds: injected faults, faults named, false findings on good data.

    python packages/lab/benchmarks/check_faults.py OUT [--arms rig]     # half an hour on one core

Every way of tests/check_cases.py to break recordings is tried on made motion of several arms with known friction, and
on recordings of the virtual rig. A finding beside the fault counts as other, unless it follows from it (`follows`
there). Other arms and drives (`SETTINGS` there) are good data. OUT/check.md gets the tables.
"""

import argparse
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))
sys.path.insert(0, str(Path(__file__).parents[3] / "tests"))

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
from common import ROOT, arguments, head, table_row, write_tables
from made_arms import Part, six_axis, urdf
from made_recordings import made_motion
from tauext_lab.sim.collect import simulate_recording
from tauext_lab.sim.config import RigConfig
from tauext_lab.sim.rig import arm_xml

from tauext.check.examine import Diagnosis, examine
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
    parser.add_argument("--arms", nargs="*", default=["six", "seven", "scara", "parallel", "rig"])
    options = parser.parse_args()
    lines = head("arm | faults reported | other findings | findings on good data | not reported")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        lines += [print_faults(arm, folder, options) for arm in options.arms]
        lines += ["", *head("arm | with a model | without a model")]
        lines += [setting_row(one, folder) for one in (*SETTINGS, *CURRENTS)]
    write_tables(options.out, lines, name="check")


def print_faults(arm: str, folder: Path, options: argparse.Namespace) -> str:
    """Print the table of one arm; returns the arm's row of the summary."""
    print("\n".join(["", *head(f"{arm}: fault | reported as | joints | other findings")]))
    named = tried = others = 0
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
    good = make_case(arm, folder, options.good_minutes, 0)
    findings = [f for f in examine(good.made.recordings, good.urdf).findings if f.code != "too-short"]
    for f in findings:
        print(f"- good data: {f.severity} `{f.code}` {f.joint}: {f.evidence}")
    return table_row(arm, f"{named} of {tried}", others, len(findings), "; ".join(missed) or "none")


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
    if arm == "seven":
        path.write_text((ROOT / "benchmarks/seven_axis.urdf").read_text())
    else:
        urdf_file(path, {"six": six_axis, "scara": scara, "parallel": parallel}[arm]())
    return Case(made_motion(load_tree(path), minutes, RATE_HZ, seed), path, minutes, RATE_HZ)


if __name__ == "__main__":
    main()
