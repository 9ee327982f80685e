"""Good data with one mistake each: is it refused or named before training, or does it do no harm?

    python tests/mutations OUT [--data DIR] [--jobs 2] [--sample 200] [--datasets rig ...] [--kinds units ...]

The datasets are made in OUT/made, once: the rig, two unseen arms and a real UR3 from the shared recordings (--data,
with URDFs in models/). Each case takes a clean dataset, breaks one thing (cases.py lists them; the seed
draws joints, recordings and places), and asks first the door, then, where it lets the data in, what the bundle is worth
beside the clean one's. OUT/NAME.jsonl gets a row a case as it ends; what is there is not repeated, and the order is
drawn, so that the first rows are a fair sample. OUT/NAME.json and OUT/NAME.md are made of all rows. --good looks at all
good data instead: whatever is refused there is a false refusal.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import time
import traceback
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from functools import cache
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads of small systems only wait for each other
sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
sys.path.insert(0, str(Path(__file__).parents[2] / "packages/lab/benchmarks"))

import numpy as np

from mutations.cases import Case, broken_dataset, cases_of, judged_recording
from mutations.good import ALL_KINDS, NAMES, GoodSet, look_at_good, make_good_sets
from mutations.judging import Seen, Worth, fits, looked_at, verdict_after, verdict_before, worth_of
from mutations.tables import LET_IN, markdown
from tauext.data.recording_file import load_recording
from tauext.errors import TauextError

ROOT = Path(__file__).parents[2]


def main() -> None:
    options = parsed()
    options.out.mkdir(parents=True, exist_ok=True)
    os.environ["XDG_CACHE_HOME"] = str((options.out / "cache").resolve())  # findings are remembered apart from a user's
    if options.good:
        good = []
        for one in look_at_good(options.out, options.data, options.unseen, options.jobs):
            good.append(one)
            print(f"{one['name']}: {one['error'] or one['faults'] or 'no fault'}", flush=True)
        (options.out / f"{options.name}-good.json").write_text(json.dumps(good, indent=1) + "\n")
    else:
        carry_out(options)
    summarize(options.out, options.name)


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the recordings")
    parser.add_argument("--name", default="mutations", help="of the files with the results")
    parser.add_argument("--datasets", nargs="+", choices=NAMES, default=NAMES)
    parser.add_argument("--kinds", nargs="+", choices=ALL_KINDS, default=ALL_KINDS)
    parser.add_argument("--sample", type=int, help="so many cases in all, drawn by the seed")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    parser.add_argument("--look-only", action="store_true", help="train nothing: say what the door lets in")
    parser.add_argument("--list", action="store_true", help="print the cases and end")
    parser.add_argument("--good", action="store_true", help="look at good data alone: nothing may be refused")
    parser.add_argument("--unseen", type=Path, help="OUT of packages/lab/benchmarks/unseen_arms.py, for --good")
    return parser.parse_args()


def carry_out(options: argparse.Namespace) -> None:
    """Make what is missing, and run the cases that have no row."""
    made = make_good_sets((options.out / "made").resolve(), options.data, options.datasets)
    cases = [c for good in made.values() for c in cases_of(good, options.seed) if c.kind in options.kinds]
    if options.sample is not None:
        cases = sampled(cases, options.sample)
    cases = [cases[k] for k in np.random.default_rng(options.seed).permutation(len(cases))]
    if options.list:
        print("\n".join(case.id for case in cases), f"\n{len(cases)} cases")
        return
    rows_file = options.out / f"{options.name}.jsonl"
    verdicts = {row["id"]: row["verdict"] for row in read_rows(rows_file)}
    left = [case for case in cases if verdicts.get(case.id, LET_IN) == LET_IN]
    if options.look_only:
        left = [case for case in left if case.id not in verdicts]
    left.sort(key=lambda case: case.id not in verdicts)  # first those that the door is known to let in
    clean_folder = options.out / f"{options.name}-clean"
    clean_folder.mkdir(exist_ok=True)
    started = time.monotonic()
    with ProcessPoolExecutor(options.jobs) as pool:
        for ended in as_completed(
            [pool.submit(clean_outcome, good, clean_folder, options.look_only) for good in made.values()]
        ):
            ended.result()
        futures = [pool.submit(row_of, case, made[case.dataset], clean_folder, options.look_only) for case in left]
        for count, future in enumerate(as_completed(futures), start=1):
            row = future.result()
            with rows_file.open("a") as file:
                file.write(json.dumps(row) + "\n")
            print(f"{count}/{len(left)} {time.monotonic() - started:.0f} s {row['verdict']:9} {row['id']}", flush=True)


def sampled(cases: list[Case], count: int) -> list[Case]:
    """The first cases of every kind on every dataset, in proportion to how many there are."""
    share = min(1.0, count / len(cases))
    groups: dict[tuple[str, str], list[Case]] = {}
    for case in cases:
        groups.setdefault((case.dataset, case.kind), []).append(case)
    return [case for group in groups.values() for case in group[: max(1, round(share * len(group)))]]


def clean_outcome(good: GoodSet, folder: Path, look_only: bool) -> None:
    """Write what the door says of the clean dataset and what its bundle is worth, unless that is there."""
    path = folder / f"{good.name}.json"
    content = json.loads(path.read_text()) if path.exists() else {}
    if "seen" not in content:
        content["seen"] = [asdict(one) for one in looked_at(good.folder)]
    if not look_only and "worth" not in content:
        worth = worth_of(good.folder, folder / f"{good.name}.tauext", map(load_recording, good.judged))
        content["worth"] = asdict(worth)
        print(f"{good.name}: {worth.found} of {worth.events} contacts found by the clean bundle", flush=True)
    path.write_text(json.dumps(content, indent=1) + "\n")


@cache
def clean_of(path: Path) -> tuple[list[Seen], Worth | None]:
    content = json.loads(path.read_text())
    worth = content.get("worth")
    return [Seen(**one) for one in content["seen"]], Worth(**worth) if worth else None


def row_of(case: Case, good: GoodSet, clean_folder: Path, look_only: bool) -> dict:
    """One case, from the mutation to the verdict; where only the door is asked, LET_IN of what it lets in."""
    clean_seen, clean_worth = clean_of(clean_folder / f"{good.name}.json")
    empty = {"verdict": None, "error": None, "findings": [], "fits": False, "limit_off": None, "found": None}
    row = asdict(case) | empty | {"events": None, "found_clean": None}
    work = clean_folder.parent / "work" / str(os.getpid())
    started = time.monotonic()
    what, signals = case.change.what, case.change.signals
    try:
        broken_dataset(case, good, work / "data")
        verdict, new = verdict_before(what, signals, looked_at(work / "data"), clean_seen)
        row |= {"verdict": verdict, "findings": [asdict(one) for one in new]}
        row["fits"] = any(fits(what, signals, one.code) for one in new)
        row["look_s"] = round(time.monotonic() - started, 2)
        if verdict is None:
            row["verdict"] = LET_IN
            if not look_only and clean_worth is not None:
                row |= worth_row(case, good, work, clean_worth)
    except TauextError as error:
        row |= {"verdict": "refused", "error": str(error), "fits": True}
    except Exception:
        row |= {"verdict": "traceback", "error": traceback.format_exc(limit=-3)}
    shutil.rmtree(work, ignore_errors=True)
    return row | {"seconds": round(time.monotonic() - started, 2)}


def worth_row(case: Case, good: GoodSet, work: Path, clean: Worth) -> dict:
    """What the bundle is worth that was trained on the broken data."""
    judged = (judged_recording(case, good, path) for path in good.judged)
    worth = worth_of(work / "data", work / "bundle.tauext", judged)
    verdict, off, _ = verdict_after(worth, clean)
    counts = {"found": worth.found, "events": worth.events, "found_clean": clean.found}
    return counts | {"verdict": verdict, "limit_off": off, "limits_nm": worth.limits_nm}


def read_rows(path: Path) -> list[dict]:
    """The last row of each case."""
    lines = path.read_text().splitlines() if path.exists() else []
    return list({row["id"]: row for row in map(json.loads, lines)}.values())


def summarize(out: Path, name: str) -> None:
    """NAME.json and NAME.md of all rows that are there."""
    rows = sorted(read_rows(out / f"{name}.jsonl"), key=lambda row: row["id"])
    good_file = out / f"{name}-good.json"
    good = json.loads(good_file.read_text()) if good_file.exists() else []
    (out / f"{name}.json").write_text(json.dumps(rows, indent=1) + "\n")
    text = markdown(rows, good, f"python tests/mutations OUT --name {name}")
    (out / f"{name}.md").write_text(text)


if __name__ == "__main__":
    main()
