"""Round trips of every link and of the limit in C, in interleaved rounds of one run."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gfm_hil.bench.c_code import NoCompiler, compile_c
from gfm_hil.bench.contenders import Contender, memory_folder, of_links
from gfm_hil.bench.cpu_load import Load, cpu_load
from gfm_hil.bench.histogram import summary
from gfm_hil.bench.pair import pair
from gfm_hil.bench.rounds import REST, Plan, rounds
from gfm_hil.core.errors import UserError

Mode = Literal["lockstep", "realtime"]
MODES: tuple[Mode, ...] = ("lockstep", "realtime")
PERIOD_NS = 100_000

_FIRST_S = 0.02  # length of the warm-up round

Tell = Callable[[str, float], None]  # present work and share done


@dataclass
class _Cell:
    """One contender in one mode under one load.

    Attributes:
        rounds: round trips of each round, ns.
        silent: rounds in which no answer came.
    """

    contender: Contender
    mode: Mode
    load: Load
    compiled: bool
    rounds: dict[int, NDArray[np.int64]] = field(default_factory=dict)
    silent: int = 0


def measure(plan: Plan, tell: Tell) -> tuple[list[dict[str, Any]], list[str]]:
    """Measure; returns (results, remarks), one result per contender, mode and load.

    A link that is not available here is left out, with a remark.
    """
    remarks: list[str] = []
    with ExitStack() as stack:
        place = memory_folder(stack)
        try:
            library = compile_c("pingpong.c", place, "pingpong")
        except NoCompiler as problem:
            library = None
            remarks.append(f"{problem}: no limits in C, no ratios")
        contenders = of_links(list(plan.links), place, library)
        two = stack.enter_context(pair(plan.policies[0], place))
        load = stack.enter_context(cpu_load())
        cells = []
        for contender in contenders:
            tell(f"opening {contender.name}", 0.0)
            try:
                compiled = two.open(contender, plan.payload)
            except UserError as problem:
                remarks.append(f"{contender.name}: not measured: {problem}")
                continue
            cells += [_Cell(contender, m, w, compiled) for w in plan.loads for m in plan.modes]

        def one_round(number: int, seconds: float) -> None:
            for k, cell in enumerate(cells[:: -1 if number % 2 else 1]):
                share = (number + k / len(cells)) / plan.rounds
                tell(f"{cell.contender.name}, {cell.mode}, {cell.load}", max(share, 0.0))
                period = PERIOD_NS if cell.mode == "realtime" else 0
                with load(cell.load):
                    times = two.round(cell.contender, period, seconds)
                time.sleep(REST * seconds)
                if number >= 0 and len(times):
                    cell.rounds[number] = times
                cell.silent += not len(times)

        one_round(-1, _FIRST_S)  # compile and warm up
        for number in rounds(plan.rounds, plan.until):
            one_round(number, plan.seconds)
    by_key = {(c.contender.name, c.mode, c.load): c for c in cells}
    results = [_result(c, by_key.get((c.contender.baseline, c.mode, c.load)), plan) for c in cells]
    return results, remarks


def _result(cell: _Cell, baseline: _Cell | None, plan: Plan) -> dict[str, Any]:
    c = cell.contender
    both = sorted(cell.rounds.keys() & baseline.rounds.keys()) if baseline else []
    ratios = [
        float(np.median(cell.rounds[k]) / np.median(baseline.rounds[k])) for k in both if baseline
    ]
    return {
        "name": c.name,
        "link": c.link,
        "peer": c.peer,
        "code": "C" if c.peer == "C" else ("compiled" if cell.compiled else "Python"),
        "mode": cell.mode,
        "load": cell.load,
        "policy": plan.policies[0],
        "payload": plan.payload,
        **summary(list(cell.rounds.values())),
        "baseline": c.baseline or None,
        "ratio_to_baseline_p50": round(float(np.median(ratios)), 4) if ratios else None,
        "rounds_ratio": [round(ratio, 4) for ratio in ratios],
        "silent_rounds": cell.silent,
    }
