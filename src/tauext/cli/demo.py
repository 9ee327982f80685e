"""`tauext demo`: push a simulated arm in the browser and see the monitor's estimates."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from tauext.config import require, require_seed

if TYPE_CHECKING:
    from tauext.cli.progress import ProgressBar


def demo(
    arm: Literal["rig", "seven"] = "rig",
    port: int = 8080,
    host: str = "127.0.0.1",
    seed: int = 0,
    open: bool = True,
    headless_seconds: float | None = None,
) -> None:
    """Push a simulated arm with the mouse; three methods estimate the push, and the arm reacts.

    Bundles are trained on first use, in about two minutes, and kept in $XDG_CACHE_HOME/tauext/demo. The page needs the
    extra tauext[live]; it loads nothing from the network.

    Args:
        arm: the paper's two-axis rig, or an arm of seven axes; the page can change it.
        port: port of the page; if it is in use, the next free one.
        host: address to listen on. 0.0.0.0: everyone in the network may push.
        seed: seed of motion, noise and training.
        open: open the page in a browser.
        headless_seconds: show no page; simulate so many seconds with scripted pushes, then a weight in the hand of the
            seven-axis arm, and print the results.
    """
    from tauext.page.bundles import cache_folder

    require_seed(seed)
    require(1 <= port <= 65535, "port", port, "1 to 65535")
    if headless_seconds is not None:
        require(0 < headless_seconds <= 3600, "headless_seconds", headless_seconds, "above 0, at most 3600")
        print(headless(arm, headless_seconds, seed))
        return
    from tauext.page.page import run_page

    with TrainingBar() as bar:
        run_page(arm, host, port, seed, cache_folder(), open, bar.report, lambda line: print(line, flush=True))


def headless(arm_name: str, seconds: float, seed: int) -> str:
    """Results of a run with scripted pushes, and with a weight in the hand if the arm has one."""
    from tauext.page.bundles import LESSONS, cache_folder, find_or_train_bundles
    from tauext.page.headless import carried_weights, describe, describe_weights, scripted_pushes
    from tauext.sim.arms import ARMS

    arm = ARMS[arm_name]()
    with TrainingBar() as bar:
        bundles = find_or_train_bundles(arm, "exact", LESSONS[arm_name], seed, cache_folder(), bar.report)
    pushes = describe(*scripted_pushes(arm, bundles, seconds, seed), arm)
    weights = describe_weights(carried_weights(arm, bundles, seed), arm, bundles)
    return f"{pushes}\n{weights}" if weights else pushes


class TrainingBar:
    """A progress bar that is there while something is trained."""

    def __init__(self) -> None:
        self._bar: ProgressBar | None = None

    def __enter__(self) -> TrainingBar:
        return self

    def report(self, share: float, what: str) -> None:
        """what = "": the training is over."""
        from tauext.cli.progress import ProgressBar

        if what and self._bar is None:
            self._bar = ProgressBar("first use: train")
            self._bar.__enter__()
        if self._bar is not None:
            self._bar.update(round(100 * share), 100, what or "done")
        if not what:
            self.__exit__()

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.__exit__(None, None, None)
            self._bar = None
