"""Hostile values for every option of every command, damaged files for every reader: what ends as it must not.

    python tests/hostile --cases 10000             # a quarter of an hour on two cores
    python tests/hostile --repeat 1234             # one case again, with all that it says

A case is drawn from seed and number, and runs in a process of its own with limits on memory, files and threads, as
nobody where the program runs as root. It must end with status 0, 2, 130 after Ctrl-C, or 1 of `check`;
without a traceback or a crash; refused in one line; within 10 s, or within 10 s of a Ctrl-C where long work was
asked for; and without a file that is half written, or any file where it was refused.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "agg")
sys.path.insert(0, str(Path(__file__).parents[1]))

from hostile.good import make_good
from hostile.judge import Ending, Plan, Worker, end, look, start

POLL_S = 0.003
BATCH = 25
"""Cases in a process: a process costs as much as a case."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--only", default="", help="options, output, or the name of a reader")
    parser.add_argument("--repeat", type=int, help="run this case alone and show it")
    parser.add_argument("--quick", action="store_true", help="fewer good files, made in seconds")
    parser.add_argument("--good", type=Path, help="folder of the good files; kept and used again")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="hostile-") as temporary:
        folder = Path(temporary)
        folder.chmod(0o755)
        os.environ["MPLCONFIGDIR"] = str(folder)
        good = make_in_own_process(options.good or folder / "good", options.quick)
        import_all()
        numbers = range(options.first, options.first + options.cases)
        if options.repeat is not None:
            numbers = range(options.repeat, options.repeat + 1)
        with full_disk(folder / "full-disk") as full:
            plan = Plan(options.seed, good, options.only, full)
            endings = list(shown(run_all(plan, numbers, folder, options.workers)))
            if options.repeat is not None:
                told = folder / "worker-0" / str(options.repeat)
                print((told / "stdout").read_text()[-3000:], (told / "stderr").read_text())
    print(table(endings))
    return 1 if any(ending.faults for ending in endings) else 0


def make_in_own_process(folder: Path, quick: bool) -> Path:
    """The good files; whoever computes has threads, and a process with threads must not be forked."""
    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parents[1])!r}); "
    code += "from pathlib import Path; from hostile.good import make_good; "
    code += f"make_good(Path({str(folder)!r}), {quick})"
    subprocess.run([sys.executable, "-c", code], check=True)
    return make_good(folder)


def import_all() -> None:
    """What commands import when they are called, once for all cases."""
    import h5py  # noqa: F401
    import matplotlib.pyplot  # noqa: F401
    import mujoco.rollout  # noqa: F401
    import pyarrow.csv
    import pyarrow.dataset  # noqa: F401
    import rosbags.rosbag1
    import rosbags.rosbag2  # noqa: F401
    import scipy.io  # noqa: F401

    import tauext.check.examine
    import tauext.cli.monitor_output
    import tauext.data.importers.open_raw
    import tauext.train.stage  # noqa: F401


class full_disk:
    """A disk without room, where this process may mount one; else None."""

    def __init__(self, place: Path):
        self._place = place

    def __enter__(self) -> Path | None:
        self._place.mkdir()
        mount = ["mount", "-t", "tmpfs", "-o", "size=64k,mode=777", "tmpfs", str(self._place)]
        self._mounted = subprocess.run(mount, capture_output=True).returncode == 0
        if not self._mounted:
            return None
        try:
            (self._place / "fill").write_bytes(bytes(1 << 17))
        except OSError:
            pass
        return self._place

    def __exit__(self, *error: object) -> None:
        if self._mounted:
            subprocess.run(["umount", str(self._place)], check=False)


def run_all(plan: Plan, numbers: range, folder: Path, workers: int) -> Iterator[Ending]:
    """Endings as they come, of so many processes at a time, each of which runs a batch of cases."""
    waiting = list(numbers)
    running: list[Worker | None] = [None] * workers
    left = len(numbers)
    while left:
        for k, worker in enumerate(running):
            if worker is not None and (worker.pid == 0 or not worker.numbers):
                end(worker)
                waiting = worker.numbers + waiting
                running[k] = worker = None
            if worker is None and waiting:
                batch, waiting = waiting[:BATCH], waiting[BATCH:]
                running[k] = worker = start(plan, batch, folder / f"worker-{k}")
            if worker is not None and (ending := look(worker)) is not None:
                left -= 1
                yield ending
        time.sleep(POLL_S)
    for worker in running:
        if worker is not None:
            end(worker)


def shown(endings: Iterator[Ending]) -> Iterator[Ending]:
    """The same, failures printed as they come."""
    for count, ending in enumerate(endings, 1):
        if ending.faults:
            line = " ".join(word if len(word) < 200 else word[:50] + "..." for word in ending.arguments)
            print(f"case {ending.number}: {'; '.join(ending.faults)}\n  tauext {line!r}")
            print(f"  {ending.kind}: {ending.what[:200]!r}\n  {ending.last_line}", flush=True)
        if count % 500 == 0:
            print(f"{count} cases, {time.strftime('%H:%M:%S')}", file=sys.stderr, flush=True)
        yield ending


def table(endings: list[Ending]) -> str:
    """Counts by command and by kind."""
    lines = [
        "",
        "| | cases | done | refused | fault | stopped | longest | failures |",
        "|---|---|---|---|---|---|---|---|",
    ]
    groups: dict[str, list[Ending]] = defaultdict(list)
    for ending in endings:
        groups[f"`{ending.arguments[0]}`"].append(ending)
    for ending in endings:
        groups[ending.kind].append(ending)
    groups["all"] = endings
    for name, group in groups.items():
        count = Counter(ending.status for ending in group)
        longest = max(ending.seconds for ending in group)
        failed = sum(bool(ending.faults) for ending in group)
        numbers = (len(group), count[0], count[2], count[1], count[130], f"{longest:.1f} s", failed)
        lines.append(f"| {name} | {' | '.join(map(str, numbers))} |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
