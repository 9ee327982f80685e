"""`tauext convert`: a bundle of an older format, whose torque constants its loop had to apply, as one of today's."""

from __future__ import annotations

from pathlib import Path

import tyro

from tauext.cli.replaced import tell_replaced
from tauext.errors import ConfigError, TauextError
from tauext.room import expect_new_file
from tauext.whole_file import whole_files


def convert(bundle: tyro.conf.Positional[Path], out: Path) -> None:
    """Write a bundle anew whose torque constants stood in its provenance, so that the core applies them.

    Bundles of formats 3 and 4 that were trained on motor currents left the multiplication to whoever called them, and
    are refused now. Afterwards a control loop gives tau as it was recorded, in amperes; remove its own multiplication.

    Args:
        bundle: bundle (*.tauext) of format 3 or 4; it stays as it is.
        out: bundle to write, NAME.tauext; one that is there is replaced, and said to be. Its run file is copied along,
            where there is one.
    """
    from tauext.learn.old_constants import converted

    if not bundle.is_file():
        raise ConfigError(f"{bundle}: there is no such bundle; give one of format 3 or 4")
    if out.suffix != ".tauext":
        raise ConfigError(f"{out}: a bundle's name ends in .tauext")
    if out.exists() and out.samefile(bundle):
        raise ConfigError(f"{out}: it is the bundle to convert, which stays as it is; choose another --out")
    expect_new_file(out)
    try:
        new = converted(bundle.read_bytes())
    except TauextError as error:
        raise ConfigError(f"{bundle}: {error}") from error
    tell_replaced(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    run = bundle.with_suffix(".run.json")
    beside = [run] if run.is_file() else []
    with whole_files(*(out.with_suffix(".run.json") for _ in beside), out) as (*parts, part):
        for copy, source in zip(parts, beside, strict=True):
            copy.write_bytes(source.read_bytes())
        new.save(str(part))
    takes = ", ".join(f"{link.joint_name} {unit}" for link, unit in zip(new.links, new.torque_units, strict=True))
    print(f"tau is now given as it was recorded: {takes}")
    print(out)
