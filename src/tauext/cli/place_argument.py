"""Options that take a path or a URL of a store."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from tyro.constructors import PrimitiveConstructorSpec

from tauext.errors import ConfigError
from tauext.files.place import Place, place_of
from tauext.files.stored import StoredPlace


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


def local(words: list[str]) -> Path:
    place = place_of(words[0])
    if isinstance(place, Path):
        return place
    raise ConfigError(f"{place}: a live loop waits for no store; give a folder of this machine, and copy it later")


LOCAL: PrimitiveConstructorSpec[Path] = PrimitiveConstructorSpec(
    nargs=1, metavar="PATH", instance_from_str=local, is_instance=is_place, str_from_instance=lambda path: [str(path)]
)
LocalArg = Annotated[Path, LOCAL]
"""Of this machine alone."""
