"""Share of unseen motion, and of motion like that of training, that `unfamiliar` reports.

    python benchmarks/coverage.py DATASET [--minutes 15] [--recordings 40] [--errors]

What training saw is fitted to a part of the DATASET's training motion, sample by sample: speeds of at most 60 % of the
largest, a joint's positions below their median, places of the last joint below the median of a coordinate. Told is then
a share of the test recordings' samples on the other side, beyond 1.15 times the largest speed that was kept. --errors
(some minutes) fits the prior to the same parts, too, and to all of the motion, and shows the RMSE of the one there over
that of the other, for every joint.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from common import arguments, head, table_row
from common import runs as all_runs

from tauext import _core
from tauext._core import Tree
from tauext.config import ObserverConfig, PriorConfig
from tauext.data.dataset import load_dataset
from tauext.data.free_motion import cut, first_seconds, free_pieces, free_samples, total_s
from tauext.data.recording import Recording
from tauext.fit.bundle_writing import build_setup
from tauext.fit.coverage import CoverageFit, fit_coverage
from tauext.fit.prior import fit_prior
from tauext.fit.training_set import Setup, with_presliding
from tauext.robot.read import load_tree

SLOW, BEYOND = 0.6, 1.15
LEAST_SAMPLES = 3
LEAST_S = 1.2
"""Of motion that a prior is fitted to, [s]: its filter warms up for half a second."""
Value = Callable[[Recording], np.ndarray]


def main() -> None:
    parser = arguments(__doc__, "dataset")
    parser.add_argument("--minutes", type=float, help="of training motion; all of it unless said")
    parser.add_argument("--recordings", type=int, default=40, help="test recordings, at most")
    parser.add_argument("--errors", action="store_true", help="of a prior that never saw such motion, too")
    options = parser.parse_args()
    dataset = load_dataset(options.dataset)
    training = free_pieces(dataset.training())
    if options.minutes:
        training = first_seconds(training, 60 * options.minutes)
    test = [load() for load in dataset.loaders("test")[: options.recordings]]
    tree = load_tree(dataset.robot_file(None), training[0].joints)
    setup = build_setup(tree, training[0], ObserverConfig())

    def line(name: str, value: Value, like: float, beyond: float) -> None:
        pieces = [cut(one, run) for one in training for run in runs(value(one) <= like, LEAST_SAMPLES)]
        cells = row(fit_coverage(setup, pieces), test, value, like, beyond)
        if options.errors:
            pieces = [piece for piece in pieces if piece.duration_s > LEAST_S]
            part = fit_prior(bent, pieces, PriorConfig()).settings
            ratio = rmse(bent, part, test, value, beyond) / rmse(bent, whole, test, value, beyond)
            cells.append(" ".join(f"{joint:.1f}" for joint in ratio))
        print(table_row(name, f"{total_s(pieces) / 60:.1f}", *cells), flush=True)

    bent = with_presliding(setup, PriorConfig().widths_rad)
    whole = fit_prior(bent, training, PriorConfig()).settings if options.errors else None

    columns = "unfamiliar | training, min | reach, rad | together, rad | reported there | reported in similar motion"
    print("\n".join(head(columns + " | RMSE there, ratio" * options.errors)))
    largest = np.max([np.abs(one.dq).max(axis=0) for one in training], axis=0)
    slow = [np.abs(one.dq[(np.abs(one.dq) <= SLOW * largest).all(axis=1)]).max(axis=0) for one in training]
    line("nothing", lambda one: np.zeros(one.samples), 0, -1)
    line("speed", over(np.max(slow, axis=0)), 1.0, BEYOND)
    for name, value in halves(tree).items():
        values = np.concatenate([value(one) for one in training])
        if np.ptp(values) > 0.1:  # a planar arm stays in its plane
            line(f"half of {name}", value, *[float(np.median(values))] * 2)


def rmse(
    setup: Setup, prior: _core.PriorSettings, test: Sequence[Recording], value: Value, beyond: float
) -> np.ndarray:
    """What a prior leaves of r in free motion where the value is beyond, (n,), [N m]."""
    left = []
    for one in test:
        said = _core.observe(setup.tree, setup.observer, one.t_ns, one.q, one.dq, one.tau, prior)
        left.append((said.residual - said.prior)[said.warm.astype(bool) & free_samples(one) & (value(one) > beyond)])
    return np.sqrt((np.concatenate(left) ** 2).mean(axis=0))


def over(largest: np.ndarray) -> Value:
    """Largest speed of all joints, as a share of these."""
    return lambda one: (np.abs(one.dq) / largest).max(axis=1)


def halves(tree: Tree) -> dict[str, Value]:
    """What a workspace can be halved by."""
    found: dict[str, Value] = {f"joint {j + 1}": lambda one, j=j: one.q[:, j] for j in range(min(tree.size, 3))}
    found["joints 1 and 2 summed"] = lambda one: one.q[:, 0] + one.q[:, 1]
    for k, axis in enumerate("xyz"):
        found[f"the last joint's place along {axis}"] = lambda one, k=k: last_place(tree, one.q)[:, k]
    return found


def last_place(tree: Tree, q: np.ndarray) -> np.ndarray:
    """Where the last joint of a serial arm of turning joints is, (samples, 3), [m]."""
    turned, place = np.broadcast_to(np.eye(3), (len(q), 3, 3)), np.zeros((len(q), 3))
    for angle, link in zip(q.T, tree.links, strict=True):
        place = place + turned @ np.array(link.translation)
        about_z = np.zeros((len(q), 3, 3))
        about_z[:, 0, 0] = about_z[:, 1, 1] = np.cos(angle)
        about_z[:, 1, 0] = np.sin(angle)
        about_z[:, 0, 1] = -about_z[:, 1, 0]
        about_z[:, 2, 2] = 1
        turned = turned @ np.array(link.rotation).reshape(3, 3) @ about_z
    return place


def runs(kept: np.ndarray, least: int) -> list[slice]:
    """Samples in a row that are kept, at least so many."""
    return [slice(begin, end) for begin, end in all_runs(kept) if end - begin >= least]


def row(fit: CoverageFit, test: Sequence[Recording], value: Value, like: float, beyond: float) -> list[str]:
    """Reaches, and what is told."""
    settings = fit.settings

    def told(chosen: list[np.ndarray]) -> str:
        number = of = 0
        for recording, at in zip(test, chosen, strict=True):
            said = settings.look(np.ascontiguousarray(recording.q[at]), np.ascontiguousarray(recording.dq[at]))
            number, of = number + int((said["share"] >= settings.WORTH_TELLING).sum()), of + len(at)
        return f"{number / of:.1%}" if of else "-"

    sizes = [np.where(free_samples(one), value(one), np.nan) for one in test]
    there, alike = (
        [np.flatnonzero(one) for one in of] for of in ([s > beyond for s in sizes], [s <= like for s in sizes])
    )
    reach = np.array(settings.span_rad) / settings.CELLS * settings.reach
    together = 2 * np.pi / settings.PAIR_CELLS * settings.reach_together
    return [f"{reach.min():.2f} to {reach.max():.2f}", f"{together:.2f}", told(there), told(alike)]


if __name__ == "__main__":
    main()
