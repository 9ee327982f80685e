"""Time of a sample in the monitor of two commits, in turns on this machine.

    python benchmarks/turns.py OLD NEW [--joints 2 7] [--rounds 5] [--steps 300000] [--bundle FILE FILE [--motion FILE]]

Each commit is built from a checkout of its own with its own monitor_bench. A row shows the medians over the rounds and
the ratio NEW / OLD. --bundle names a bundle of each commit's format instead of the one without optional parts; `-` is
the latter with --joints. --motion: what benchmarks/monitor.py --arms wrote for NEW's bundle.
"""

import json
import os
import statistics
import subprocess
import tempfile
from pathlib import Path

from common import ROOT, arguments, head, table_row

PARTS = (("monitor", "estimate"), ("monitor", "advance"), ("network", "answer"), ("paced", "estimate"))


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("commits", nargs=2, metavar="COMMIT")
    parser.add_argument("--joints", type=int, nargs="+", default=[2, 7])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=300_000, help="samples back to back in a round (%(default)s)")
    parser.add_argument("--paced-s", type=float, default=0.0, help="seconds of a loop at the sample rate; 0: none")
    parser.add_argument("--bundle", nargs=2, metavar="FILE", default=["-", "-"], help="one per commit")
    parser.add_argument("--motion", type=Path, metavar="FILE", help="of the bundle of NEW")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        benches = [build(commit, Path(folder) / str(k)) for k, commit in enumerate(options.commits)]
        print("\n".join(head(f"joints | what | {options.commits[0]}, ns | {options.commits[1]}, ns | ratio")))
        for joints in options.joints:
            rounds = [[run(benches[k], k, joints, options) for k in range(2)] for _ in range(options.rounds)]
            for part, what in PARTS:
                if not all(one.get(part) for pair in rounds for one in pair):
                    continue
                old, new = (statistics.median(pair[k][part][what]["p50_ns"] for pair in rounds) for k in range(2))
                print(table_row(f"{joints}", f"{part} {what}", f"{old:g}", f"{new:g}", f"{new / old:.2f}"))


def build(commit: str, folder: Path) -> Path:
    """monitor_bench of a commit; the checkout holds tracked files only."""
    source, build_folder = folder / "source", folder / "build"
    source.mkdir(parents=True)
    archive = subprocess.run(["git", "archive", commit], cwd=ROOT, check=True, capture_output=True)
    subprocess.run(["tar", "-x", "-C", source], input=archive.stdout, check=True)
    environment = {**os.environ, "PATH": f"{ROOT / '.venv/bin'}:{os.environ['PATH']}"}
    for command in (
        ["cmake", "-S", source, "-B", build_folder, "-G", "Ninja", "-DTAUEXT_TESTS=ON"],
        ["cmake", "--build", build_folder, "--target", "monitor_bench"],
    ):
        subprocess.run(command, check=True, capture_output=True, env=environment)
    return build_folder / "monitor_bench"


def run(bench: Path, which: int, joints: int, options) -> dict:
    """What monitor_bench prints for the old (0) or the new commit (1)."""
    words = [joints, options.steps, options.paced_s, options.bundle[which]]
    words += [options.motion] if which == 1 and options.motion else []
    return json.loads(subprocess.run([bench, *map(str, words)], check=True, capture_output=True).stdout)


if __name__ == "__main__":
    main()
