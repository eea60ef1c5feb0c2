"""Round trips of every link and of the limit in C, in interleaved rounds of one run."""

import itertools
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gfm_hil.bench.contenders import ELSEWHERE, Contender, contenders_of, memory_folder
from gfm_hil.bench.cpu_load import Load, cpu_load
from gfm_hil.bench.histogram import summary
from gfm_hil.bench.night import Block, Blocks, lines_of, night_of
from gfm_hil.bench.one_way import ways
from gfm_hil.bench.options import BenchOptions, Mode
from gfm_hil.bench.pair import Pair, pair, waited_ns
from gfm_hil.bench.rounds import REST, ShowProgress, in_turn
from gfm_hil.bench.share import own_share_us
from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import Role
from gfm_hil.realtime.environment import caveats
from gfm_hil.run.attribution import Times

PERIOD_NS = 100_000
_FIRST_S = 0.02  # length of the warm-up round


@dataclass
class _RoundTrips:
    """Those of one contender in one mode under one load, ns, by round; and how many rounds had no
    answer."""

    contender: Contender
    mode: Mode
    load: Load
    about: dict[str, Any]  # columns of the row that say what it is
    rounds: dict[int, Times] = field(default_factory=dict)
    silent: int = 0
    sides: list[dict[str, Any]] = field(default_factory=list)  # see ``one_way.delays``


def measure(options: BenchOptions, content: dict[str, Any], show: ShowProgress) -> None:
    """Add a row per contender, mode and load to ``results``.

    A link that is not available here is left out, with a remark.
    """
    cells: list[_RoundTrips] = []
    with ExitStack() as stack:
        place = memory_folder(stack)
        elsewhere = []
        if options.to:
            from gfm_hil.bench.peer import peer_of  # with it comes the plant

            elsewhere = [peer_of(options, place)]
        contenders, remarks = contenders_of([*options.links, *options.peers], place, elsewhere)
        two = stack.enter_context(pair(options.policies[0], place))
        load = stack.enter_context(cpu_load())
        for c in contenders:
            show(f"opening {c.name}", 0.0)
            try:
                compiled = two.open(c, options.payload)
            except UserError as problem:
                if c.peer == ELSEWHERE:
                    raise
                remarks.append(f"{c.name}: not measured: {problem}")
                continue
            code = "C" if c.source else ("compiled" if compiled else "Python")
            far = c.peer == ELSEWHERE
            share = None if c.source else two.here("plant", own_share_us, code, far)
            about = {"link": c.link, "peer": c.peer, "code": code, "bench_us": share}
            cells += [_RoundTrips(c, m, w, about) for w in options.loads for m in options.modes]

        def one_round(cell: _RoundTrips, seconds: float, share: float) -> Times:
            show(f"{cell.contender.name}, {cell.mode}, {cell.load}", share)
            with load(cell.load):
                period = PERIOD_NS if cell.mode == "realtime" else 0
                times = two.round(cell.contender, period, seconds)
            time.sleep(REST * seconds)
            cell.silent += not len(times)
            return times

        for cell in cells:  # compile and warm up
            one_round(cell, _FIRST_S, 0.0)
        content["remarks"] += remarks
        if options.for_s:
            _measure_night(options, cells, one_round, two, content)
            return
        for number, share, cell in in_turn(cells, options.rounds, options.until):
            times = one_round(cell, options.seconds, share)
            if len(times):
                cell.rounds[number] = times
            if two.sides:
                cell.sides.append(two.sides)
    by_key = {(c.contender.name, c.mode, c.load): c for c in cells}
    content["results"] += [
        _row(c, by_key.get((c.contender.limit, c.mode, c.load)), options) for c in cells
    ]


def _measure_night(
    options: BenchOptions, cells: list[_RoundTrips],
    one_round: Callable[[_RoundTrips, float, float], Times], two: Pair, content: dict[str, Any],
) -> None:  # fmt: skip
    """Measure block after block, in turn, and put what the folder then holds into the content."""
    folder = options.folder
    by_name = {cell.contender.name: cell for cell in cells}
    settings = {
        "names": [*by_name], "modes": [*options.modes], "loads": [*options.loads],
        "policy": options.policies[0], "payload": options.payload,
    }  # fmt: skip
    about = {
        "contenders": {name: cell.about for name, cell in by_name.items()},
        "environment": content["environment"], "caveats": caveats(content["environment"]),
    }  # fmt: skip
    blocks = Blocks(folder, settings, about, options.resume)
    done_s = sum(block["s"] for block in lines_of(folder))
    for cell in itertools.cycle(cells):
        if done_s >= options.for_s:
            break
        block = Block(time.time(), PERIOD_NS if cell.mode == "realtime" else 0)
        while block.seconds < options.block_s:
            before, at = two.both(waited_ns), time.time()
            times = one_round(cell, options.seconds, done_s / options.for_s)
            after = two.both(waited_ns)
            if len(times):
                waited = {role: after[role] - before[role] for role in after}
                block.add(times, at, _cause(times, waited))
            block.seconds += options.seconds
        blocks.append((cell.contender.name, cell.mode, cell.load), block)
        done_s += block.seconds
    blocks.close()
    content["results"] += night_of(folder)["results"]


def _cause(times: Times, waited: dict[Role, int]) -> str:
    """What may have cost the longest time of a round, as far as the kernel counts it."""
    excess = int(times.max()) - float(np.median(times))
    role = max(waited, key=lambda one: waited[one])
    if waited[role] < excess / 2:
        return "link, or a processor that the host took: the kernel counted no wait"
    return f"another thread had the processor of the {role} for {waited[role] / 1e3:.0f} µs"


def _row(cell: _RoundTrips, limit: _RoundTrips | None, options: BenchOptions) -> dict[str, Any]:
    c, of_limit = cell.contender, limit.rounds if limit else {}
    ratios = [
        float(np.median(cell.rounds[k]) / np.median(of_limit[k]))
        for k in sorted(cell.rounds.keys() & of_limit.keys())
    ]
    return {
        "name": c.name, **cell.about,
        "mode": cell.mode, "load": cell.load, "policy": options.policies[0],
        "payload": options.payload,
        **summary(list(cell.rounds.values())),
        "baseline": c.limit or None,
        "ratio_to_baseline_p50": round(float(np.median(ratios)), 4) if ratios else None,
        "rounds_ratio": [round(ratio, 4) for ratio in ratios],
        "silent_rounds": cell.silent,
        **(ways(cell.sides) if cell.sides else {}),
    }  # fmt: skip
