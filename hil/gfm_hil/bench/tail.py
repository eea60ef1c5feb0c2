"""How sure a percentile is, and what lies beyond the data, from the histogram of many times."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.stats import binom

from gfm_hil.bench.histogram import SHARES, Counts, lower_ends, quantiles

_SURE = 0.95
_EXCEED, _FEWEST = 1e-3, 50  # share of the times from which on the tail is fitted, at least so many
_BEYOND = (10, 100)  # times as many exchanges as were measured


def _ranks(n: int, share: float) -> tuple[int, int]:
    """The order statistics of n independent values between which the quantile lies with 95 %, by
    the binomial distribution (H. A. David and H. N. Nagaraja, *Order Statistics*, 7.1). The first
    is 0 or the second n + 1 where the values end before."""
    low, high = binom.ppf([(1 - _SURE) / 2, (1 + _SURE) / 2], n, share)
    return int(low), int(high) + 1


def median_interval(values: Sequence[float]) -> tuple[float, float]:
    """Between which values the median of their distribution lies with 95 %; fewer than 6 values
    give the least and the greatest, with less than that."""
    n, ordered = len(values), sorted(values)
    low, high = _ranks(n, 0.5)
    return ordered[max(low, 1) - 1], ordered[min(high, n) - 1]


def confidence(counts: Counts) -> dict[str, list[float | None]]:
    """The interval of each percentile of ``SHARES`` but the largest time, µs, with 95 %; None where
    the data end before. Times count as independent."""
    n, found = int(counts.sum()), {}
    for name, share in SHARES.items():
        if share < 1.0 and n:
            ranks = _ranks(n, share)
            ends = quantiles(counts, [min(max(rank, 1), n) / n for rank in ranks])
            inside = ranks[0] >= 1, ranks[1] <= n
            found[f"{name}_us_95"] = [
                round(end / 1e3, 3) if known else None
                for end, known in zip(ends, inside, strict=True)
            ]
    return found


def beyond(counts: Counts) -> dict[str, Any] | None:
    """An estimate of what lies beyond the data: a generalised Pareto distribution of the largest
    thousandth (J. Pickands, Annals of Statistics 3, 1975), by maximum likelihood; None if these are
    fewer than 50.

    Returns:
        ``threshold_us``, ``scale_us``, ``shape``, ``fitted`` (how many times), and ``estimates``:
        [how many exchanges, the time that one of them exceeds, µs].
    """
    n, ends = int(counts.sum()), lower_ends()
    (threshold,) = quantiles(counts, [1 - _EXCEED]) if n else (0.0,)
    at = np.flatnonzero(counts * (ends[:-1] > threshold))
    weights, over = counts[at], (ends[at] + ends[at + 1]) / 2 - threshold
    fitted = int(weights.sum())
    if fitted < _FEWEST:
        return None
    shape, scale = _fit(over, weights)
    estimates = [
        [times * n, round((threshold + _level(shape, scale, times * fitted)) / 1e3, 1)]
        for times in _BEYOND
    ]
    return {
        "threshold_us": round(threshold / 1e3, 3), "scale_us": round(scale / 1e3, 3),
        "shape": round(shape, 3), "fitted": fitted, "estimates": estimates,
    }  # fmt: skip


def _fit(over: Sequence[float] | np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    """Shape and scale of the generalised Pareto distribution of weighted excesses."""
    mean = float(np.average(over, weights=weights))
    x = np.asarray(over) / mean

    def cost(p: np.ndarray) -> float:
        shape, scale = p[0], np.exp(p[1])
        inside = 1 + shape * x / scale
        if inside.min() <= 0:
            return np.inf
        if abs(shape) < 1e-6:
            return float(weights @ (np.log(scale) + x / scale))
        return float(weights @ (np.log(scale) + (1 + 1 / shape) * np.log(inside)))

    best = minimize(cost, [0.1, 0.0], method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-6})
    return float(best.x[0]), float(mean * np.exp(best.x[1]))


def _level(shape: float, scale: float, times: float) -> float:
    """The excess that one in so many excesses exceeds."""
    if abs(shape) < 1e-6:
        return float(scale * np.log(times))
    return float(scale / shape * (times**shape - 1))
