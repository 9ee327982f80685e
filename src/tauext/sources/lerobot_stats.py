"""Statistics that LeRobot keeps of a feature, of an episode and of the whole dataset, for the labels' columns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
Stats = dict[str, np.ndarray]


def episode_stats(values: np.ndarray) -> Stats:
    """min, max, mean, std, count and quantiles of the columns of one episode, (frames, columns).

    Quantiles are values that occur, since a flag has nothing in between; LeRobot reads its own off a histogram.
    """
    values = values.astype(np.float64)
    stats = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
    quantiles = np.quantile(values, list(QUANTILES.values()), axis=0, method="inverted_cdf")
    return stats | {"count": np.array([len(values)])} | dict(zip(QUANTILES, quantiles, strict=True))


def dataset_stats(episodes: Sequence[Stats]) -> Stats:
    """Of all episodes, as LeRobot merges them: means and variances by their counts, quantiles as means of quantiles."""
    count = np.array([stats["count"][0] for stats in episodes], dtype=np.float64)[:, None]
    stacked = {key: np.stack([stats[key] for stats in episodes]) for key in episodes[0] if key != "count"}
    mean = (stacked["mean"] * count).sum(0) / count.sum()
    variance = ((stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2) * count).sum(0) / count.sum()
    merged = {"min": stacked["min"].min(0), "max": stacked["max"].max(0), "mean": mean, "std": np.sqrt(variance)}
    quantiles = {key: (stacked[key] * count).sum(0) / count.sum() for key in QUANTILES}
    return merged | {"count": np.array([int(count.sum())])} | quantiles


def put_stats(held: dict[str, list] | None, stats: Stats, places: Sequence[int], columns: Sequence[int]) -> dict:
    """The statistics of a feature with those of these columns at their places; those of its other elements stay.

    Args:
        held: what there is of the feature; None: it is new, and has all kinds.
    """
    kinds = [key for key in held if key in stats] if held else list(stats)
    made: dict[str, list] = dict(held) if held else {}
    for kind in kinds:
        if kind == "count":
            made[kind] = [int(stats[kind][0])]
            continue
        listed = list(made.get(kind) or [])
        listed += [0.0] * (max(places) + 1 - len(listed))
        for place, column in zip(places, columns, strict=True):
            listed[place] = float(stats[kind][column])
        made[kind] = listed
    return made
