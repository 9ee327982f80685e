r"""What an alarm with a hold time sees of an error: the least of the last samples.

An alarm rises at sample k when |tau_ext| of a joint has been over its limit L without a break since a sample that is
`hold_s` old or older. So it rises over L exactly where the held minimum does:

.. math:: m(t_k) = \min_{s \le j \le k} |\tau_{ext}(t_j)|, \quad s = \max\{j : t_j \le t_k - hold\}, \qquad m(t_k) > L

and m stands for |tau_ext| in everything that is said of limits. With no hold time m is |tau_ext| itself.
"""

from __future__ import annotations

import numpy as np

from tauext.errors import ConfigError


def held_minimum(tau_abs: np.ndarray, healthy: np.ndarray, hold_samples: int | np.ndarray) -> np.ndarray:
    """m of every sample: the least |tau_ext| of the last hold_samples + 1 samples, (samples,), [N m]; exact.

    NaN where one of them is unhealthy or NaN, or would lie before the first: no alarm can rise there.

    Args:
        tau_abs: |tau_ext| of one joint, (samples,), [N m].
        healthy: (samples,), bool.
        hold_samples: one number for all samples, or one for each, (samples,), as `hold_lengths` gives.

    Raises:
        ConfigError: shapes that differ, or hold_samples < 0.
    """
    tau_abs, healthy, hold = np.asarray(tau_abs, dtype=float), np.asarray(healthy, dtype=bool), np.asarray(hold_samples)
    if tau_abs.ndim != 1 or healthy.shape != tau_abs.shape or hold.shape not in ((), tau_abs.shape):
        raise ConfigError(
            f"held minimum: |tau_ext|, healthy and hold_samples have shapes {tau_abs.shape}, {healthy.shape} and "
            f"{hold.shape}; they must be one and the same (samples,)"
        )
    if (hold < 0).any():
        raise ConfigError(f"hold_samples = {hold.min()} must be >= 0")
    least = np.full(len(tau_abs), -np.inf)
    over = np.where(healthy & ~np.isnan(tau_abs), tau_abs, -np.inf)
    length = _one_length(hold)
    if length is not None:
        least[length:] = _over_windows(over, length + 1)
    else:
        last = np.arange(len(tau_abs))
        first = last - hold
        whole = first >= 0
        least[whole] = _over_ranges(over, first[whole], last[whole])
    return np.where(np.isneginf(least), np.nan, least)


def hold_lengths(t_ns: np.ndarray, hold_s: float) -> np.ndarray:
    """Samples back to the youngest that is hold_s old or older, (samples,), int64; k + 1, one too many, if none is.

    From stamps and not from a rate, as in the alarm: where samples are missing, fewer of them fill the same time.

    Args:
        t_ns: sample times, increasing, (samples,), [ns].
    """
    so_far, hold_ns, steps = np.arange(1, len(t_ns) + 1), round(hold_s * 1e9), np.diff(t_ns)
    if len(steps) and (steps == steps[0]).all():  # nothing to search for in a regular recording
        return np.minimum(so_far, -(-hold_ns // int(steps[0])))
    return so_far - np.searchsorted(t_ns, t_ns - hold_ns, side="right")


def _one_length(hold: np.ndarray) -> int | None:
    """The hold time in samples where all samples have the same, but for those that reach before the first one."""
    if hold.ndim == 0:
        return int(hold)
    length = int(hold[-1]) if len(hold) else 0
    return length if (hold == np.minimum(np.arange(1, len(hold) + 1), length)).all() else None


def _over_windows(values: np.ndarray, samples: int) -> np.ndarray:
    """Least of each `samples` values in a row, (len(values) - samples + 1 or 0,), as two overlapping blocks of 2^p."""
    if samples > len(values):
        return np.zeros(0)
    power, table = samples.bit_length() - 1, values
    for p in range(power):
        table = np.minimum(table[: -(2**p)], table[2**p :])
    rest = samples - 2**power
    return np.minimum(table[:-rest], table[rest:]) if rest else table


def _over_ranges(values: np.ndarray, first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Least of values[first..last] for each pair of indices, first <= last, as two overlapping blocks of 2^p values.

    Memory of one block size at a time; O(samples log of the longest range).
    """
    power = np.frexp(last - first + 1)[1] - 1
    out = np.empty(len(first))
    table = values  # table[i] = min(values[i .. i + 2^p - 1])
    for p in range(int(power.max(initial=-1)) + 1):
        if p:
            half = 2 ** (p - 1)
            table = np.minimum(table[:-half], table[half:])
        now = power == p
        out[now] = np.minimum(table[first[now]], table[last[now] - 2**p + 1])
    return out
