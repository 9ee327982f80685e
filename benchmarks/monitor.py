"""Time of the monitor at every sample, back to back and in a loop that sleeps until each sample is due.

    python benchmarks/monitor.py [--joints 2 7] [--steps 1000000] [--paced-s 10] [--rounds 3]
                                 [--arms rig seven --out OUT] [--against COMMIT]

monitor_bench (make benches) measures on one core, in SCHED_FIFO where that is granted: estimate(), advance(), the
network alone. Of a number the median over the rounds is shown, of a maximum the largest, of counts the sum.

--arms: bundles as tauext train writes them (recipe prior, with error scale, coverage, settable load, forces, places) on
the simulated arms' own motion, also during a contact, while weighing and while a load is expected. OUT gets bundles and
motions, which a later run uses again.
--against: monitor_bench of another commit, built from a checkout of its own, runs in turns with this one.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from common import ROOT, about_run, arguments, compiler_flags, head, table_row


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--bench", type=Path, default=ROOT / "build/cpp/monitor_bench", help="default: %(default)s")
    parser.add_argument("--joints", type=int, nargs="+", default=[2, 7], help="default: 2 7")
    parser.add_argument("--steps", type=int, default=1_000_000, help="samples back to back in a round (%(default)s)")
    parser.add_argument("--paced-s", type=float, default=10.0, help="seconds of the paced loop; 0: none (%(default)s)")
    parser.add_argument("--rounds", type=int, default=3, help="turns of everything (%(default)s)")
    parser.add_argument("--arms", nargs="+", choices=("rig", "seven"), default=[], help="trained bundles as well")
    parser.add_argument("--out", type=Path, help="folder of --arms' bundles")
    parser.add_argument("--against", metavar="COMMIT", help="built and run in turns")
    options = parser.parse_args()
    if options.arms and not options.out:
        parser.error("--arms needs --out, a folder for bundles")
    if not os.access(options.bench, os.X_OK):
        parser.error(f"there is no {options.bench}: make benches")
    print(f"{about_run()}; {compiler_flags()}\n{options.rounds} rounds of {options.steps} samples; µs\n")
    if options.against:
        compare(options)
        return
    results = {f"{joints} joints": measured(options, joints) for joints in options.joints}
    results |= {arm: measured(options, 2, *trained_arm(arm, options.out)) for arm in options.arms}
    print("\n".join(head("bundle | what | estimate p50 | p99 | p99.9 | max | advance p50 | p99.9")))
    for name, parts in results.items():
        for part, found in parts.items():
            first = "answer" if part == "network" else "estimate"
            if isinstance(found, dict) and first in found:
                cells = [found[first][key] for key in ("p50_ns", "p99_ns", "p99_9_ns", "max_ns")]
                cells += [found["advance"][key] for key in ("p50_ns", "p99_9_ns")]
                print(table_row(name, part, *(f"{ns / 1e3:.2f}" for ns in cells)))


def measured(options: argparse.Namespace, *words: object) -> dict:
    """What monitor_bench prints, merged over the rounds."""
    joints, *rest = words
    words = (joints, options.steps, options.paced_s, *rest)
    return merged([run(options.bench, *words) for _ in range(options.rounds)])


def run(bench: Path, *words: object) -> dict:
    return json.loads(subprocess.run([bench, *map(str, words)], check=True, stdout=subprocess.PIPE).stdout)


def trained_arm(arm: str, out: Path) -> tuple[Path, Path]:
    """A trained bundle of a simulated arm, and a minute of its motion that training did not have."""
    from contact_errors import CASES, practice_recording, train

    out.mkdir(parents=True, exist_ok=True)
    bundle, motion = train(arm, out), out / f"{arm}.f64"
    if not motion.exists():
        free = practice_recording(CASES[arm](), 60.0, 0, 50)
        np.hstack([free.q, free.dq, free.tau]).astype("<f8").tofile(motion)
    return bundle, motion


def merged(rounds: list) -> object:
    """One for several of the same form: the median of a number, the largest maximum, the sum of what was counted."""
    first = rounds[0]
    if isinstance(first, dict):
        return {key: merged_value(key, [one[key] for one in rounds]) for key in first}
    if isinstance(first, bool):
        return all(rounds)
    return first if isinstance(first, str) or all(one == first for one in rounds) else statistics.median(rounds)


def merged_value(key: str, values: list) -> object:
    if key == "max_ns":
        return max(values)
    counts = ("over_deadline", "missed_deadlines", "ticks_left_out", "samples_not_ok")
    return sum(values) if key in counts else merged(values)


def compare(options: argparse.Namespace) -> None:
    """Medians of both commits, and their ratio."""
    with tempfile.TemporaryDirectory() as folder:
        benches = build(options.against, Path(folder)), options.bench
        print("\n".join(head(f"joints | what | {options.against}, ns | this one, ns | ratio")))
        for joints in options.joints:
            words = (joints, options.steps, options.paced_s)
            rounds = [[run(bench, *words) for bench in benches] for _ in range(options.rounds)]
            for part, what in (("monitor", "estimate"), ("monitor", "advance"), ("paced", "estimate")):
                if rounds[0][0][part]:
                    old, new = (statistics.median(pair[k][part][what]["p50_ns"] for pair in rounds) for k in (0, 1))
                    print(table_row(joints, f"{part} {what}", f"{old:g}", f"{new:g}", f"{new / old:.2f}"))


def build(commit: str, folder: Path) -> Path:
    """monitor_bench of a commit; the checkout holds tracked files only."""
    source, built = folder / "source", folder / "build"
    source.mkdir(parents=True)
    archive = subprocess.run(["git", "archive", commit], cwd=ROOT, check=True, capture_output=True)
    subprocess.run(["tar", "-x", "-C", source], input=archive.stdout, check=True)
    environment = {**os.environ, "PATH": f"{ROOT / '.venv/bin'}:{os.environ['PATH']}"}
    for command in (
        ["cmake", "-S", source, "-B", built, "-G", "Ninja", "-DTAUEXT_TESTS=ON"],
        ["cmake", "--build", built, "--target", "monitor_bench"],
    ):
        subprocess.run(command, check=True, capture_output=True, env=environment)
    return built / "monitor_bench"


if __name__ == "__main__":
    main()
