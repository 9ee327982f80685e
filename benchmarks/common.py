"""The harness of all benchmarks: options, tauext's commands, workers, checkpoints, alarms, tables, what a run is of.

Import it first: what the benchmarks of other packages and tests have made is found afterwards.
"""

from __future__ import annotations

import argparse
import json
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from datetime import date
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")
ROOT = Path(__file__).parent.parent
SHARED = ROOT.parent / "shared" / "data"
COLLISION = 2
sys.path += [str(ROOT / "packages/lab/benchmarks"), str(ROOT / "tests")]

# --- Options.


def arguments(
    doc: str | None,
    *paths: str,
    arms: Sequence[str] = (),
    seed: int | None = None,
    workers: int = 0,
    data: str | None = None,
    loop: bool = False,
) -> argparse.ArgumentParser:
    """A parser described by a script's docstring.

    Args:
        paths: names of positional paths.
        arms, seed, workers: defaults of --arms, --seed and --workers; without one there is no such option.
        data: folder of real recordings in the shared ones, default of --data.
        loop: whether --core and --priority of a live loop are asked for.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in paths:
        parser.add_argument(name, type=Path)
    if arms:
        parser.add_argument("--arms", nargs="+", default=list(arms), help=f"default: {' '.join(arms)}")
    if seed is not None:
        parser.add_argument("--seed", type=int, default=seed, help="of everything that is drawn, default: %(default)s")
    if workers:
        parser.add_argument("--workers", type=int, default=workers, help="processes, default: %(default)s")
    if data is not None:
        parser.add_argument("--data", type=Path, default=SHARED / data, help="of real recordings, default: %(default)s")
    if loop:
        parser.add_argument("--core", type=int, help="pin the loop and the thread that receives to this core")
        parser.add_argument("--priority", type=int, help="SCHED_FIFO for both")
    return parser


def type_arguments(doc: str | None, arms: int, type_seed: int = 1) -> argparse.ArgumentParser:
    """A parser of paths MODELS and OUT, and of what a fleet of one simulated type is drawn from."""
    parser = arguments(doc, "models", "out")
    parser.add_argument("--type", default="ur5", help="of the arms' maker, default: %(default)s")
    parser.add_argument("--type-seed", type=int, default=type_seed, help="draws the type, default: %(default)s")
    parser.add_argument("--arms", type=int, default=arms, help="of the fleet, default: %(default)s")
    return parser


# --- Commands, workers, checkpoints.


def tauext(
    *words: object, printed: Path | None = None, accept: Sequence[int] = (0,), folder: Path | None = None
) -> str:
    """Standard output of `tauext WORDS`.

    Args:
        printed: file that keeps standard output and errors.
        accept: exit statuses that are no failure.
        folder: working directory.

    Raises:
        RuntimeError: the command failed; the message holds its output.
    """
    command = [sys.executable, "-m", "tauext", *map(str, words)]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if printed is not None:
        printed.write_text(ended.stdout + ended.stderr)
    if ended.returncode not in accept:
        raise RuntimeError(f"{' '.join(command)}: exit status {ended.returncode}\n{ended.stdout}{ended.stderr}")
    return ended.stdout


def trained(data: Path, bundle: Path, *words: object, recipe: str = "prior") -> Path:
    """The bundle, trained on this dataset by this recipe unless it exists."""
    if not bundle.exists():
        bundle.parent.mkdir(parents=True, exist_ok=True)
        printed = bundle.with_suffix(".train.txt")
        tauext("train", "--data", data, "--recipe", recipe, "--out", bundle, *words, printed=printed)
    return bundle


def in_parallel(workers: int | None, function: Callable[..., T], jobs: Iterable[tuple]) -> list[T]:
    """Results of function(*job) in the order of the jobs, in so many processes; None: one a core."""
    if workers == 1:
        return [function(*job) for job in jobs]
    with ProcessPoolExecutor(workers) as pool:
        return [one.result() for one in [pool.submit(function, *job) for job in jobs]]


def checkpoint(path: Path, make: Callable[[], Any], *newer_than: Path) -> Any:
    """Content of a JSON file; made and written unless it exists and is newer than these files."""
    if path.exists() and all(path.stat().st_mtime > other.stat().st_mtime for other in newer_than):
        return json.loads(path.read_text())
    content = make()
    save_json(content, path)
    return content


def save_json(content: Any, path: Path) -> None:
    """Write JSON under a temporary name, then rename: a list a line an element."""
    from tauext.files.atomic_write import atomic_write

    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(content, indent=1)
    if isinstance(content, list):
        text = "[\n" + ",\n".join(map(json.dumps, content)) + "\n]"
    with atomic_write(path) as part:
        part.write_text(text + "\n")


def short(value: Any) -> Any:
    """The same content with numbers to four digits."""
    if isinstance(value, dict):
        return {name: short(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [short(one) for one in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value


# --- Tables.


def head(columns: str) -> list[str]:
    """First two lines of a Markdown table whose columns are separated by ` | `."""
    return [f"| {columns} |", "|---" * (columns.count(" | ") + 1) + "|"]


def table_row(*cells: object) -> str:
    """A line of a Markdown table."""
    return f"| {' | '.join(map(str, cells))} |"


def joined(values: Iterable[float], form: str = ".2f", by: str = " · ") -> str:
    """Numbers in one cell, joint by joint."""
    return by.join(format(value, form) for value in values)


def error_cells(errors: np.ndarray) -> list[str]:
    """Mean, root of the mean square and largest of absolute errors (rows, joints), in cells."""
    return [joined(errors.mean(axis=0), ".2f", "/"), joined(rms(errors, 0), ".2f", "/"),
            joined(errors.max(axis=0), ".1f", "/")]  # fmt: skip


def quantiles_ms(delays_s: Sequence[float], shares: Sequence[float] = (0.5, 0.95)) -> str:
    """Quantiles of delays in ms; a dash of none."""
    return joined(1e3 * np.quantile(delays_s, shares), ".0f", ", ") if len(delays_s) else "–"


def share_interval(found: int, of: int) -> tuple[float, float]:
    """95 % interval of a share [Clopper and Pearson], in percent."""
    from scipy.stats import beta

    low = 0.0 if found == 0 else beta.ppf(0.025, found, of - found + 1)
    high = 1.0 if found == of else beta.ppf(0.975, found + 1, of - found)
    return 100 * float(low), 100 * float(high)


def write_tables(out: Path, lines: Iterable[str], content: Any = None, name: str = "tables") -> None:
    """Write OUT/NAME.md, tables below the command and what it ran on, and print it; with content also OUT/NAME.json."""
    script = Path(sys.argv[0]).resolve()
    words = shlex.join(["python", str(script.relative_to(ROOT) if ROOT in script.parents else script), *sys.argv[1:]])
    write_page(out / f"{name}.md", [f"    {words}", "", f"{about_run()}.", "", *lines])
    if content is not None:
        save_json(content, out / f"{name}.json")


def write_page(path: Path, lines: Iterable[str]) -> None:
    """Write a text and print it."""
    text = "\n".join(lines) + "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    print(text)


# --- What a run is of.


def about_run() -> str:
    """Date, commit, machine."""
    from tauext.files.provenance import machine

    return f"{date.today():%-d %B %Y}, commit {commit()}, {machine()}"


def commit() -> str:
    """The commit of this code, with `+` if files differ from it; `?` without Git."""
    git = ["git", "-C", str(ROOT), "describe", "--always", "--dirty=+"]
    try:
        return subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "?"


def compiler_flags() -> str:
    """The compiler of the core, and the flags that its arithmetic depends on."""
    from tauext import _core

    cmake = (ROOT / "CMakeLists.txt").read_text(encoding="utf-8")
    found = re.search(r"target_compile_options\(tauext_flags INTERFACE ([^)]*)\)", cmake)
    assert found is not None
    gnu = _core.COMPILER.startswith("gcc")
    chosen = re.sub(r"\$<IF:\$\{gnu\},([^,>]*),([^>]*)>", lambda one: one.group(1 if gnu else 2), found.group(1))
    return " ".join([_core.COMPILER, "C++20", *(f for f in chosen.split() if not f.startswith(("-W", "$<")))])


# --- Signals.


def estimates(bundle: Any, recording: Any, threads: int = 1) -> dict[str, np.ndarray]:
    """The core's answers of all samples by name."""
    from tauext import _core

    signals = (recording.t_ns, recording.q, recording.dq, recording.tau)
    return dict(_core.estimate(bundle, *signals, threads, recording.temperature))


def runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """Begin and end of each run of true samples."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(begin), int(end)) for begin, end in edges.reshape(-1, 2)]


def collisions_begin(held_alarm: np.ndarray, t_ns: np.ndarray, apart_s: float = 0.5) -> np.ndarray:
    """Stamps [ns] at which collisions began, those less than so far apart counted as one."""
    at = t_ns[np.flatnonzero(held_alarm == COLLISION)]
    return at[np.append(True, np.diff(at) >= apart_s * 1e9)] if len(at) else at


def rms(values: np.ndarray, axis: int | None = None) -> np.ndarray:
    """Root of the mean square; NaN is left out."""
    return np.sqrt(np.nanmean(np.square(values), axis=axis))
