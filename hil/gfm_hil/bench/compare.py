"""Two results side by side, of two installations measured alternately if need be: which
differences are real, which are noise.

The Mann-Whitney test compares the rounds of a row in A and in B by rank; it assumes nothing about
the distribution of times. Of many rows some differ by chance, so Holm's method corrects the p
values for their number.
"""

import json
import math
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from scipy.stats import mannwhitneyu, rankdata

from gfm_hil.bench.options import KINDS
from gfm_hil.bench.result import check_result, rows_of, write_result
from gfm_hil.bench.rounds import ShowProgress, in_turn
from gfm_hil.bench.tables import lockstep_name
from gfm_hil.core.errors import UserError
from gfm_hil.results.table import Table

BELIEVED = 0.05  # limit of a corrected p value
_EXACT = 200_000  # most orders counted one by one; beyond, use the normal approximation
_LISTS = ("rounds_p50_us", "rounds_ratio", "turns")  # lists that every round extends


def rank_test(a: Sequence[float], b: Sequence[float]) -> float:
    """p value of the two-sided Mann-Whitney test, ties at their mean rank.

    If there are few, it counts all assignments of the ranks, and so is exact with ties too, which
    SciPy's is not; else it is SciPy's normal approximation.
    """
    n, m = len(a), len(b)
    if math.comb(n + m, n) > _EXACT:
        return float(mannwhitneyu(a, b, method="asymptotic").pvalue)
    ranks = rankdata([*a, *b])
    mean = n * (n + m + 1) / 2
    sums = np.array([sum(some) for some in combinations(ranks.tolist(), n)])
    return float(np.mean(np.abs(sums - mean) >= abs(ranks[:n].sum() - mean) - 1e-9))


def holm(p_values: Sequence[float]) -> list[float]:
    """The p values corrected for their number."""
    order, corrected = np.argsort(p_values), np.empty(len(p_values))
    by_rank = np.arange(len(p_values), 0, -1) * np.take(p_values, order)
    corrected[order] = np.minimum(np.maximum.accumulate(by_rank), 1.0)
    return [float(p) for p in corrected]


def compare(a: dict[str, Any], b: dict[str, Any], by_limit: bool) -> list[dict[str, Any]]:
    """One row per quantity that both results have, B over A; with ``by_limit`` ratios to the limit
    in C instead of times, where both have them. Raises UserError: they have nothing in common."""
    in_a, in_b = (dict(_samples(content, by_limit)) for content in (a, b))
    both = {row: values for row, values in in_a.items() if row in in_b}
    if not both:
        raise UserError("A and B have no row in common: the same `gfmhil bench` must be run twice")
    corrected = holm([rank_test(x, in_b[row]) for row, x in both.items()])
    rows = []
    for ((name, unit), x), p in zip(both.items(), corrected, strict=True):
        y = in_b[name, unit]
        # the smallest p possible with this number of rounds, corrected as the smallest of all rows
        reach = 2 / math.comb(len(x) + len(y), len(x)) * len(both)
        undecided = "noise" if reach < BELIEVED else "too few rounds to tell"
        rows.append({
            "row": name, "unit": unit,
            "a": median(x), "b": median(y), "ratio": median(y) / median(x),
            "rounds": [len(x), len(y)], "p": p,
            "verdict": "real change" if p < BELIEVED else undecided,
        })  # fmt: skip
    return rows


def comparison_table(rows: list[dict[str, Any]]) -> Table:
    """The rows as a table for display."""
    forms = ("{row}", "{a:.4g}", "{b:.4g}", "{unit}", "{ratio:.2f}", "{p:.2g}", "{verdict}")
    title = "B and A: medians of rounds, p of the rank test corrected for the number of rows"
    heads = ("", "A", "B", "unit", "B : A", "p", "verdict")
    return Table(heads, [[form.format(**row) for form in forms] for row in rows], title)


def _samples(
    content: dict[str, Any], by_limit: bool
) -> Iterator[tuple[tuple[str, str], list[float]]]:
    """((row, unit), value of each round) of rows that have any."""
    for r in content["results"]:
        name = f"latency: {r['name']}, {r['mode']}, {r['load']}, {r['policy']}, {r['payload']} B"
        if by_limit and r["peer"] != "C" and r["rounds_ratio"]:
            yield (name, "× limit"), r["rounds_ratio"]
        elif r["rounds_p50_us"]:
            yield (name, "µs"), r["rounds_p50_us"]
    for r in rows_of(content, "jitter") or ():
        yield (f"jitter: {r['wait']}, {r['load']}, {r['policy']}", "µs"), r["rounds_p50_us"]
    for r in rows_of(content, "lockstep") or ():
        yield (f"lockstep: {lockstep_name(r)}", "ticks/s"), r["ticks_per_s"]["turns"]
    for r in rows_of(content, "laws") or ():
        yield (f"loop in process: {r['law']}", "ns"), r["whole_ns"]["turns"]
    for r in rows_of(content, "realtime") or ():
        if r["rounds_p50_us"]:
            yield (f"real time: {r['link']}, {r['load']}", "µs"), r["rounds_p50_us"]
    for r in rows_of(content, "kernel") or ():
        name = f"kernel: {r['law']}, {r['real']}"
        if by_limit and r["ratio"]:
            yield (name, "× C"), r["ratio"]["turns"]
        else:
            yield (name, "ns"), r["numba_ns"]["turns"]


def interleave(
    a: str, b: str, turns: int, what: str, folder: Path, show: ShowProgress
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Run two gfmhil commands, for example paths in two environments, ``turns`` times, one round
    each; every second turn begins with B. Returns the results, the first turn's with the rounds of
    all turns, and writes them to ``folder`` as A.json and B.json.

    Raises UserError: there is no such command or kind of benchmark, or it fails (with its message).
    """
    if turns < 2:
        raise UserError(f"--interleave {turns}: must be at least 2")
    chosen = shlex.split(what)
    if not chosen or chosen[0] not in KINDS:
        raise UserError(f"--what {what!r}: must begin with one of {', '.join(KINDS)}")
    commands = {"A": shlex.split(a), "B": shlex.split(b)}
    for name, command in commands.items():
        if not command or shutil.which(command[0]) is None:
            raise UserError(f"{name} = {shlex.join(command)!r}: no such command")
    runs: dict[str, list[dict[str, Any]]] = {name: [] for name in commands}
    for turn, share, name in in_turn(list(commands), turns):
        show(f"round {turn + 1}, {name}", share)
        runs[name].append(_once(name, commands[name], chosen))
    for name, (first, *others) in runs.items():
        for other in others:
            _extend(first, other)
        write_result(first, folder / f"{name}.json")
    return runs["A"][0], runs["B"][0]


def _once(name: str, command: list[str], chosen: list[str]) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="gfmhil-") as place:
        out = ["--rounds", "1", "--quiet", "--json", "--out", str(Path(place) / "bench")]
        line = [*command, "bench", *chosen, *out]
        done = subprocess.run(line, capture_output=True, text=True, check=False)
    about = f"{name}: {shlex.join([*command, 'bench', *chosen])}"
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        raise UserError(f"{about}: {lines[-1] if lines else f'exit code {done.returncode}'}")
    try:
        return check_result(json.loads(done.stdout), about)
    except ValueError:
        raise UserError(f"{about}: printed no JSON") from None


def _extend(kept: Any, more: Any) -> None:
    """Extend a result's lists of rounds by those of another one."""
    if isinstance(kept, dict):
        for key, value in kept.items():
            if key in _LISTS:
                value += more[key]
            elif key in more:
                _extend(value, more[key])
    elif isinstance(kept, list):
        for a, b in zip(kept, more, strict=False):
            _extend(a, b)
