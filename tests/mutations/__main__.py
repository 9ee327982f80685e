"""Good data with one mistake each: is it refused or named before training, or does it do no harm?

    python tests/mutations OUT [--data DIR] [--jobs 2] [--datasets rig ...]

The datasets are made in OUT/made, once: the rig, two unseen arms and a real UR3 from the shared recordings (--data,
with URDFs in models/). Each case takes a clean dataset, breaks one thing (cases.py lists them; the seed
draws joints, recordings and places), and asks first the door, then, where it lets the data in, what the bundle is
worth beside the clean one's. OUT/mutations.jsonl gets a row a case as it ends; what is there is not repeated, and the
order is drawn, so that the first rows are a fair sample. mutations.json and mutations.md are made of all rows. --good
looks at all good data instead: whatever is refused there is a false refusal.
"""

from __future__ import annotations

import argparse
import itertools
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
from mutations.good import NAMES, GoodSet, look_at_good, make_good_sets
from mutations.judging import Seen, Worth, fits, looked_at, verdict_after, verdict_before, worth_of
from mutations.tables import markdown
from tauext.data.recording_file import load_recording
from tauext.errors import TauextError

ROOT = Path(__file__).parents[2]
SEED = 0


def main() -> None:
    options = parsed()
    options.out.mkdir(parents=True, exist_ok=True)
    os.environ["XDG_CACHE_HOME"] = str((options.out / "cache").resolve())  # findings are remembered apart from a user's
    if options.good:
        good = []
        for one in look_at_good(options.out, options.data, options.unseen, options.jobs):
            good.append(one)
            print(f"{one['name']}: {one['error'] or one['faults'] or 'no fault'}", flush=True)
        (options.out / "mutations-good.json").write_text(json.dumps(good, indent=1) + "\n")
    else:
        carry_out(options)
    summarize(options.out)


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the recordings")
    parser.add_argument("--datasets", nargs="+", choices=NAMES, default=NAMES)
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    parser.add_argument("--good", action="store_true", help="look at good data alone: nothing may be refused")
    parser.add_argument("--unseen", type=Path, help="OUT of packages/lab/benchmarks/unseen_arms.py, for --good")
    return parser.parse_args()


def carry_out(options: argparse.Namespace) -> None:
    """Make what is missing, and run the cases that have no row."""
    made = make_good_sets((options.out / "made").resolve(), options.data, options.datasets)
    cases = [case for good in made.values() for case in cases_of(good, SEED)]
    cases = [cases[k] for k in np.random.default_rng(SEED).permutation(len(cases))]
    rows_file = options.out / "mutations.jsonl"
    there = {row["id"] for row in read_rows(rows_file)}
    left = [case for case in cases if case.id not in there]
    clean_folder = options.out / "mutations-clean"
    clean_folder.mkdir(exist_ok=True)
    started = time.monotonic()
    with ProcessPoolExecutor(options.jobs) as pool:
        list(pool.map(clean_outcome, made.values(), itertools.repeat(clean_folder)))
        futures = [pool.submit(row_of, case, made[case.dataset], clean_folder) for case in left]
        for count, future in enumerate(as_completed(futures), start=1):
            row = future.result()
            with rows_file.open("a") as file:
                file.write(json.dumps(row) + "\n")
            print(f"{count}/{len(left)} {time.monotonic() - started:.0f} s {row['verdict']:9} {row['id']}", flush=True)


def clean_outcome(good: GoodSet, folder: Path) -> None:
    """Write what the door says of the clean dataset and what its bundle is worth, unless that is there."""
    path = folder / f"{good.name}.json"
    if path.exists():
        return
    seen = [asdict(one) for one in looked_at(good.folder)]
    worth = worth_of(good.folder, folder / f"{good.name}.tauext", map(load_recording, good.judged))
    print(f"{good.name}: {worth.found} of {worth.events} contacts found by the clean bundle", flush=True)
    path.write_text(json.dumps({"seen": seen, "worth": asdict(worth)}, indent=1) + "\n")


@cache
def clean_of(path: Path) -> tuple[list[Seen], Worth]:
    content = json.loads(path.read_text())
    return [Seen(**one) for one in content["seen"]], Worth(**content["worth"])


def row_of(case: Case, good: GoodSet, clean_folder: Path) -> dict:
    """One case, from the mutation to the verdict."""
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
    verdict, off = verdict_after(worth, clean)
    counts = {"found": worth.found, "events": worth.events, "found_clean": clean.found}
    return counts | {"verdict": verdict, "limit_off": off, "limits_nm": worth.limits_nm}


def read_rows(path: Path) -> list[dict]:
    """The last row of each case."""
    lines = path.read_text().splitlines() if path.exists() else []
    return list({row["id"]: row for row in map(json.loads, lines)}.values())


def summarize(out: Path) -> None:
    """mutations.json and mutations.md of all rows that are there."""
    rows = sorted(read_rows(out / "mutations.jsonl"), key=lambda row: row["id"])
    good_file = out / "mutations-good.json"
    good = json.loads(good_file.read_text()) if good_file.exists() else []
    (out / "mutations.json").write_text(json.dumps(rows, indent=1) + "\n")
    (out / "mutations.md").write_text(markdown(rows, good, "python tests/mutations OUT"))


if __name__ == "__main__":
    main()
