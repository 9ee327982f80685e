"""A bundle that is made of another one: what its name may be, and its run file, which is copied along."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tauext.cli.replaced import tell_replaced
from tauext.errors import ConfigError
from tauext.files.place import Place, same_place
from tauext.files.room import expect_new_file
from tauext.files.whole_file import whole_files

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
    tell_replaced(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    run = source.with_suffix(".run.json")
    beside = [run] if run.is_file() else []
    with whole_files(*(out.with_suffix(".run.json") for _ in beside), out) as (*copies, part):
        for copy, old in zip(copies, beside, strict=True):
            copy.write_bytes(old.read_bytes())
        new.save(str(part))
