"""`tauext fleet prior`: what arms of one type know that the next one does not."""

from __future__ import annotations

from typing import Annotated

import tyro

from tauext.cli.place_argument import PlaceArg
from tauext.config import require_threads


def prior(
    arms: tyro.conf.Positional[tuple[str, ...]],
    out: PlaceArg,
    threads: int = 0,
    accept: Annotated[tuple[str, ...], tyro.conf.arg(metavar="CODE[:JOINT] ...")] = (),
) -> None:
    """Learn from arms of one type what the next one can start with: `tauext train --like` takes it, and a minute.

    Printed is each arm's friction by the fleet's, a row an arm; * marks what is not like the others and counts for
    less. An arm that `tauext train` would refuse is left out, with the reason.

    Args:
        arms: three arms or more, each a dataset folder, or BUNDLE.tauext:DATA with the bundle that was trained on it,
            whose terms are taken over instead of being searched for anew.
        out: file to write, NAME.prior.json.
        threads: how many to work in; 0: one a core. The result does not depend on it.
        accept: codes of findings that are no fault on your word, at all joints or at one.
    """
    require_threads(threads)
    from tauext.cli.replaced import tell_replaced
    from tauext.cli.reporter import Terminal
    from tauext.config import TrainConfig
    from tauext.fleet.arms import fleet_arms
    from tauext.fleet.fleet_prior_stage import make_fleet_prior
    from tauext.fleet.summary import table

    config = TrainConfig(recipe="prior", threads=threads)
    fleet = fleet_arms(arms)
    tell_replaced(out)
    found = make_fleet_prior(fleet, out, config, accept, Terminal())
    print(table(dict(found.facts)))
    print(out)
