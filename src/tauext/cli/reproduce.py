"""`tauext reproduce`: the paper from beginning to end."""

from __future__ import annotations

from typing import Literal

from tauext.cli.place_argument import PlaceArg
from tauext.config import CaseName, require_seed
from tauext.files.copies import staged


def reproduce(
    out: PlaceArg,
    scale: Literal["smoke", "quick", "full"] = "quick",
    cases: tuple[CaseName, ...] = ("exact", "mass", "com", "mass+com", "none"),
    seed: int = 0,
) -> None:
    """Simulate, train five models, evaluate and report: the whole paper in one command.

    What is finished is kept: the same command goes on where it was interrupted. Results and report are written anew,
    and those that are there said to be replaced.

    Args:
        out: folder for data, bundles, results and report.
        scale: how much is done. smoke: seconds, numbers mean nothing. quick: two minutes on two cores; every model case
            by 10,000 steps of the dense recipe, the exact model by tauext's own from 10 minutes of the motion. full:
            every model case by the whole dense recipe (5 minutes), then by the paper's whole recipe too (half an hour
            each on two cores, one after another).
        cases: model cases to train.
        seed: seed of everything that is drawn.
    """
    from tauext.cli.evaluate import command_line
    from tauext.cli.experiment import SCALES, reproduce_paper
    from tauext.cli.place_argument import tell_replaced
    from tauext.cli.progress import Terminal
    from tauext.files.room import expect_folder

    require_seed(seed)
    expect_folder(out)
    tell_replaced(out / "results" / "results.json", out / "report" / "report.html")
    with staged(out) as folder:
        page = reproduce_paper(folder, scale, SCALES[scale], cases, seed, command_line(), Terminal())
    print(out / page.relative_to(folder).as_posix())
