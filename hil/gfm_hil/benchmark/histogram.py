"""Log-linear histogram of times: constant relative resolution from 1 ns to 2.3 hours.

As in HdrHistogram: below 2^``BITS`` ns every value has its own bucket; above, each octave is
divided into 2^(``BITS`` - 1) buckets, so that a bucket is at most 1/64 of its value wide.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gfm_runtime.compiled import cached

BITS = 7
_HALF = 1 << (BITS - 1)
_OCTAVES = 36  # above the linear part
BUCKETS = (_OCTAVES + 2) * _HALF
RESOLUTION = 1 / _HALF  # largest width of a bucket relative to its lower end

Counts = NDArray[np.int64]


@cached
def record(counts, times_ns):
    """Count every time of ``times_ns`` (n,) in ``counts`` (BUCKETS,); longer ones in the last."""
    for t in times_ns:
        v, octave = max(t, 0), 0
        while v >= 2 * _HALF:
            v >>= 1
            octave += 1
        counts[min(octave * _HALF + v, BUCKETS - 1)] += 1


def histogram(times_ns: NDArray[np.int64]) -> Counts:
    """A new histogram of times in ns."""
    counts = np.zeros(BUCKETS, np.int64)
    record(counts, times_ns)
    return counts


def lower_ends() -> NDArray[np.float64]:
    """Lower end of every bucket, and upper end of the last, ns; shape (BUCKETS + 1,)."""
    k = np.arange(BUCKETS + 1)
    octave = np.maximum(k // _HALF - 1, 0)
    return np.ldexp((k - octave * _HALF).astype(float), octave)


def quantiles(counts: Counts, shares: Sequence[float]) -> list[float]:
    """Quantiles in ns for these shares (0 to 1), each the middle of a bucket.

    The smallest time of rank ceil(share n), as ``numpy.quantile`` with ``inverted_cdf``.
    """
    total = np.cumsum(counts)
    ranks = np.maximum(np.ceil(np.round(np.asarray(shares) * total[-1], 6)), 1)
    ends = lower_ends()
    at = np.searchsorted(total, ranks)
    whole = ends[at + 1] - ends[at] == 1  # a bucket of one nanosecond holds one value
    return [float(x) for x in np.where(whole, ends[at], (ends[at] + ends[at + 1]) / 2)]


def sparse(counts: Counts) -> list[list[int]]:
    """[bucket, count] of all non-empty buckets, for JSON."""
    at = np.flatnonzero(counts)
    return [[int(k), int(counts[k])] for k in at]


def dense(pairs: Sequence[Sequence[int]]) -> Counts:
    """The histogram from the output of ``sparse``."""
    counts = np.zeros(BUCKETS, np.int64)
    for k, n in pairs:
        counts[k] = n
    return counts
