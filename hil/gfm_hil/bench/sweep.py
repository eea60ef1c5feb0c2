"""Round trips by payload, rate, load, policy and way to wait, and the highest rate of each.

A message is due every period, and its time counts from the deadline. It misses if its answer comes
after the next one. The highest rate is that at which at most a share of them misses, by bisection
of its logarithm. Cost is the processor time of both sides over that of the round.
"""

import math
import os
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.bench.contenders import Contender, contenders_of, memory_folder
from gfm_hil.bench.cpu_load import LOADS, Load, cpu_load, program
from gfm_hil.bench.histogram import summary
from gfm_hil.bench.options import BenchOptions
from gfm_hil.bench.pair import Pair, Policy, pair
from gfm_hil.bench.pingpong import HYBRID, SLEEP, SPIN
from gfm_hil.bench.rounds import REST, ShowProgress, in_turn
from gfm_hil.core.errors import UserError
from gfm_hil.run.attribution import Times

WAITS = {"both": HYBRID, "spin": SPIN, "sleep": SLEEP}
_FIRST_S = 0.02  # length of the warm-up round
_STEPS = 5  # of the bisection


@dataclass(frozen=True, eq=False)
class _Cell:
    contender: Contender
    payload: int
    policy: Policy
    load: Load
    wait: str
    kb: float  # that opening both ends took


def usage() -> tuple[float, int]:
    """Processor time (s) and memory (bytes) of a process of the pair."""
    pages = int(Path("/proc/self/statm").read_text("utf-8").split()[1])
    return time.process_time(), pages * os.sysconf("SC_PAGE_SIZE")


def measure(options: BenchOptions, content: dict[str, Any], show: ShowProgress) -> None:
    """Add a row per cell and rate to ``sweep``, and the highest rates to ``highest``."""
    with ExitStack() as stack:
        place = memory_folder(stack)
        load = stack.enter_context(cpu_load(options.loads))
        pairs: dict[Policy, Pair] = {}
        cells: list[_Cell] = []
        for policy in options.policies:
            (place / policy).mkdir()
            pairs[policy] = stack.enter_context(pair(policy, place / policy))
            cells += _open(options, policy, pairs[policy], place / policy, content["remarks"], show)

        def one_round(cell: _Cell, khz: float, seconds: float) -> tuple[Times, float]:
            two, period_ns = pairs[cell.policy], round(1e6 / khz)
            before = two.both(usage)
            with load(cell.load):
                begin = time.monotonic()
                took = two.round(cell.contender, period_ns, seconds, WAITS[cell.wait])
                lasted = time.monotonic() - begin
            after = two.both(usage)
            time.sleep(REST * seconds)
            return took, sum(after[s][0] - before[s][0] for s in after) / lasted

        def missed(cell: _Cell, khz: float) -> float | None:
            return _missed_pct(one_round(cell, khz, options.seconds)[0], khz)

        for cell in cells:
            one_round(cell, options.rates[0], _FIRST_S)
        every = list(product(cells, options.rates))
        rounds = {one: list[tuple[Times, float]]() for one in every}
        for _, share, (cell, khz) in in_turn(every, options.rounds, options.until):
            show(f"{cell.contender.name}, {cell.load}, {khz:g} kHz", share)
            rounds[cell, khz].append(one_round(cell, khz, options.seconds))
        content["sweep"] = [_row(*one, some) for one, some in rounds.items()]
        content["highest"], most_pct = [], options.most_missed_pct
        for k, cell in enumerate(cells):
            show(f"highest rate, {cell.contender.name}, {cell.load}", k / len(cells))
            bears_khz = highest(partial(missed, cell), options.rates, most_pct)
            row = {"highest_khz": bears_khz, "most_missed_pct": most_pct}
            content["highest"].append(_keys(cell) | row)
    content["remarks"] += [f"load {x}: {program(x)}" for x in options.loads if x not in LOADS]


def _open(
    options: BenchOptions, policy: Policy, two: Pair, place: Path, remarks: list[str],
    show: ShowProgress,
) -> list[_Cell]:  # fmt: skip
    """The cells of a policy, of contenders that carry the payload."""
    cells: list[_Cell] = []
    for payload in options.payloads:
        (here := place / str(payload)).mkdir()
        contenders, said = contenders_of([*options.links, *options.peers], here)
        remarks += [text for text in said if text not in remarks]
        for one in contenders:
            c = replace(one, name=f"{one.name}, {payload} B")
            show(f"opening {c.name}", 0.0)
            before = two.both(usage)
            try:
                two.open(c, payload)
            except (UserError, OSError) as problem:
                remarks.append(f"{c.name}: not measured: {problem}")
                continue
            kb = sum(m - before[s][1] for s, (_, m) in two.both(usage).items()) / 1024
            cells += [
                _Cell(c, payload, policy, load, wait, kb)
                for load, wait in product(options.loads, options.waits)
                if wait == "both" or c.peer != "C"
            ]
    return cells


def _missed_pct(took: Times, khz: float) -> float | None:
    """Share of messages whose answer came after the next deadline, %; None without answers."""
    return 100 * float(np.mean(took > 1e6 / khz)) if len(took) else None


def highest(
    missed: Callable[[float], float | None], rates: Sequence[float], most_pct: float
) -> float | None:
    """The highest rate, kHz, of which no more is ``missed``; None if the lowest one is too fast."""
    low, high = float(min(rates)), float(max(rates))

    def bears(khz: float) -> bool:
        share = missed(khz)
        return share is not None and share <= most_pct

    if bears(high):
        return high
    if not bears(low):
        return None
    for _ in range(_STEPS):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if bears(middle) else (low, middle)
    return round(low, 2)


def _keys(cell: _Cell) -> dict[str, Any]:
    return {
        "name": cell.contender.name.removesuffix(f", {cell.payload} B"),
        "peer": cell.contender.peer, "payload": cell.payload, "policy": cell.policy,
        "load": cell.load, "wait": cell.wait,
    }  # fmt: skip


def _row(cell: _Cell, khz: float, rounds: list[tuple[Times, float]]) -> dict[str, Any]:
    took, costs = zip(*rounds, strict=True)
    shares = [share for times in took if (share := _missed_pct(times, khz)) is not None]
    figures = summary(took)
    del figures["histogram"]
    return _keys(cell) | {
        "khz": khz,
        "missed_pct": round(float(np.mean(shares)), 4) if shares else None,
        "processor_pct": round(100 * float(np.median(costs)), 1),
        "opened_kb": round(cell.kb),
        **figures,
    }
