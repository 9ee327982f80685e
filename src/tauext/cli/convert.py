"""`tauext convert`: a bundle of an older format, whose torque constants its loop had to apply, as one of today's."""

from __future__ import annotations

import tyro

from tauext.cli.place_argument import PlaceArg, expect_another, write_another
from tauext.errors import ConfigError, TauextError


def convert(bundle: tyro.conf.Positional[PlaceArg], out: PlaceArg) -> None:
    """Write a bundle anew whose torque constants stood in its provenance, so that the core applies them.

    Bundles of formats 3 and 4 that were trained on motor currents left the multiplication to whoever called them, and
    are refused now. Afterwards a control loop gives tau as it was recorded, in amperes; remove its own multiplication.

    Args:
        bundle: bundle (*.tauext) of format 3 or 4; it stays as it is.
        out: bundle to write, NAME.tauext; one that is there is replaced, and said to be. Its run file is copied along,
            where there is one.
    """
    from tauext.fit.torque_constants import converted

    if not bundle.is_file():
        raise ConfigError(f"{bundle}: there is no such bundle; give one of format 3 or 4")
    expect_another(out, bundle, "convert")
    try:
        new = converted(bundle.read_bytes())
    except TauextError as error:
        raise ConfigError(f"{bundle}: {error}") from error
    write_another(new, bundle, out)
    takes = ", ".join(f"{link.joint_name} {unit}" for link, unit in zip(new.links, new.torque_units, strict=True))
    print(f"tau is now given as it was recorded: {takes}")
    print(out)
