"""What a worker does: a chunk of runs in process, each turned into a small record."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.engine.compiling import compiled_bench
from gfm_hil.engine.inproc import buffers
from gfm_hil.recording.parts import Part
from gfm_hil.results.report import finite
from gfm_hil.results.runner import run_in_memory
from gfm_hil.results.summary import READ
from gfm_hil.scenario.model import Scenario
from gfm_hil.studies.campaign.spec import Campaign

Job = tuple[int, str]  # run number, law
Record = dict[str, Any]

_EVENT_KEYS = ("t", "tick", "label", "cut_short")  # of a summary's event; the scenario has them


class RunFailed(Exception):
    """A run ended by an error of the program; the message names the run."""


def compile_once(campaign: Campaign, notice: Callable[[str], None]) -> None:
    """Fill numba's cache here, so that workers need not all compile the same."""
    scenario, _ = campaign.scenario(0, campaign.file.laws[0])
    try:
        compiled_bench(scenario, notice)
    except UserError:  # no steady state: the workers will compile
        return


def ready() -> None:
    """Do nothing: a process that is asked to has then imported what a run takes."""


def run_chunk(campaign: Campaign, jobs: Sequence[Job]) -> list[Record]:
    """The records of some runs.

    Raises:
        RunFailed: an error that is not the run's own.
    """
    parts: dict[bool, tuple[Part, Part]] = {}
    records = []
    for run, law in jobs:
        try:
            scenario, drawn = campaign.scenario(run, law)
            inner = scenario.has_inner
            if inner not in parts:
                parts[inner] = buffers(scenario.ticks, inner)
            summary, p = simulate(scenario, *parts[inner])
        except Exception as problem:
            words = f"run {run}, {law}: {type(problem).__name__}: {problem}"
            raise RunFailed(words) from problem
        records.append(record(run, law, scenario, drawn, summary, p))
    return records


def simulate(
    scenario: Scenario, plant: Part, controller: Part
) -> tuple[dict[str, Any], NDArray[np.float64]]:
    """The summary of a run, as ``run_scenario`` would write it, and p at every tick, p.u."""
    try:
        run = run_in_memory(scenario, (plant, controller), READ)
    except UserError as problem:
        return {"status": "no-steady-state", "reason": str(problem), "events": []}, np.empty(0)
    return run.summary, np.asarray(run.columns["true_p"])


def record(
    run: int,
    law: str,
    scenario: Scenario,
    drawn: dict[str, Any],
    summary: dict[str, Any],
    p: NDArray[np.float64],
) -> Record:
    """What is kept of a run; ``docs/campaigns.md`` lists the keys."""
    lasted = summary["status"] in ("completed", "oscillating")
    ripple = summary.get("ripple_pu")
    events = [{k: v for k, v in e.items() if k not in _EVENT_KEYS} for e in summary["events"]]
    return finite(
        {
            "run": run,
            "law": law,
            "seed": scenario.seed,
            "drawn": drawn,
            "status": summary["status"],
            "reason": summary["reason"],
            "end_s": None if lasted or not len(p) else len(p) * scenario.T_s,
            "ripple_pu": max(ripple.values()) if ripple else None,
            "growth_1_s": max((g for e in events if (g := _growth(e)) is not None), default=None),
            "events": events,
        }
    )


def _growth(event: dict[str, Any]) -> float | None:
    """Larger growth rate of an event's swing and fast mode, 1/s; negative: both decay."""
    rates = [
        -zeta * 2 * math.pi * event[hertz] / math.sqrt(1 - zeta**2)
        for ratio, hertz in (("damping_ratio", "oscillation_hz"), ("fast_damping_ratio", "fast_hz"))
        if (zeta := event.get(ratio)) is not None
    ]
    return max(rates, default=None)
