"""Arguments of several commands: paths, outputs, bundles made of another, --accept and --json."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tauext.errors import ConfigError
from tauext.files.atomic_write import atomic_files
from tauext.files.preflight import expect_new_file

# --- Options that take a path.


URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://")
TYPES = tyro.constructors.ConstructorRegistry()
"""How the command line reads a Path."""


def local_path(words: list[str]) -> Path:
    """Raises ConfigError of a URL, without its text, which may hold a key."""
    if found := URL.match(words[0]):
        raise ConfigError(
            f"{found[1]}://...: is a URL, and paths are local; copy the files first, for example by `rclone copy` or "
            "`aws s3 cp --recursive`; only `tauext fleet run` reads and writes object stores"
        )
    return Path(words[0])


@TYPES.primitive_rule
def path_rule(of: tyro.constructors.PrimitiveTypeInfo) -> tyro.constructors.PrimitiveConstructorSpec[Path] | None:
    """The rule of every parameter of type Path."""
    if of.type is not Path:
        return None
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="PATH",
        instance_from_str=local_path,
        is_instance=lambda value: isinstance(value, Path),
        str_from_instance=lambda path: [str(path)],
    )


BundleArg = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="BUNDLE")]
"""The bundle of a command that takes one before its recordings."""
RecordingsArg = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING ...")]
MeshesArg = Annotated[tuple[str, ...], tyro.conf.arg(metavar="FOLDER|PACKAGE=FOLDER ...")]
"""Folders of the meshes that a URDF names."""
AcceptArg = Annotated[tuple[str, ...], tyro.conf.arg(metavar="CODE[:JOINT] ...")]
"""Codes of findings that are accepted."""
JsonArg = Annotated[bool, tyro.conf.arg(name="json")]
"""The option --json."""


# --- Outputs that exist already: results are replaced, and a line on stderr names them before the work begins.


def print_replaced(*outputs: Path) -> None:
    """Print on stderr which of these files exist and will be replaced."""
    for path in outputs:
        if path.is_file():
            print(f"tauext: {path} already exists and will be replaced", file=sys.stderr)


# --- A bundle that is made of another one: what its name may be, and its run file, which is copied along.


if TYPE_CHECKING:
    from tauext._core import Bundle


def expect_another(out: Path, source: Path, purpose: str) -> None:
    """Raises ConfigError where a bundle cannot be written there, or it is the source, which is there to `purpose`."""
    if out.suffix != ".tauext":
        raise ConfigError(f"{out}: a bundle's name ends in .tauext")
    if out.exists() and source.exists() and out.samefile(source):
        raise ConfigError(f"{out}: it is the bundle to {purpose}, which stays as it is; choose another --out")
    expect_new_file(out)


def write_another(new: Bundle, source: Path, out: Path) -> None:
    """Both files or none; those that are replaced are named on stderr."""
    print_replaced(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    run = source.with_suffix(".run.json")
    beside = [run] if run.is_file() else []
    with atomic_files(*(out.with_suffix(".run.json") for _ in beside), out) as (*copies, part):
        for copy, old in zip(copies, beside, strict=True):
            copy.write_bytes(old.read_bytes())
        new.save(str(part))
