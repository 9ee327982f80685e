"""This machine's wheels in dist/, used as whoever has only pip would: empty environments and no compiler.

    python3.11 wheels/try_wheels.py [--pythons 3.12 ...]

With a compiler: follows docs/install.md in the unpacked sdist, as printed, with the newest Python that is there
(pythons.py). With every one, and no compiler: installs the wheel of the core alone, imports, trains and runs with it;
then adds the wheels of packages/, and runs the experiment at smoke scale and `tauext commission` of a simulated arm
until it learns. Times are printed only.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from pythons import SUPPORTED, find_python, pyenv_root

ROOT = Path(__file__).resolve().parent.parent
WORK = ROOT / "build" / "dist" / "try"
PAGE = "docs/install.md"  # README.md has the same commands: tests/test_install_page.py
# No compiler, no CMake: programs of the environment and the few that a shell script needs.
PROGRAMS = ["env", "sh", "uname"]
SHORT = ("--max-steps", "20")
CORE_RECIPES = {"observer": (), "friction": (), "prior": (), "tauext": SHORT, "paper": SHORT}
"""What the core alone trains, with the options that make it short."""
MAKE_CSV = """
from pathlib import Path
import numpy as np
from made_arms import PLANAR_MJCF
from made_planar import moving
Path("arm.xml").write_text(PLANAR_MJCF)
for seed, name in enumerate(("first.csv", "second.csv")):
    made = moving(seed, 60.0, (1.0, 1.0))
    columns = ["t", *(f"{signal}_{joint}" for signal in ("q", "dq", "tau") for joint in made.joints)]
    rows = np.column_stack([made.t_ns * 1e-9, made.q, made.dq, made.tau])
    np.savetxt(name, rows, delimiter=",", header=",".join(columns), comments="")
"""
"""Two CSV files of a planar arm in free motion, by the generators of tests/."""
LONGEST_START_S = 120.0
"""For `tauext commission` to begin to learn, and to end."""


def main() -> None:
    """Every Python that is there; none there, or anything that fails, is an error."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--pythons", nargs="+", choices=SUPPORTED, default=SUPPORTED)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job and its children ignore it
    here = {version: python for version in arguments.parse_args().pythons if (python := find_python(version))}
    if not here:
        sys.exit("no Python to try a wheel with")
    print(f"Pythons: {', '.join(here)}", flush=True)
    newest = next(reversed(here))
    try_page(newest, here[newest])
    with ThreadPoolExecutor(2) as two:  # pip and the experiment use one core
        for tried in [two.submit(try_wheel, version, python, wheel_of(version)) for version, python in here.items()]:
            tried.result()


def wheel_of(version: str) -> Path:
    """The one that pip would take of those in dist/."""
    kind = "cp311-cp311" if version == "3.11" else "cp312-abi3"
    found = sorted((ROOT / "dist").glob(f"tauext-*-{kind}-*_{os.uname().machine}.whl"))
    if not found:
        sys.exit(f"dist/ has no wheel {kind} for {os.uname().machine}: make dist")
    return found[-1]


def try_wheel(version: str, python: str, wheel: Path) -> None:
    """Install and use it, far from the sources and with a home of its own."""
    folder = WORK / version
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "home").mkdir(parents=True)
    timed(version, "environment", [python, "-m", "venv", folder / "venv"], folder, dict(os.environ))
    settings = bare(folder)
    pip = [folder / "venv/bin/pip", "--disable-pip-version-check", "-q", "install", "--only-binary=:all:"]
    pip += ["-c", ROOT / "constraints.txt"]
    tauext = folder / "venv/bin/tauext"
    timed(version, "install", [*pip, wheel], folder, settings)
    core_alone(version, tauext, folder, settings)
    install_packages(version, folder, settings)
    timed(version, "reproduce", [tauext, "reproduce", "--scale", "smoke", "--out", "smoke"], folder, settings)
    if not list((folder / "smoke").rglob("report.html")):
        sys.exit(f"Python {version}: no report of the experiment in {folder / 'smoke'}")
    commission(version, tauext, folder, settings)


def core_alone(version: str, tauext: Path, folder: Path, settings: dict[str, str]) -> None:
    """Without packages: import, train by each recipe of CORE_RECIPES, run; commands of packages name their package."""
    generators = settings | {"PYTHONPATH": str(ROOT / "tests")}
    timed(version, "recordings", [tauext.with_name("python"), "-c", MAKE_CSV], folder, generators)
    new = ["--new", "arm.toml", "--source", "first.csv", "--robot", "arm.xml"]
    timed(version, "import --new", [tauext, "import", *new], folder, settings)
    sources = ["--source", "first.csv", "second.csv", "--arm", "arm.toml", "--out", "data"]
    timed(version, "import", [tauext, "import", *sources], folder, settings)
    for recipe, options in CORE_RECIPES.items():
        words = ["--data", "data", "--recipe", recipe, *options, "--out", f"{recipe}.tauext"]
        timed(version, f"train {recipe}", [tauext, "train", *words], folder, settings)
        timed(version, "run", [tauext, "run", f"{recipe}.tauext", "data/first-test.parquet"], folder, settings)
    for command, package in (("report", "lab"), ("commission", "commission"), ("fleet", "fleet"), ("guard", "lerobot")):
        refused = subprocess.run([tauext, command, "x"], cwd=folder, env=settings, capture_output=True, text=True)
        if refused.returncode != 2 or refused.stdout or not re.fullmatch(rf".*/{package}\b.*\n", refused.stderr):
            sys.exit(f"{refused.stdout}{refused.stderr}Python {version}: `tauext {command}` must name its package")


def install_packages(version: str, folder: Path, settings: dict[str, str]) -> None:
    """Add the wheels of packages/ to the environment, and load each entry point that they bring."""
    packages = sorted((ROOT / "dist").glob("*tauext*-py3-none-any.whl"))
    projects = sorted(ROOT.glob("packages/*/pyproject.toml"))
    if len(packages) != len(projects):
        sys.exit(f"dist/ has {len(packages)} wheels of the {len(projects)} packages: make dist")
    pip = [folder / "venv/bin/pip", "--disable-pip-version-check", "-q", "install", "--prefer-binary"]
    timed(version, "packages", [*pip, "-c", ROOT / "constraints.txt", *packages], folder, settings)
    groups = [tomllib.loads(one.read_text())["project"].get("entry-points", {}) for one in projects]
    points = sorted({(group, name) for by_group in groups for group, names in by_group.items() for name in names})
    load = (
        "from importlib.metadata import entry_points\n"
        f"for group, name in {points!r}:\n"
        "    (point,) = entry_points(group=group, name=name)\n"
        "    try:\n"
        "        point.load()\n"
        "    except Exception as error:\n"
        "        if 'pip install' not in str(error):  # of a library that only this part needs\n"
        "            raise\n"
    )
    names = ", ".join(name for _, name in points)
    timed(version, f"entry points {names}", [folder / "venv/bin/python", "-c", load], folder, settings)


def install_block(page: str) -> str:
    """The commands of README.md or docs/install.md that make a wheel of the source tree and install it."""
    (part,) = re.findall(r"^## (?:Install|From a source tree)\n(.*?)^## ", page, re.MULTILINE | re.DOTALL)
    return re.search(r"^(?: {4}\S.*\n)+", part, re.MULTILINE)[0]


def try_page(version: str, python: str) -> None:
    """The page's commands in the unpacked sdist, with a home of its own."""
    archives = sorted((ROOT / "dist").glob("tauext-*.tar.gz"))
    if not archives:
        sys.exit("dist/ has no sdist: make dist")
    folder = WORK / f"{Path(PAGE).stem}-{version}"
    home = folder / "home of a user"
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "bin").mkdir(parents=True)
    home.mkdir()
    shutil.unpack_archive(archives[-1], folder)
    sources = folder / archives[-1].name.removesuffix(".tar.gz")
    (folder / "bin" / "python3").write_text(f'#!/bin/sh\nexec {python} "$@"\n')
    (folder / "bin" / "python3").chmod(0o755)
    settings = os.environ | {"PATH": f"{folder / 'bin'}:{os.environ['PATH']}", "PYENV_ROOT": pyenv_root()}
    settings["PIP_CACHE_DIR"] = os.environ.get("PIP_CACHE_DIR", str(Path.home() / ".cache" / "pip"))
    settings["PIP_CONSTRAINT"] = (ROOT / "constraints.txt").as_uri()  # pip splits a path at its spaces
    settings["HOME"] = str(home)
    timed(version, PAGE, ["sh", "-ec", install_block((sources / PAGE).read_text())], sources, settings)
    timed(version, "tauext --version", [home / "tauext-env" / "bin" / "tauext", "--version"], folder, settings)


def bare(folder: Path) -> dict[str, str]:
    """Surroundings of a machine without developers' tools."""
    (folder / "bin").mkdir()
    for name in PROGRAMS:
        (folder / "bin" / name).symlink_to(shutil.which(name) or sys.exit(f"no {name} here"))
    kept = {name: os.environ[name] for name in ("PIP_CACHE_DIR", "PIP_INDEX_URL", "LANG") if name in os.environ}
    cache = kept.get("PIP_CACHE_DIR", str(Path.home() / ".cache" / "pip"))
    return kept | {
        "PATH": f"{folder / 'venv/bin'}:{folder / 'bin'}",
        "HOME": str(folder / "home"),
        "PIP_CACHE_DIR": cache,
        "CC": "false",
        "CXX": "false",
    }


def commission(version: str, tauext: Path, folder: Path, settings: dict[str, str]) -> None:
    """Start a simulated arm, wait until it learns, and end it as Ctrl-C does."""
    began, lines = time.monotonic(), []
    words = [tauext, "commission", "--source", "sim:rig", "--out", "try"]
    with subprocess.Popen(words, cwd=folder, env=settings, stdout=subprocess.PIPE, text=True) as running:
        watchdog = threading.Timer(LONGEST_START_S, running.kill)
        watchdog.start()
        for line in running.stdout or ():
            lines.append(line)
            if line.startswith("learning"):
                running.send_signal(signal.SIGINT)
        watchdog.cancel()
    if running.returncode or not any(line.startswith("learning") for line in lines):
        sys.exit(f"{''.join(lines)}Python {version}: commission failed")
    print(f"Python {version}: commission: {time.monotonic() - began:.1f} s", flush=True)


def timed(version: str, what: str, command: list[str | Path], folder: Path, settings: dict[str, str]) -> None:
    """Run one step; one line for it, or its output and an end."""
    began = time.monotonic()
    done = subprocess.run(command, cwd=folder, env=settings, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{done.stdout}{done.stderr}Python {version}: {what} failed")
    print(f"Python {version}: {what}: {time.monotonic() - began:.1f} s", flush=True)


if __name__ == "__main__":
    main()
