"""`tauext refit`: the friction of a bundle brought up to date by a minute of today's motion."""

from __future__ import annotations

from typing import Annotated

import tyro

from tauext.cli.place_argument import PlaceArg
from tauext.config import require, require_threads
from tauext.errors import ConfigError
from tauext.files.places import same_place


def refit(
    bundle: tyro.conf.Positional[PlaceArg],
    data: PlaceArg,
    out: PlaceArg,
    from_s: Annotated[float, tyro.conf.arg(name="from")] = 0.0,
    to_s: Annotated[float | None, tyro.conf.arg(name="to")] = None,
    seconds: float | None = None,
    like: PlaceArg | None = None,
    threads: int = 0,
    accept: Annotated[tuple[str, ...], tyro.conf.arg(metavar="CODE[:JOINT] ...")] = (),
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> None:
    """Bring the friction of a bundle up to date with 30 to 60 s of the arm's ordinary motion today.

    Friction of a joint moves by a common factor first, then apart as the motion supports it; gravity and inertia stay.
    Limits grow where today's error is larger, and never shrink. Printed is what changed, a row a joint, and whether the
    promise of false alarms still stands. First the recordings are looked at, by those checks of `tauext check` that are
    cheap: a fault refuses. Labelled contacts are left out; so is what no friction explains, and it is told.

    Args:
        bundle: bundle (*.tauext) with a prior, of recipe tauext or prior; it stays as it is.
        data: recording (*.parquet), or dataset folder whose training recordings are used.
        out: bundle to write, NAME.tauext; one that is there is replaced, and said to be.
        from_s: seconds of each recording at which the motion to be used begins.
        to_s: seconds of each recording at which it ends. None: at its end.
        seconds: how many seconds of each recording are used, instead of --to. None: all.
        like: NAME.prior.json of a fleet of arms of this type (`tauext fleet prior`): a joint that hardly moved follows
            those that did, as far as the fleet's arms showed it from one recording to the next.
        threads: threads that estimate; 0: one a core. The result does not depend on it.
        accept: codes of findings that are no fault on your word, at all joints or at one; they stand in the bundle.
        as_json: print one JSON object instead of the table.
    """
    from tauext.cli.place_argument import tell_replaced
    from tauext.cli.progress import Terminal
    from tauext.files.provenance import json_text
    from tauext.fit.fleet_prior import load_fleet_prior
    from tauext.train.refit import Span, refit_bundle

    require_threads(threads)
    require(seconds is None or to_s is None, "seconds", seconds, "left out with --to")
    require(seconds is None or 0 < seconds <= 1e6, "seconds", seconds, "> 0, at most 1e6")
    if out.suffix != ".tauext":
        raise ConfigError(f"{out}: a bundle's name ends in .tauext")
    if same_place(out, bundle):
        raise ConfigError(f"{out}: it is the bundle to begin with, which stays as it is; choose another --out")
    known = None if like is None else load_fleet_prior(like)
    tell_replaced(out)
    span = Span(from_s, to_s if seconds is None else from_s + seconds)
    found = refit_bundle(bundle, data, out, span, threads, Terminal(), accept, known)
    if as_json:
        print(json_text(found.facts() | {"bundle": str(out)}), end="")
        return
    print(found.table())
    print(found.promise)
    print(out)
