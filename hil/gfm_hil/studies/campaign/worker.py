"""What a worker does: a chunk of runs in process, each turned into a small record."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from itertools import groupby
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.engine.compiling import SIDE_BY_SIDE, compile_sets, compiled_benches
from gfm_hil.engine.inproc import Steps
from gfm_hil.engine.lanes import is_plain, run_together
from gfm_hil.engine.setup import make_bench
from gfm_hil.recording.columns import ColumnSet
from gfm_hil.recording.parts import MemoryPart
from gfm_hil.results.report import finite
from gfm_hil.run.network_run import NetworkRun
from gfm_hil.run.runner import memory_steps, run_network_in_memory
from gfm_hil.run.summary import READ
from gfm_hil.scenario import Scenario, plant_of
from gfm_hil.studies.campaign.spec import Campaign
from gfm_hil.studies.workers import RunFailed
from gfm_plant import Network

Job = tuple[int, str]  # run number, law
Record = dict[str, Any]

_WORSE = ("completed", "interrupted", "oscillating", "safe", "tripped")  # the better first
_EVENT_KEYS = ("t", "tick", "label", "cut_short")  # of a summary's event; the scenario has them


def compile_once(campaign: Campaign, notice: Callable[[str], None]) -> None:
    """Fill numba's cache here, so that workers need not all compile the same."""
    scenario, _ = campaign.scenario(0, campaign.file.laws[0])
    try:
        if is_plain(compiled_benches(scenario, notice)[0]):
            compile_sets([SIDE_BY_SIDE], notice)
    except UserError:  # no steady state: the workers will compile
        return


def run_chunk(campaign: Campaign, jobs: Sequence[Job]) -> list[Record]:
    """The records of some runs. Raises RunFailed: an error that is not the run's own."""
    with np.errstate(all="ignore"):  # a diverging run is a result
        return run_together(_each_in_steps(campaign, jobs))


class _Draw:
    """What the runs of a draw under several laws have in common, made when the first needs it."""

    def __init__(self, campaign: Campaign, run: int) -> None:
        self.campaign, self.run = campaign, run

    @cached_property
    def content(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """As ``Campaign.drawn``."""
        return self.campaign.drawn(self.run)

    @cached_property
    def plant(self) -> Network:
        """Not started."""
        return plant_of(self.scenario(self.campaign.file.laws[0]))

    def scenario(self, law: str) -> Scenario:
        """Of the run under a law."""
        return Scenario.model_validate(self.campaign.under(self.content[0], law))


def _each_in_steps(campaign: Campaign, jobs: Sequence[Job]) -> Iterator[Steps[Record]]:
    room: dict[int, list[tuple[MemoryPart, MemoryPart]]] = {}
    for run, those in groupby(jobs, key=itemgetter(0)):
        draw = _Draw(campaign, run)
        yield from (_record_steps(draw, law, room) for _, law in those)


def _record_steps(
    draw: _Draw, law: str, room: dict[int, list[tuple[MemoryPart, MemoryPart]]]
) -> Steps[Record]:
    """The record of a run step by step; ``room``: what no run uses, by what it records."""
    campaign, run = draw.campaign, draw.run
    try:
        scenario = draw.scenario(law)
        if scenario.parts:
            summary, lasted = simulate_network(scenario, campaign.file.converter)
        else:
            free = room.setdefault(scenario.signal_set, [])
            mine = free.pop() if free else kept(scenario)
            summary, columns = yield from simulate(scenario, mine, draw.plant.copy())
            lasted = len(columns["true_p"])
            free.append(mine)
    except Exception as problem:
        words = f"run {run}, {law}: {type(problem).__name__}: {problem}"
        raise RunFailed(words) from problem
    return record(run, law, scenario, draw.content[1], summary, lasted)


def kept(scenario: Scenario) -> tuple[MemoryPart, MemoryPart]:
    """Room for the columns of a run that its summary reads."""
    what = scenario.ticks, ColumnSet.of(scenario), READ
    return MemoryPart("plant", *what), MemoryPart("controller", *what)


def simulate(
    scenario: Scenario, room: tuple[MemoryPart, MemoryPart], plant: Network | None = None
) -> Steps[tuple[dict[str, Any], Mapping[str, NDArray[np.float64]]]]:
    """The summary of a run, as ``run_scenario`` would write it, and the columns that it reads,
    which are good until the next run in the same room; ``plant`` as for ``make_bench``."""
    try:
        (run,) = yield from memory_steps([make_bench(scenario, plant=plant)], [room])
    except UserError as problem:
        return no_steady_state(problem), dict.fromkeys(READ, np.empty(0))
    return run.summary, {name: np.asarray(run.columns[name]) for name in READ}


def no_steady_state(problem: UserError) -> dict[str, Any]:
    """What is told of a run that cannot begin."""
    return {"status": "no-steady-state", "reason": str(problem), "events": []}


def simulate_network(scenario: Scenario, converter: str | None) -> tuple[dict[str, Any], int]:
    """As ``of_network``, of a run of the scenario."""
    try:
        return of_network(run_network_in_memory(scenario), converter)
    except UserError as problem:
        return no_steady_state(problem), 0


def of_network(run: NetworkRun, converter: str | None) -> tuple[dict[str, Any], int]:
    """What a record tells of a network, and how many ticks that lasted: the end of the converter
    that came off worst, the largest ripple of any, and the events of ``converter``."""

    def came_off(name: str) -> tuple[int, bool]:
        return _WORSE.index(run[name].status), name == converter

    worst = max(run, key=came_off)
    ended = run[worst].summary
    ripple = [r for one in run.values() if (r := one.summary["ripple_pu"])]
    summary = {
        "status": ended["status"],
        "reason": f"{worst}: {ended['reason']}" if ended["reason"] else "",
        "ripple_pu": {"": max(x for r in ripple for x in r.values())} if ripple else None,
        "events": run.runs[converter or worst].summary["events"],
    }
    trips = ended["trips"]
    return summary, trips[-1]["tick"] if trips else ended["ticks"]


def record(
    run: int,
    law: str,
    scenario: Scenario,
    drawn: dict[str, Any],
    summary: dict[str, Any],
    ticks: int,
) -> Record:
    """What is kept of a run that lasted so many ticks; ``docs/campaigns.md`` lists the keys."""
    lasted = summary["status"] in ("completed", "oscillating")
    ripple = summary.get("ripple_pu")
    events = [{k: v for k, v in e.items() if k not in _EVENT_KEYS} for e in summary["events"]]
    made = {
        "run": run, "law": law, "seed": scenario.seed, "drawn": drawn,
        "status": summary["status"], "reason": summary["reason"],
        "end_s": None if lasted or not ticks else ticks * scenario.T_s,
        "ripple_pu": max(ripple.values()) if ripple else None,
        "growth_1_s": max((g for e in events if (g := _growth(e)) is not None), default=None),
        "events": events,
    }  # fmt: skip
    return finite(made)


def _growth(event: dict[str, Any]) -> float | None:
    """Larger growth rate of an event's swing and fast mode, 1/s; negative: both decay."""
    rates = [
        -zeta * 2 * math.pi * event[hertz] / math.sqrt(1 - zeta**2)
        for ratio, hertz in (("damping_ratio", "oscillation_hz"), ("fast_damping_ratio", "fast_hz"))
        if (zeta := event.get(ratio)) is not None
    ]
    return max(rates, default=None)
