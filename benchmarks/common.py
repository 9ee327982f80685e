"""What the benchmarks share: options, tauext's commands, Markdown tables, collisions on a time axis, the machine."""

from __future__ import annotations

import argparse
import os
import re
import socket
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TypeVar

import numpy as np

T = TypeVar("T")
ROOT = Path(__file__).parent.parent
COLLISION = 2
EPISODE_S = 0.5
"""Alarms less than this apart count as one collision."""


def arguments(doc: str | None, *paths: str) -> argparse.ArgumentParser:
    """A parser described by the first line of a script's docstring, with these positional paths."""
    parser = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    for name in paths:
        parser.add_argument(name, type=Path)
    return parser


def type_arguments(doc: str | None, arms: int, type_seed: int = 1) -> argparse.ArgumentParser:
    """A parser of paths MODELS and OUT, and of what a fleet of one simulated type is drawn from."""
    parser = arguments(doc, "models", "out")
    parser.add_argument("--type", default="ur5", help="of the arms' maker, default: %(default)s")
    parser.add_argument("--type-seed", type=int, default=type_seed, help="draws the type, default: %(default)s")
    parser.add_argument("--arms", type=int, default=arms, help="of the fleet, default: %(default)s")
    return parser


def loop_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the loop's core and priority."""
    parser.add_argument("--core", type=int, help="as for the command")
    parser.add_argument("--priority", type=int, help="as for the command")


def loop_flags(options: argparse.Namespace) -> list[str]:
    """The given ones as words of the command."""
    return [f"--{name}={value}" for name in ("core", "priority") if (value := getattr(options, name)) is not None]


def flags(given: argparse.Namespace, usual: dict[str, object]) -> str:
    """The options that differ from these defaults, as they stand on a command line."""
    other = {name: getattr(given, name) for name in usual if getattr(given, name) != usual[name]}
    return "".join(
        f" --{name.replace('_', '-')} {f'{value:g}' if isinstance(value, float) else value}"
        for name, value in other.items()
    )


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


def trained(data: Path, bundle: Path, *words: object) -> Path:
    """The bundle, trained on this dataset by recipe prior unless it exists."""
    if not bundle.exists():
        tauext("train", "--data", data, "--recipe", "prior", "--out", bundle, *words)
    return bundle


def in_parallel(workers: int | None, function: Callable[..., T], jobs: Iterable[tuple]) -> list[T]:
    """Results of function(*job) in the order of the jobs, in so many processes; None: one a core."""
    if workers == 1:
        return [function(*job) for job in jobs]
    with ProcessPoolExecutor(workers) as pool:
        return [one.result() for one in [pool.submit(function, *job) for job in jobs]]


def head(columns: str) -> list[str]:
    """First two lines of a Markdown table whose columns are separated by ` | `."""
    return [f"| {columns} |", "|---" * (columns.count(" | ") + 1) + "|"]


def table_row(*cells: object) -> str:
    """A line of a Markdown table."""
    return f"| {' | '.join(map(str, cells))} |"


def write_section(out: Path, intro: str, name: str, section: str | Iterable[str]) -> None:
    """Write OUT/NAME.inc, and OUT/README.md with the sections of all runs in OUT."""
    write_page(out / f"{name}.inc", section)
    sections = [path.read_text() for path in sorted(out.glob("*.inc"))]
    (out / "README.md").write_text("\n".join([intro, *sections]))


def write_page(path: Path, lines: str | Iterable[str]) -> None:
    """Write a page and print it."""
    text = lines if isinstance(lines, str) else "\n".join(lines) + "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    print(text)


def replace_section(page: Path, heading: str, lines: Iterable[str]) -> None:
    """Replace a page's last section, from its heading to the end, by these lines."""
    text, found, _ = page.read_text().partition(f"\n{heading}\n")
    if not found:
        raise SystemExit(f"{page}: has no section {heading!r}")
    page.write_text("\n".join([text, heading, "", *lines]).rstrip() + "\n")
    print(page)


def runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """Begin and end of each run of true samples."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(begin), int(end)) for begin, end in edges.reshape(-1, 2)]


def collisions_begin(held_alarm: np.ndarray, t_ns: np.ndarray) -> np.ndarray:
    """Stamps [ns] at which collisions began, those less than EPISODE_S apart counted as one."""
    at = t_ns[np.flatnonzero(held_alarm == COLLISION)]
    return at[np.append(True, np.diff(at) >= EPISODE_S * 1e9)] if len(at) else at


def joined(values: Iterable[float], form: str = ".2f", by: str = " · ") -> str:
    """Numbers in one cell, joint by joint."""
    return by.join(format(value, form) for value in values)


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def compiler_flags() -> str:
    """The compiler of the core, and the flags that its arithmetic depends on."""
    from tauext import _core

    cmake = (ROOT / "CMakeLists.txt").read_text(encoding="utf-8")
    found = re.search(r"target_compile_options\(tauext_flags INTERFACE ([^)]*)\)", cmake)
    assert found is not None
    gnu = _core.COMPILER.startswith("gcc")
    chosen = re.sub(r"\$<IF:\$\{gnu\},([^,>]*),([^>]*)>", lambda one: one.group(1 if gnu else 2), found.group(1))
    return " ".join([_core.COMPILER, "C++20", *(f for f in chosen.split() if not f.startswith(("-W", "$<")))])


def other_processes_s() -> tuple[float, float]:
    """Processor time of all other processes since the system started, and time that the host kept; 0 where unknown."""
    stat = Path("/proc/stat")
    if not stat.exists():
        return 0.0, 0.0
    ticks = [int(value) for value in stat.read_text().split("\n")[0].split()[1:]]
    here, second = os.times(), os.sysconf("SC_CLK_TCK")
    own = here.user + here.system + here.children_user + here.children_system
    return sum(ticks[:3]) / second - own, (ticks[7] if len(ticks) > 7 else 0) / second
