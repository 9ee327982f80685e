"""Which link of a standing Panda people touched: our estimate and the robot's own, link by link.

    python benchmarks/panda_touches.py DATASET BUNDLE OUT

DATASET: the panda_mindlab recordings as `benchmarks/real_arms.py` imports them (runs/real-arms/panda/data; a file a
link, with labels and the robot's own estimate). BUNDLE: its bundles/bandpass.tauext. OUT gets README.md. Nothing is
tuned here: errors are those of the samples without a touch, shapes those of the simulated Panda.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from unseen.surfaces import SURFACES, capsules_of

from tauext import _core
from tauext.data import Recording, load_recording

TOUCHED = {"a4": 7, "a6": 7, "b8": 6, "b9": 6, "c3": 5, "d3": 4, "f2": 2, "f4": 2}
"""Link that people touched in each recording, from 1."""
FREE_S = 0.15
"""From a label: samples nearer to it are neither touched nor free."""
LATE_S = 0.1
"""Labels begin up to so long before a touch shows."""
OWN_SHOWS = 3.0
"""Standard errors from which on the touched link's own joint shows a touch."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name in ("dataset", "bundle", "out"):
        parser.add_argument(name, type=Path)
    options = parser.parse_args()
    bundle = _core.Bundle.load(str(options.bundle))
    recordings = {name: load_recording(options.dataset / f"{name}.parquet") for name in TOUCHED}
    estimates = {"tauext": {}, "the robot's own": {}}
    for name, one in recordings.items():
        said = _core.estimate(bundle, one.t_ns, one.q, one.dq, one.tau, 1)["tau_ext"]
        estimates["tauext"][name] = said
        estimates["the robot's own"][name] = one.tau_ext
    tables = {by: table_of(bundle, recordings, told) for by, told in estimates.items()}
    options.out.mkdir(parents=True, exist_ok=True)
    text = markdown(tables)
    (options.out / "README.md").write_text(text)
    print(text)


def touches_of(recording: Recording) -> list[slice]:
    """Rows of each labelled touch, from its label to LATE_S after it."""
    label = np.asarray(recording.contact) > 0
    edges = np.flatnonzero(np.diff(np.r_[0, label.astype(int), 0]))
    late = round(LATE_S * recording.rate_hz)
    return [slice(int(a), int(b) + late) for a, b in edges.reshape(-1, 2)]


def free_rows(recording: Recording) -> np.ndarray:
    """Of samples that no touch is near."""
    label = np.asarray(recording.contact) > 0
    reach = round(FREE_S * recording.rate_hz)
    near = np.convolve(label, np.ones(2 * reach + 1), "same") > 0
    near[: 2 * reach] = True  # the observer begins
    return ~near


def table_of(bundle: _core.Bundle, recordings: dict[str, Recording], told: dict[str, np.ndarray]) -> dict:
    free = np.concatenate([told[name][free_rows(one)] for name, one in recordings.items()])
    sigma = np.sqrt(np.nanmean(free**2, axis=0))
    bundle.capsules = capsules_of(SURFACES["panda"])
    scale = _core.ErrorScaleSettings()  # the bundle has none: these are its errors
    scale.features = [_core.MotionFeature.constant]
    scale.limit_weights = scale.largest = [1.0] * bundle.joints
    scale.sigma_weights = scale.sigma_near_weights = scale.largest_sigma = sigma.tolist()
    bundle.error_scale = scale
    model = _core.PlaceModel(bundle)
    assert not model.refused, model.refused
    confusion, two, stated, sure, own = np.zeros((7, 7), dtype=int), 0, 0, 0, 0
    for name, recording in recordings.items():
        touched = TOUCHED[name] - 1
        for rows in touches_of(recording):
            tau = told[name][rows]
            strength = np.square(tau / sigma).sum(axis=1)
            if not np.isfinite(strength).any():
                continue
            at = int(np.nanargmax(strength))
            found = model.find(recording.q[rows][at].tolist(), tau[at].tolist(), sigma.tolist(), places=False)
            confusion[touched, found.ranked[0]] += 1
            two += touched in found.ranked[:2]
            if found.probability[found.ranked[0]] >= 0.9:
                stated, sure = stated + 1, sure + (found.ranked[0] == touched)
            own += abs(tau[at, touched]) >= OWN_SHOWS * sigma[touched]
    return {"confusion": confusion, "two": two, "stated": stated, "sure": sure, "own": own, "sigma": sigma}


def markdown(tables: dict[str, dict]) -> str:
    text = """# Touches on a standing Panda

Written by `python benchmarks/panda_touches.py DATASET BUNDLE OUT`: hand touches of
[tactileGestureDetection](https://github.com/MindLabZHAW/tactileGestureDetection) (MIT), 0.3 to 0.7 s each, one link a
file, no force known; the arm stands in one pose. Bundle of recipe bandpass, which needs no motion, from three of the
files; errors are those between touches. Shapes are cylinders of the simulated Panda. No bar is set here, and nothing
was tuned: a touch in line with an axis, or near one, leaves no trace that says on which side of it it was.

"""
    for by, one in tables.items():
        confusion = one["confusion"]
        count, right = confusion.sum(), np.trace(confusion)
        text += f"## {by[0].upper()}{by[1:]}\n\n"
        text += (
            f"{right} of {count} on the link that was touched, {one['two']} among the first two. A link was stated "
            f"with 90% or more {one['stated']} times, {one['sure']} of them right. At {one['own']} of {count} touches "
            "the touched link's own joint shows three standard errors.\n\n"
        )
        text += "| touched | " + " | ".join(str(k + 1) for k in range(7)) + " |\n" + "|---" * 8 + "|\n"
        for k in sorted(set(TOUCHED.values())):
            text += f"| {k} | " + " | ".join(str(n) if n else "" for n in confusion[k - 1]) + " |\n"
        text += "\n"
    return text


if __name__ == "__main__":
    main()
