"""Which recording belongs to which set: whole recordings only, so that no window is in two sets."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from tauext.errors import ConfigError
from tauext.files.place import Place, place_of
from tauext.files.plain_file import json_of, read_text
from tauext.files.whole_file import whole_file

FORMAT = 1
FILE_NAME = "split.json"


@dataclass(frozen=True)
class Split:
    """File names of a dataset's recordings, relative to its folder; a name stands in one set only.

    Any number of each: whoever has one recording lists one. Twenty are the rule of split_recordings alone.

    Raises:
        ConfigError: a name that stands twice, or is not a plain file name.
    """

    train: tuple[str, ...]
    validation: tuple[str, ...]
    test: tuple[str, ...]
    collisions: tuple[str, ...] = ()
    calibration: tuple[str, ...] = ()
    """Free motion that only limits are found on; none: a dataset of the paper's kind."""

    def __post_init__(self) -> None:
        where: dict[str, str] = {}
        for set_name in SETS:
            names = tuple(getattr(self, set_name))
            object.__setattr__(self, set_name, names)
            for name in names:
                if not isinstance(name, str) or not name or Path(name).name != name:
                    raise ConfigError(f"split: {name!r} in '{set_name}' must be a file name without a folder")
                if name in where:
                    sets = (
                        f"twice in '{set_name}'"
                        if where[name] == set_name
                        else f"in '{where[name]}' and in '{set_name}'"
                    )
                    raise ConfigError(f"split: '{name}' stands {sets}; a recording belongs to one set only")
                where[name] = set_name


SETS = tuple(field.name for field in fields(Split))
OPTIONAL = ("validation", "test", "collisions", "calibration")
"""A list that is missing is empty; without validation recordings a part of the training recordings validates."""


def split_recordings(
    names: Iterable[str],
    seed: int,
    fractions: tuple[float, float, float] = (0.7, 0.15, 0.15),
    minimum: int = 20,
    collisions: Iterable[str] = (),
) -> Split:
    """Draw by seed which recordings of free motion train, validate and test; no set is empty.

    The result does not depend on the order of `names`; inside a set they are sorted.

    Args:
        names: file names of recordings of free motion.
        fractions: shares of train, validation and test, > 0, summing to 1; counts are rounded.
        minimum: fewer recordings than this are refused: with fewer than 20 one recording is more than a third of a
            15 % set, and its luck is the result.
        collisions: file names of recordings with contacts; they stay together.

    Raises:
        ConfigError: too few recordings, fractions that break their rule, or a name twice.
    """
    names = sorted(names)
    if len(fractions) != 3 or min(fractions) <= 0 or abs(sum(fractions) - 1) > 1e-9:
        raise ConfigError(f"fractions = {fractions} must be three numbers > 0 (train, validation, test) that sum to 1")
    needed = max(3, minimum)
    if len(names) < needed:
        raise ConfigError(
            f"{len(names)} recordings of free motion are too few to split: at least {needed} are needed; "
            "record more, shorter ones"
        )
    validation, test = (max(1, round(share * len(names))) for share in fractions[1:])
    if validation + test >= len(names):
        raise ConfigError(f"fractions = {fractions} leave no training recording out of {len(names)}")
    order = np.random.default_rng(seed).permutation(len(names))
    sets = np.split(order, [validation, validation + test])
    drawn = [tuple(names[k] for k in sorted(one)) for one in sets]
    return Split(train=drawn[2], validation=drawn[0], test=drawn[1], collisions=tuple(collisions))


def save_split(split: Split, folder: Place | str) -> None:
    """Write `split.json` into a dataset folder, under a temporary name first."""
    path = place_of(folder) / FILE_NAME
    with whole_file(path) as part:
        part.write_text(json.dumps({"format": FORMAT} | asdict(split), indent=1) + "\n")


def load_split(folder: Place | str) -> Split:
    """Read a dataset folder's `split.json`; every file it lists exists.

    Raises:
        ConfigError: no such file, not JSON, another format, a set missing or none of SETS, a name twice, a listed file
            missing.
    """
    folder = place_of(folder)
    path = folder / FILE_NAME
    try:
        content = json_of(read_text(path))
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: there is no such file; a dataset folder holds one beside its recordings") from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: not readable as JSON ({error})") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        found = content.get("format") if isinstance(content, dict) else None
        raise ConfigError(f"{path}: its format is {found!r}, this version reads {FORMAT}")
    for key in content:
        if key != "format" and key not in SETS:  # a list that nobody reads would be a set that is empty unsaid
            raise ConfigError(f"{path}: '{key}' is no set; the sets are {', '.join(SETS)}")
    for set_name in SETS:
        if set_name in OPTIONAL and set_name not in content:
            content[set_name] = []
        if not isinstance(content.get(set_name), list):
            raise ConfigError(f"{path}: '{set_name}' must be a list of file names; the sets are {', '.join(SETS)}")
    try:
        split = Split(**{set_name: tuple(content[set_name]) for set_name in SETS})
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    there = {place.name for place in folder.iterdir() if place.is_file()}
    for set_name in SETS:
        for name in getattr(split, set_name):
            if name not in there:
                raise ConfigError(f"{path}: '{name}' in '{set_name}' does not exist in {folder}")
    return split
