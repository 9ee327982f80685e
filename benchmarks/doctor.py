"""What the doctor finds: faults injected, faults named, false findings on good data.

    python benchmarks/doctor.py [--minutes 1.2] [--good-minutes 12] [--arms six,seven,rig] [--data FILE --robot FILE]

Every way of tests/doctor_faults.py to break recordings is tried on made motion of a six- and a seven-axis arm with
known friction, and on recordings of the virtual rig. A finding beside the fault counts as other, unless it follows from
the fault (`follows` there). Of each recording in --data, real ones, whatever is found is listed.
"""

import argparse
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from doctor_faults import FAULTS, Case, Made, NotApplicable, beside, is_named
from made_motion import made_motion
from trees import six_axis, urdf

from tauext.data import load as load_recording
from tauext.doctor import examine
from tauext.rig import RigConfig
from tauext.rig.arm import arm_xml
from tauext.rig.recording import simulate_recording
from tauext.robot import load

RATE_HZ = 100.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=1.2, help="of the data that are broken")
    parser.add_argument("--good-minutes", type=float, default=12.0, help="long enough for no finding at all")
    parser.add_argument("--arms", default="six,seven,rig")
    parser.add_argument("--seeds", type=int, default=3, help="good data of so many seeds")
    parser.add_argument("--data", type=Path, nargs="*", default=[], help="real recordings, each checked alone")
    parser.add_argument("--robot", type=Path, help="of the real recordings")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for arm in filter(None, options.arms.split(",")):
            print_table(arm, folder, options.minutes, options.good_minutes, options.seeds)
    for path in options.data:
        diagnosis = examine([load_recording(path)], options.robot)
        print(f"\n{path.stem}")
        for f in diagnosis.findings:
            print(f"  {f.severity:8s}{f.code:28s}{f.joint or '':14s}{f.evidence}")


def print_table(arm: str, folder: Path, minutes: float, good_minutes: float, seeds: int) -> None:
    print(f"\n{arm}: {minutes:g} minutes\n{'fault':44s}{'named as':28s}{'joints':26s}besides", flush=True)
    named = tried = others = 0
    case = make_case(arm, folder, minutes, 0)
    for fault in FAULTS:
        if arm == "rig" and not fault.planar:
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
        joints = ", ".join(f.joint or "all" for f in diagnosis.findings if f.code == fault.code)[:24]
        told = ", ".join(sorted({f"{f.code} ({f.joint})" for f in besides}))
        print(f"{fault.name:44s}{fault.code if found else 'NOT NAMED':28s}{joints:26s}{told}", flush=True)
    false = 0
    for seed in range(seeds):
        good = make_case(arm, folder, good_minutes, seed)
        findings = examine(good.made.recordings, good.urdf).findings
        false += len(findings)
        for f in findings:
            print(f"good data, seed {seed}: {f.severity} {f.code} {f.joint}: {f.evidence}")
    print(f"{arm}: {named} of {tried} faults named; {others} other findings beside them; "
          f"{false} findings on {seeds} good data sets of {good_minutes:g} minutes", flush=True)  # fmt: skip


def make_case(arm: str, folder: Path, minutes: float, seed: int) -> Case:
    if arm == "rig":
        path = folder / "rig.xml"
        path.write_text(arm_xml(RigConfig()))
        count = max(2, round(minutes / 1.5))
        recordings = [simulate_recording(RigConfig(), "free", 60 * minutes / count, seed, k) for k in range(count)]
        tree = load(path)
        gravity = [tree.momentum(r.q, 0 * r.q)[1] for r in recordings]
        return Case(Made(recordings, gravity, []), path, minutes, 1000.0)
    path = folder / f"{arm}.urdf"
    if arm == "six":
        path.write_text(urdf(six_axis()).replace('effort="100"', 'effort="3000"'))
    else:
        path.write_text((Path(__file__).parent / "seven_axis.urdf").read_text())
    return Case(made_motion(load(path), minutes, RATE_HZ, seed), path, minutes, RATE_HZ)


if __name__ == "__main__":
    main()
