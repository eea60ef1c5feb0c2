"""Percentiles of times by a log-linear histogram of constant resolution, from 1 ns to 2.3 hours.

As in HdrHistogram: below 2^``BITS`` ns every value has its own bucket; above, each octave is
divided into 2^(``BITS`` - 1) buckets, so that a bucket is at most 1/64 of its value wide.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

BITS = 7
_HALF = 1 << (BITS - 1)
_OCTAVES = 36  # above the linear part
BUCKETS = (_OCTAVES + 2) * _HALF
RESOLUTION = 1 / _HALF  # largest width of a bucket relative to its lower end

SHARES = {"p50": 0.5, "p90": 0.9, "p99": 0.99, "p99_9": 0.999, "p99_99": 0.9999, "max": 1.0}
_BY_ROUND = [*SHARES.values()][:3]  # p50, p90, p99

Counts = NDArray[np.int64]


def histogram(times_ns: NDArray[np.int64]) -> Counts:
    """The histogram of times in ns, shape (BUCKETS,); those beyond count in the last bucket."""
    times = np.maximum(times_ns, 0)
    octave = np.maximum(np.frexp(times)[1] - BITS, 0)
    buckets = np.minimum(octave * _HALF + (times >> octave), BUCKETS - 1)
    return np.bincount(buckets, minlength=BUCKETS)


def lower_ends() -> NDArray[np.float64]:
    """Lower end of every bucket, and upper end of the last, ns; shape (BUCKETS + 1,)."""
    k = np.arange(BUCKETS + 1)
    octave = np.maximum(k // _HALF - 1, 0)
    return np.ldexp((k - octave * _HALF).astype(float), octave)


def middles() -> NDArray[np.float64]:
    """The time that stands for every bucket: its middle, ns, or the only whole number in it; shape
    (BUCKETS,)."""
    low, high = lower_ends()[:-1], lower_ends()[1:]
    return np.where(high - low == 1, low, (low + high) / 2)


def quantiles(counts: Counts, shares: Sequence[float]) -> list[float]:
    """Quantiles in ns for these shares (0 to 1), each of ``middles``: the smallest time of rank
    ceil(share n), as ``numpy.quantile`` with ``inverted_cdf``."""
    total = np.cumsum(counts)
    ranks = np.maximum(np.ceil(np.round(np.asarray(shares) * total[-1], 6)), 1)
    return [float(x) for x in middles()[np.searchsorted(total, ranks)]]


def sparse(counts: Counts) -> list[list[int]]:
    """[bucket, count] of all that are not empty, for JSON."""
    at = np.flatnonzero(counts)
    return np.column_stack([at, counts[at]]).tolist()


def dense(pairs: Sequence[Sequence[int]]) -> Counts:
    """The histogram from the output of ``sparse``."""
    counts = np.zeros(BUCKETS, np.int64)
    counts[[k for k, _ in pairs]] = [n for _, n in pairs]
    return counts


def bars(pairs: Sequence[Sequence[int]]) -> tuple[NDArray[np.float64], Counts]:
    """Those of ``middles`` whose buckets are not empty, and their counts, from the output of
    ``sparse``; at least one."""
    at, counts = np.transpose(pairs)
    return middles()[at], counts


def summary(rounds: Sequence[NDArray[np.int64]]) -> dict[str, Any]:
    """``summary_of_counts`` of rounds of times in ns; rounds without times are ignored."""
    return summary_of_counts([histogram(times) for times in rounds if len(times)])


def summary_of_counts(counts: Sequence[Counts]) -> dict[str, Any]:
    """``summarised`` of the histograms of rounds."""
    whole: Counts = np.sum(counts, axis=0, dtype=np.int64)
    return summarised(whole, [of_round(some) for some in counts])


def of_round(counts: Counts) -> list[float]:
    """What ``summarised`` needs of a round: p50, p90 and p99, ns."""
    return quantiles(counts, _BY_ROUND)


def summarised(whole: Counts, rounds: Sequence[Sequence[float]]) -> dict[str, Any]:
    """``n``, ``<percentile>_us``, ``rounds_p50_us`` and ``histogram`` of ``whole``, the histogram
    of all rounds, and of each ``of_round``.

    p50, p90 and p99 are medians over the rounds; from p99.9 on a round has too few times, so these
    percentiles and the histogram are of all rounds together. None stands for an unknown value.
    """
    if not rounds:
        unknown: dict[str, Any] = {f"{name}_us": None for name in SHARES}
        return unknown | {"n": 0, "rounds_p50_us": [], "histogram": []}
    values = [*np.median(rounds, axis=0), *quantiles(whole, [*SHARES.values()])[len(_BY_ROUND) :]]
    return {
        **{f"{key}_us": round(float(ns) / 1e3, 3) for key, ns in zip(SHARES, values, strict=True)},
        "n": int(whole.sum()),
        "rounds_p50_us": [round(p50 / 1e3, 4) for p50, *_ in rounds],
        "histogram": sparse(whole),
    }
