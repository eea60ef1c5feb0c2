"""Two results side by side: which differences are real, which are noise.

The Mann-Whitney test compares the rounds of a row in A and in B by rank; it assumes nothing about
the distribution of times. Of many rows some differ by chance, so Holm's method corrects the p
values for their number.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import combinations
from statistics import NormalDist, median
from typing import Any

import numpy as np

from gfm_hil.bench.tables import Table, lockstep_name, times
from gfm_hil.core.errors import UserError

BELIEVED = 0.05  # limit of a corrected p value
_EXACT = 200_000  # most orders counted one by one; beyond, use the normal approximation


def rank_test(a: Sequence[float], b: Sequence[float]) -> float:
    """p value of the two-sided Mann-Whitney test, ties at their mean rank.

    If there are few, it counts all assignments of the ranks, and so is exact with ties too; else it
    uses the normal approximation with the corrections for ties and continuity.
    """
    n, m = len(a), len(b)
    both = np.asarray([*a, *b], float)
    ranks = np.array([(both < x).sum() + (1 + (both == x).sum()) / 2 for x in both])
    mean = n * (n + m + 1) / 2
    distance = abs(ranks[:n].sum() - mean)
    if math.comb(n + m, n) <= _EXACT:
        sums = np.array([sum(some) for some in combinations(ranks.tolist(), n)])
        return float(np.mean(np.abs(sums - mean) >= distance - 1e-9))
    _, ties = np.unique(both, return_counts=True)
    shrink = 1 - float((ties**3 - ties).sum()) / ((n + m) ** 3 - (n + m))
    sigma = math.sqrt(n * m * (n + m + 1) / 12 * shrink)
    if sigma == 0:
        return 1.0
    return min(1.0, 2 * (1 - NormalDist().cdf(max(distance - 0.5, 0.0) / sigma)))


def holm(p_values: Sequence[float]) -> list[float]:
    """The p values corrected for their number."""
    corrected, greatest = [0.0] * len(p_values), 0.0
    for k, at in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        greatest = max(greatest, min(1.0, (len(p_values) - k) * p_values[at]))
        corrected[at] = greatest
    return corrected


def compare(a: dict[str, Any], b: dict[str, Any], by_limit: bool) -> list[dict[str, Any]]:
    """One row per quantity that both results have, B over A.

    Args:
        a, b: results.
        by_limit: if both have ratios to the limit in C, compare these instead of times.

    Raises:
        UserError: they have nothing in common.
    """
    ours, theirs = (dict(_samples(content, by_limit)) for content in (a, b))
    names = [name for name in ours if name in theirs and ours[name][0] == theirs[name][0]]
    if not names:
        raise UserError("A and B have no row in common: the same `gfmhil bench` must be run twice")
    pairs = [(ours[name][1], theirs[name][1]) for name in names]
    corrected = holm([rank_test(*pair) for pair in pairs])
    rows = []
    for name, (x, y), p in zip(names, pairs, corrected, strict=True):
        # the smallest p possible with this number of rounds, corrected as the smallest of all rows
        reach = 2 / math.comb(len(x) + len(y), len(x)) * len(names)
        real = p < BELIEVED
        rows.append(
            {
                "row": name,
                "unit": ours[name][0],
                "a": median(x),
                "b": median(y),
                "ratio": median(y) / median(x),
                "rounds": [len(x), len(y)],
                "p": p,
                "verdict": "real change"
                if real
                else ("noise" if reach < BELIEVED else "too few rounds to tell"),
            }
        )
    return rows


def comparison_table(rows: list[dict[str, Any]]) -> Table:
    """The rows as a table for display."""
    return Table(
        "B and A: medians of rounds, p of the rank test corrected for the number of rows",
        ("", "A", "B", "unit", "B : A", "p", "verdict"),
        [
            (
                r["row"], f"{r['a']:.4g}", f"{r['b']:.4g}", r["unit"], times(r["ratio"], ""),
                f"{r['p']:.2g}", r["verdict"],
            )
            for r in rows
        ],
    )  # fmt: skip


def _samples(
    content: dict[str, Any], by_limit: bool
) -> Iterator[tuple[str, tuple[str, list[float]]]]:
    """(row, (unit, value of each round))."""
    for r in content["results"]:
        name = f"{r['name']}, {r['mode']}, {r['load']}, {r['policy']}, {r['payload']} B"
        if by_limit and r["peer"] != "C" and r["rounds_ratio"]:
            yield f"latency: {name}", ("× limit", r["rounds_ratio"])
        elif r["rounds_p50_us"]:
            yield f"latency: {name}", ("µs", r["rounds_p50_us"])
    for r in content.get("jitter", ()):
        yield f"jitter: {r['wait']}, {r['load']}, {r['policy']}", ("µs", r["rounds_p50_us"])
    loop = content.get("loop", {})
    for r in loop.get("lockstep", ()):
        yield f"lockstep: {lockstep_name(r)}", ("ticks/s", r["ticks_per_s"]["turns"])
    for r in loop.get("laws", ()):
        yield f"loop in process: {r['law']}", ("ns", r["whole_ns"]["turns"])
    for r in loop.get("realtime", ()):
        if r["rounds_p50_us"]:
            yield f"real time: {r['link']}, {r['load']}", ("µs", r["rounds_p50_us"])
    for r in content.get("kernel", ()):
        if by_limit and r["ratio"]:
            yield f"kernel: {r['law']}, {r['real']}", ("× C", r["ratio"]["turns"])
        else:
            yield f"kernel: {r['law']}, {r['real']}", ("ns", r["numba_ns"]["turns"])
