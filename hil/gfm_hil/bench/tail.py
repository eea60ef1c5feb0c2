"""How sure a percentile is, and what lies beyond the data, from the histogram of many times."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.stats import binom, genpareto

from gfm_hil.bench.histogram import SHARES, Counts, bars, quantiles, sparse

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
    n, intervals = int(counts.sum()), {}
    for name, share in SHARES.items():
        if share < 1.0 and n:
            ranks = _ranks(n, share)
            ends = quantiles(counts, [min(max(rank, 1), n) / n for rank in ranks])
            intervals[f"{name}_us_95"] = [
                round(end / 1e3, 3) if 1 <= rank <= n else None
                for rank, end in zip(ranks, ends, strict=True)
            ]
    return intervals


def beyond(counts: Counts) -> dict[str, Any] | None:
    """An estimate of what lies beyond the data: a generalised Pareto distribution of the largest
    thousandth (J. Pickands, Annals of Statistics 3, 1975), by maximum likelihood; None if these are
    fewer than 50.

    Returns:
        ``threshold_us``, ``scale_us``, ``shape``, ``fitted`` (how many times), and ``estimates``:
        [how many exchanges, the time that one of them exceeds, µs].
    """
    n = int(counts.sum())
    if n * _EXCEED < _FEWEST:
        return None
    (threshold,) = quantiles(counts, [1 - _EXCEED])
    middles, weights = bars(sparse(counts))
    above = middles > threshold
    over, weights = middles[above] - threshold, weights[above]
    fitted = int(weights.sum())
    if fitted < _FEWEST:
        return None
    mean = float(np.average(over, weights=weights))

    def cost(p: np.ndarray) -> float:
        return -float(weights @ genpareto.logpdf(over / mean, p[0], scale=np.exp(p[1])))

    best = minimize(cost, [0.1, 0.0], method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-6})
    shape, scale = float(best.x[0]), float(mean * np.exp(best.x[1]))
    levels = threshold + genpareto.isf(1 / np.multiply(_BEYOND, fitted), shape, scale=scale)
    estimates = [
        [times * n, round(ns / 1e3, 1)] for times, ns in zip(_BEYOND, levels.tolist(), strict=True)
    ]
    return {
        "threshold_us": round(threshold / 1e3, 3), "scale_us": round(scale / 1e3, 3),
        "shape": round(shape, 3), "fitted": fitted, "estimates": estimates,
    }  # fmt: skip
