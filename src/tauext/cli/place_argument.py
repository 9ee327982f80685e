"""Arguments of several commands: paths or URLs, outputs, bundles made of another, --accept and --json."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from tauext.errors import ConfigError
from tauext.files.atomic_write import atomic_files
from tauext.files.places import Place, StoredPlace, place_of, same_place
from tauext.files.preflight import expect_new_file

# --- Options that take a path or a URL of a store.


def is_place(value: Any) -> bool:
    return isinstance(value, Path | StoredPlace)


SPEC: PrimitiveConstructorSpec[Place] = PrimitiveConstructorSpec(
    nargs=1,
    metavar="PATH|URL",
    instance_from_str=lambda words: place_of(words[0]),
    is_instance=is_place,
    str_from_instance=lambda place: [str(place)],
)
PlaceArg = Annotated[Place, SPEC]
"""In the help PATH|URL."""
BundleArg = Annotated[PlaceArg, tyro.conf.Positional, tyro.conf.arg(metavar="BUNDLE")]
"""The bundle of a command that takes one before its recordings."""
RecordingsArg = Annotated[tuple[PlaceArg, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING ...")]


def local(words: list[str]) -> Path:
    place = place_of(words[0])
    if isinstance(place, Path):
        return place
    raise ConfigError(f"{place}: a live loop waits for no store; give a folder of this machine, and copy it later")


LOCAL: PrimitiveConstructorSpec[Path] = PrimitiveConstructorSpec(
    nargs=1, metavar="PATH", instance_from_str=local, is_instance=is_place, str_from_instance=lambda path: [str(path)]
)
LocalArg = Annotated[Path, LOCAL]
"""A path on this machine; no URL."""


MeshesArg = Annotated[tuple[str, ...], tyro.conf.arg(metavar="FOLDER|PACKAGE=FOLDER ...")]
"""Folders of the meshes that a URDF names."""
AcceptArg = Annotated[tuple[str, ...], tyro.conf.arg(metavar="CODE[:JOINT] ...")]
"""Codes of findings that are accepted."""
JsonArg = Annotated[bool, tyro.conf.arg(name="json")]
"""The option --json."""


# --- Outputs that exist already: results are replaced, and a line on stderr names them before the work begins.


def print_replaced(*outputs: Place) -> None:
    """Print on stderr which of these files exist and will be replaced."""
    for path in outputs:
        if path.is_file():
            print(f"tauext: {path} already exists and will be replaced", file=sys.stderr)


# --- A bundle that is made of another one: what its name may be, and its run file, which is copied along.


if TYPE_CHECKING:
    from tauext._core import Bundle


def expect_another(out: Place, source: Place, purpose: str) -> None:
    """Raises ConfigError where a bundle cannot be written there, or it is the source, which is there to `purpose`."""
    if out.suffix != ".tauext":
        raise ConfigError(f"{out}: a bundle's name ends in .tauext")
    if same_place(out, source):
        raise ConfigError(f"{out}: it is the bundle to {purpose}, which stays as it is; choose another --out")
    expect_new_file(out)


def write_another(new: Bundle, source: Place, out: Place) -> None:
    """Both files or none; those that are replaced are named on stderr."""
    print_replaced(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    run = source.with_suffix(".run.json")
    beside = [run] if run.is_file() else []
    with atomic_files(*(out.with_suffix(".run.json") for _ in beside), out) as (*copies, part):
        for copy, old in zip(copies, beside, strict=True):
            copy.write_bytes(old.read_bytes())
        new.save(str(part))
