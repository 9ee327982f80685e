"""The whole chain on simulated arms as an integrator meets them: motor currents, a wrong URDF or none, contacts.

    python benchmarks/unseen_arms.py MODELS OUT [--fresh] [--arms ur5 panda ...] [--recipes prior friction] [--seed 0]

Without --fresh the arms are those that the method may be fixed on: ur5, panda, kinova and seven_axis. --fresh adds
palletizer, offset_wrist and light_arm. Run them once, after the method is final; their numbers have a section of their
own. --arms selects any of the seven instead.

MODELS: folder of ur5_robot.urdf, panda.urdf and kinova.urdf. OUT/ARM gets csv/ with the recordings and the truth, the
datasets urdf/ and none/, bundles and results; existing recordings, datasets and bundles are used again.
OUT/README.md gets the tables of docs/results/unseen-arms.
"""

from __future__ import annotations

import os
from pathlib import Path

from common import arguments, tauext, write_page
from unseen.arms import Maker, fresh_makers, makers
from unseen.recordings import description, import_csv, simulate_takes
from unseen.results import markdown, read_outcomes

MODELS = {"urdf": True, "none": False}


def main() -> None:
    parser = arguments(__doc__, "models", "out")
    parser.add_argument("--arms", nargs="+", help="of all seven, instead of those that --fresh decides on")
    parser.add_argument("--fresh", action="store_true", help="also the arms that are run once, when all is fixed")
    parser.add_argument("--recipes", nargs="+", default=["prior", "friction"])
    parser.add_argument("--seed", type=int, default=0, help="of the arms, their motion and their contacts")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    options = parser.parse_args()
    known = makers(options.models) | fresh_makers()
    arms = options.arms or [name for name, maker in known.items() if options.fresh or not maker.fresh]
    for name in arms:
        if name not in known:
            parser.error(f"--arms {name}: must be of {', '.join(known)}")
        if not known[name].model.is_file():
            parser.error(f"{known[name].model}: there is no such file; MODELS is the folder of the arms' URDFs")
    outcomes = []
    for name in arms:
        folder = options.out / name
        make(known[name], folder, options.seed, options.workers)
        for model in MODELS:
            judge(folder, model, options.recipes)
            outcomes += read_outcomes(known[name], options.seed, model, folder)
    text = markdown(outcomes, f"python benchmarks/unseen_arms.py MODELS OUT{' --fresh' * options.fresh}")
    write_page(options.out / "README.md", text)


def make(maker: Maker, folder: Path, seed: int, workers: int) -> None:
    """Simulate every take of an arm and import it twice, with its URDF and without a model; not what is there."""
    if all((folder / name).is_dir() for name in MODELS):
        return
    files = simulate_takes(maker, seed, folder / "csv", workers=workers)
    for name, model in MODELS.items():
        if not (folder / name).is_dir():
            import_csv(description(maker, seed, model), files, folder / "csv" / f"arm-{name}.toml", folder / name)


def judge(folder: Path, model: str, recipes: list[str]) -> None:
    """Check, train and evaluate as a user would, each command's words beside its results."""
    data, how = folder / model, [] if MODELS[model] else ["--case", "none"]
    tauext("check", "--data", data, printed=folder / f"check-{model}.txt", accept=(0, 1))
    bundles = [folder / f"{model}-{recipe}.tauext" for recipe in recipes]
    for recipe, bundle in zip(recipes, bundles, strict=True):
        if not bundle.exists():
            printed = folder / f"train-{model}-{recipe}.txt"
            tauext("train", "--data", data, "--recipe", recipe, "--out", bundle, *how, printed=printed)
    results, printed = folder / f"results-{model}", folder / f"evaluate-{model}.txt"
    tauext("evaluate", "--data", data, "--out", results, "--bundles", *bundles, printed=printed)


if __name__ == "__main__":
    main()
