"""The long part of the checks: every Python, the wheels, slow tests, sanitizers, other processors, fuzzing, a soak.

    python tests/long_part.py [PART ...]

`make test-all` and the second half of `.ci/run` run all parts. Each part has a log in build/long. A test that fails is
run once more, alone; where it then passes, it is listed as unstable. The last lines name parts, minutes, unstable tests
and what this machine lacks. Status 1 where a part failed.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "wheels"))

from pythons import SUPPORTED, find_python, keep_objects  # noqa: E402

NAMES = {"VENV": os.environ.get("VENV", ".venv"), "BUILD": os.environ.get("BUILD", "build")}
"""For make, which takes no absolute path with a space."""
VENV, BUILD = (ROOT / name for name in NAMES.values())
LOGS = BUILD / "long"
FAST = "not slow and not timing"
PROCESSORS = {"sse2": "Prescott", "avx2": "Haswell", "avx512vl": "SkylakeX"}
"""What /proc/cpuinfo calls the instructions, and OpenBLAS the kernels."""
TOGETHER_MINUTES = 70.0
"""After which all parts are ended; CONTRIBUTING.md has how long they take."""
THREADED = ("estimates_test", "flight_recorder_test", "lstm_gradient_test", "monitor_test", "prior_test")
"""C++ tests that start threads, as `strace -f -e trace=clone,clone3` shows."""
NEEDED_GB = 9.0
"""Of disk for all parts: environments, builds, and what tests write."""
LAST_LINES = 150
"""Of the log of a part that failed."""


LAST_DURATIONS = ROOT / ".pytest_cache/v/tauext/durations_s"
"""Seconds of each test in the last `make test`: see conftest.py."""
SHORTER_THAN_S = 0.3
"""Tests that take longer run with the first Python alone."""
STARTED: list[subprocess.Popen] = []
"""All commands, so that none outlives an interruption."""


class Failed(Exception):
    """A part that did not pass; its log has the reason."""


@dataclass
class Run:
    """One run of a part: its log, what it found, and what it could not find on this machine."""

    name: str
    log: Path
    limit_s: float
    began: float = field(default_factory=time.monotonic)
    processor_s: float = 0.0
    notes: list[str] = field(default_factory=list)
    unstable: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)

    def command(
        self, words: list[str | Path], settings: dict[str, str] | None = None, status: tuple[int, ...] = (0,)
    ) -> int:
        """Run a command within the part's time. Raises Failed where its status is not one of these."""
        with self.log.open("ab") as log:
            log.write(f"$ {' '.join(map(str, words))}\n".encode())
            log.flush()
            running = subprocess.Popen(
                words,
                cwd=ROOT,
                env=environment(settings),
                stdout=log,
                stderr=log,
                stdin=subprocess.DEVNULL,
                start_new_session=True,
            )
            STARTED.append(running)
            done = self.waited(running)
        if done not in status:
            raise Failed(f"status {done} of {' '.join(map(str, words))}")
        return done

    def waited(self, running: subprocess.Popen) -> int:
        """The status of a command, whose processes end with the part's time. Raises Failed."""
        while time.monotonic() - self.began < self.limit_s:
            ended, status, usage = os.wait4(running.pid, os.WNOHANG)
            if ended:
                running.returncode = os.waitstatus_to_exitcode(status)
                self.processor_s += usage.ru_utime + usage.ru_stime
                end(running)
                return running.returncode
            time.sleep(0.1)
        end(running)
        raise Failed(f"ran past its limit of {self.limit_s / 60:.0f} minutes")

    def make(self, *words: str, **settings: str) -> None:
        """A target of the Makefile, with the environment and the build folder of this run."""
        names = NAMES | {name: settings.pop(name) for name in (*NAMES, "PYTHON") if name in settings}
        self.command(["make", *(f"{name}={value}" for name, value in names.items()), *words], settings)

    def pytest(self, marks: str, *more: str | Path, venv: Path = VENV, workers: str = "auto", **settings: str) -> None:
        """Tests by their marks, and once more, one after the other, those that fail."""
        cache = LOGS / f"{self.name}-cache"
        shutil.rmtree(cache, ignore_errors=True)
        if LAST_DURATIONS.exists():
            kept = cache / LAST_DURATIONS.relative_to(ROOT / ".pytest_cache")
            kept.parent.mkdir(parents=True)
            shutil.copy(LAST_DURATIONS, kept)
        words = [venv / "bin/python", "-m", "pytest", "-rs", "-m", marks, "-o", f"cache_dir={cache}"]
        parallel = ["-n", workers, "--maxprocesses", "8", "--dist", "loadfile"] if workers != "0" else []
        status = self.command([*words, *parallel, *more], settings, status=(0, 1, 5))
        printed = self.log.read_text(errors="replace")
        self.notes += re.findall(r"(\d+ (?:passed|failed)[^=\n]*) in [0-9.]+s", printed)[:1]
        skipped: dict[str, int] = {}
        for count, reason in re.findall(r"^SKIPPED \[(\d+)\] [^:]+:(?:\d+:)? (.*)$", printed, re.MULTILINE):
            skipped[reason] = skipped.get(reason, 0) + int(count)
        self.missing += [f"{self.name}: {count} tests: {reason}" for reason, count in sorted(skipped.items())]
        if status == 1:
            lasting = cache / "v/cache/lastfailed"
            failed = json.loads(lasting.read_text()) if lasting.exists() else {}
            if not failed:
                raise Failed("the tests failed, and which is not on record")
            self.command([*words, "--last-failed", "--last-failed-no-failures", "none", *more], settings)
            heads = r"^_+ (?:ERROR at \w+ of )?([^\n]+?) _+$.*?^E +([^\n]*)$"
            why = dict(re.findall(heads, printed, re.MULTILINE | re.DOTALL))
            self.unstable += [f"{test}: {why.get(test.partition('::')[2], 'no reason was printed')}" for test in failed]

    def ctest(self, folder: str, tests: str = "", **settings: str) -> None:
        """The C++ tests of a build, or those of a pattern, and once more, one after the other, those that fail."""
        words = ["ctest", "--output-on-failure", "--test-dir", BUILD / folder, *(["-R", tests] if tests else [])]
        if self.command([*words, "-j", str(os.cpu_count())], settings, status=(0, 8)):
            failed = (BUILD / folder / "Testing/Temporary/LastTestsFailed.log").read_text().split()
            self.command([*words, "--rerun-failed"], settings)
            self.unstable += failed
        self.notes += re.findall(r"tests passed.* out of \d+", self.log.read_text(errors="replace"))[-1:]

    def build(self, folder: str, *options: str, tests: tuple[str, ...] = ()) -> None:
        """A build of the C++ tests, or of those named, in a folder of its own."""
        self.command(["cmake", "-S", ".", "-B", BUILD / folder, "-G", "Ninja", "-DTAUEXT_TESTS=ON", *options])
        self.command(["cmake", "--build", BUILD / folder, *(["--target", *tests] if tests else [])])

    def needs(self, *programs: str, packages: str) -> bool:
        """Whether the machine has all of these; names what it lacks."""
        absent = [name for name in programs if shutil.which(name) is None]
        if absent:
            self.missing.append(f"{self.name}: {', '.join(absent)} (Debian packages {packages})")
        return not absent


def environment(settings: dict[str, str] | None) -> dict[str, str]:
    """This process's, with the programs of the virtual environment and these settings."""
    path = f"{VENV / 'bin'}:{os.environ['PATH']}"
    return os.environ | {"PATH": path, "OPENBLAS_NUM_THREADS": "1"} | (settings or {})


def end(*commands: subprocess.Popen) -> None:
    """End commands and all that they started."""
    for running in commands:
        for sign in (signal.SIGTERM, signal.SIGKILL):
            try:
                os.killpg(running.pid, sign)
                running.wait(5)
            except ProcessLookupError:
                break
            except subprocess.TimeoutExpired:
                continue


def kernels() -> list[str]:
    """What this processor can run, the fewest instructions first."""
    flags = Path("/proc/cpuinfo").read_text().split() if Path("/proc/cpuinfo").exists() else []
    return [name for name in PROCESSORS if name in flags]


def kernel_settings(name: str) -> dict[str, str]:
    """The environment in which OpenBLAS and the core select these instructions; empty: the processor's own."""
    if not name:
        return {}
    return {"OPENBLAS_CORETYPE": PROCESSORS[name], "TAUEXT_SIMD": name.removesuffix("vl")}


# --- The parts.


def style(run: Run) -> None:
    """ruff and mypy."""
    run.make("lint")


def documentation(run: Run) -> None:
    """Sphinx, every warning an error; links within the site."""
    run.make("docs")


def slow(run: Run) -> None:
    """pytest -m slow."""
    run.pytest("slow and not timing", workers=str((os.cpu_count() or 1) + 1))  # many of them wait


def other_python(version: str, kernel: str) -> Callable[[Run], None]:
    """Set-up and tests with another Python, and with the kernels that another processor selects."""

    def part(run: Run) -> None:
        python = find_python(version)
        if python is None:
            run.missing.append(f"Python {version} with headers: not tested")
            return
        folder = BUILD / f"python{version}"
        keep_objects(BUILD / "pythons" / "cpp")
        run.make("setup", PYTHON=python, VENV=f"{NAMES['BUILD']}/{folder.name}/venv", BUILD=f"{NAMES['BUILD']}/pythons")
        run.command([folder / "venv/bin/tauext", "--version"])
        run.notes.append(f"kernels {kernel}")
        run.pytest(FAST, f"--shorter-than={SHORTER_THAN_S}", venv=folder / "venv", **kernel_settings(kernel))

    return part


def wheels(run: Run) -> None:
    """Wheels of core and packages, audited; installed and used in an empty environment of each Python."""
    if run.needs("objdump", packages="binutils"):
        # One wheel for Arm: the other one is built alike.
        only = ["cp311-x86_64", "cp312-x86_64", "cp312-aarch64"]
        run.command([sys.executable, "wheels/make_dist.py", "--only", *only])
        run.command([sys.executable, "wheels/try_wheels.py"])


def build_hostile(run: Run, tests: tuple[str, ...] = ()) -> None:
    """The C++ tests under the address and undefined-behaviour sanitizers; with clang, the fuzzer beside them."""
    fuzzer = ("-DCMAKE_C_COMPILER=clang", "-DCMAKE_CXX_COMPILER=clang++", "-DTAUEXT_FUZZ=ON")
    run.build("address", "-DTAUEXT_SANITIZE=address", *(fuzzer if shutil.which("clang++") else ()), tests=tests)


def address(run: Run) -> None:
    """The C++ tests under the address and undefined-behaviour sanitizers."""
    build_hostile(run)
    run.ctest("address")


def thread(run: Run) -> None:
    """The C++ tests with more than one thread under the thread sanitizer; a missing #include is an error here."""
    run.build("thread", "-DTAUEXT_SANITIZE=thread", "-DCMAKE_DISABLE_PRECOMPILE_HEADERS=ON", tests=THREADED)
    run.ctest("thread", f"^({'|'.join(THREADED)})$")


def other_kernels(run: Run) -> None:
    """The C++ tests with the kernels that other x86-64 processors select."""
    for name in kernels():
        run.ctest("cpp", **kernel_settings(name))
    run.notes = [f"kernels {', '.join(kernels())}"]


def arm(run: Run) -> None:
    """The C++ tests, cross-compiled for 64-bit Arm, under qemu."""
    if run.needs("aarch64-linux-gnu-g++", "qemu-aarch64", packages="g++-aarch64-linux-gnu qemu-user"):
        run.build("arm", "-DCMAKE_TOOLCHAIN_FILE=cmake/aarch64-linux-gnu.cmake")
        run.ctest("arm")


def fuzz(run: Run) -> None:
    """A minute of hostile bundles; what it finds stays in the build folder."""
    if run.needs("clang++", packages="clang libclang-rt-dev"):
        build_hostile(run, tests=("bundle_fuzz",))
        folder = BUILD / "address"
        (folder / "found").mkdir(exist_ok=True)
        options = ["-max_total_time=60", "-max_len=65536", "-rss_limit_mb=1024", "-verbosity=0", "-print_final_stats=1"]
        run.command(
            [folder / "bundle_fuzz", *options, f"-artifact_prefix={folder}/", folder / "found", "cpp/fuzz/corpus"]
        )


def soak(run: Run) -> None:
    """A monitor after a simulated day beside a fresh one."""
    run.make("benches")
    run.command(["nice", BUILD / "cpp/monitor_soak"])


def timing(run: Run) -> None:
    """Tests that need a machine with time to spare: last, alone."""
    run.pytest("timing", workers="0")


HERE = f"{sys.version_info.major}.{sys.version_info.minor}"
OTHERS = [version for version in SUPPORTED if version != HERE]
PARTS: dict[str, tuple[Callable[[Run], None], float]] = {
    "soak": (soak, 40),
    "style": (style, 5),
    "documentation": (documentation, 6),
    "address": (address, 15),
    "thread": (thread, 10),
    "kernels": (other_kernels, 6),
    "arm": (arm, 15),
    "fuzz": (fuzz, 6),
    **{f"python{v}": (other_python(v, k), 20) for v, k in zip(OTHERS, itertools.cycle(kernels() or [""]))},
    "wheels": (wheels, 25),
    "slow": (slow, 25),
    "timing": (timing, 5),
}
"""Each part with the minutes after which it is ended. The first one needs one processor, and runs beside the others."""


def run_part(name: str, began: float) -> tuple[Run, str]:
    """One part of those that began then, [s], with its verdict: passed, or what is wrong."""
    do, minutes = PARTS[name]
    left_s = 60 * TOGETHER_MINUTES - (time.monotonic() - began)
    run = Run(name, LOGS / f"{name}.log", min(60 * minutes, left_s))
    run.log.write_text("")
    verdict = "passed"
    try:
        if left_s <= 0:
            raise Failed(f"not run: the parts before took the {TOGETHER_MINUTES:.0f} minutes of all")
        do(run)
    except Failed as reason:
        verdict = f"FAILED: {reason}"
        print(*run.log.read_text(errors="replace").splitlines()[-LAST_LINES:], sep="\n")
    took = (time.monotonic() - run.began) / 60
    print(
        f"{name:14} {took:5.1f} min, of processors {run.processor_s / 60:5.1f} min  {'; '.join([verdict, *run.notes])}",
        flush=True,
    )
    return run, verdict


def run_parts(names: list[str], began: float) -> list[tuple[Run, str]]:
    """These parts one after the other, but the soak beside the others; the tests of timing at the end, alone."""
    with ThreadPoolExecutor(1) as beside:
        soaked = [beside.submit(run_part, name, began) for name in names if name == "soak"]
        try:
            done = [run_part(name, began) for name in names if name not in ("soak", "timing")]
        except BaseException:
            end(*STARTED)
            raise
        done += [one.result() for one in soaked]
    return done + [run_part(name, began) for name in names if name == "timing"]


def main() -> None:
    """All parts or those that are named; a summary at the end."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; all without")
    wanted = arguments.parse_args().parts or list(PARTS)
    if unknown := sorted(set(wanted) - set(PARTS)):
        arguments.error(f"no part {', '.join(unknown)}; there are {', '.join(PARTS)}")
    free_gb = shutil.disk_usage(ROOT).free / 1e9
    if wanted == list(PARTS) and free_gb < NEEDED_GB:
        sys.exit(f"{ROOT}: {free_gb:.1f} GB are free, and the long part needs {NEEDED_GB:.0f}")
    LOGS.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    done = run_parts([name for name in PARTS if name in wanted], began)
    unstable = [f"{run.name}: {test}" for run, _ in done for test in run.unstable]
    missing = [line for run, _ in done for line in run.missing]
    failed = [run.name for run, verdict in done if verdict != "passed"]
    print(
        f"the long part: {(time.monotonic() - began) / 60:.1f} minutes, Python {HERE} and {os.cpu_count()} processors"
    )
    print(*(f"missing here: {line}" for line in missing), sep="\n", end="\n" if missing else "")
    print(f"unstable (failed, and passed alone): {len(unstable)}", *(f"  {line}" for line in unstable), sep="\n")
    print(f"{len(done) - len(failed)} passed, {len(failed)} failed")
    if failed:
        sys.exit(f"failed: {', '.join(failed)}; logs in {LOGS}")


if __name__ == "__main__":
    main()
