"""Percentiles of several interleaved rounds of one measurement.

p50, p90 and p99 are medians over the rounds; from p99.9 on a round has too few times, so these
percentiles and the histogram are of all rounds together.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.benchmark.histogram import Counts, histogram, quantiles, sparse

SHARES = {"p50": 0.5, "p90": 0.9, "p99": 0.99, "p99_9": 0.999, "p99_99": 0.9999, "max": 1.0}
_BY_ROUND = ("p50", "p90", "p99")

REST = 0.15  # of a round: the kernel takes 5 % of each second from SCHED_FIFO that only spins


def summary(rounds: Sequence[NDArray[np.int64]]) -> dict[str, Any]:
    """``n``, ``<percentile>_us``, ``rounds_p50_us`` and ``histogram`` of rounds of times in ns.

    Rounds without times are ignored; None stands for an unknown value.
    """
    counts = [histogram(times) for times in rounds if len(times)]
    found: dict[str, Any] = {f"{name}_us": None for name in SHARES}
    found |= {"n": 0, "rounds_p50_us": [], "histogram": []}
    if not counts:
        return found
    each = np.array([quantiles(some, list(SHARES.values())) for some in counts]) / 1e3
    whole: Counts = np.sum(counts, axis=0)
    over_all = np.array(quantiles(whole, list(SHARES.values()))) / 1e3
    for k, name in enumerate(SHARES):
        value = np.median(each[:, k]) if name in _BY_ROUND else over_all[k]
        found[f"{name}_us"] = round(float(value), 3)
    found["n"] = int(whole.sum())
    found["rounds_p50_us"] = [round(float(x), 4) for x in each[:, 0]]
    found["histogram"] = sparse(whole)
    return found
