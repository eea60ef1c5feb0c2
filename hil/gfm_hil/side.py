"""One side as a process of its own: ready the bench, meet the other side, run, keep everything."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from gfm_hil.bench import Bench, make_bench
from gfm_hil.controller_side import run_controller
from gfm_hil.errors import PeerLost, UserError
from gfm_hil.handshake import shake_hands
from gfm_hil.links import open_link
from gfm_hil.links.base import Side
from gfm_hil.plant_side import run_plant
from gfm_hil.realtime import go_first, no_collector_pauses, own_processor
from gfm_hil.recording import Part, record_controller, record_plant
from gfm_hil.scenario import Scenario
from gfm_hil.stopping import Interrupt
from gfm_hil.timeline import Outcome, Timeline
from gfm_plant import plant_advance, plant_sample
from gfm_runtime.assembly import warm_up


def run_side(
    side: Side, scenario: Scenario, folder: Path, notice: Callable[[str], None] = print
) -> Outcome:
    """Run one side of a scenario at ``scenario.link.endpoint``, recording into ``folder``.

    Returns:
        How it ended; the parts of the recording, ``events_<side>.jsonl`` and ``link_<side>.json``
        (frame counters) are in ``folder``.

    Raises:
        UserError: the endpoint is not to be had, or the scenario has no operating point.
    """
    if scenario.link.endpoint is None:
        raise UserError("link.endpoint: not set; a side started alone needs one (--endpoint)")
    with Interrupt() as interrupt:
        return _run(side, scenario, scenario.link.endpoint, folder, notice, interrupt)


def _run(
    side: Side,
    scenario: Scenario,
    endpoint: str,
    folder: Path,
    notice: Callable[[str], None],
    interrupt: Interrupt,
) -> Outcome:
    bench = make_bench(scenario)
    first = False
    if scenario.mode == "realtime":  # before the link starts threads, which inherit both
        own_processor(side)
        first = go_first()
    link = open_link(scenario.link.type, side, endpoint, scenario.link.options)
    folder.mkdir(parents=True, exist_ok=True)
    part = Part.create(folder, side, scenario.ticks)
    timeline = Timeline(bench, folder / f"events_{side}.jsonl", (side,))
    if scenario.mode == "realtime":
        timeline.write(0, "scheduling", side=side, priority="highest" if first else "as given")
    compile_side(bench, part)

    def stopped() -> bool:
        return interrupt.came

    try:
        no_collector_pauses()
        t0_ns = shake_hands(side, link, scenario, stopped, notice)
        run = run_controller if side == "controller" else run_plant
        reader = run(bench, link, part, timeline, t0_ns, stopped)
        faults = {"side": side, "faults": reader.faults}
        (folder / f"link_{side}.json").write_text(json.dumps(faults))
    except PeerLost as problem:
        timeline.end("interrupted" if stopped() else "safe", str(problem), 0)
    finally:
        link.close()
        timeline.close()
    assert timeline.outcome is not None
    return timeline.outcome


def compile_side(bench: Bench, part: Part) -> None:
    """Compile (or load from cache) every function that a tick calls, on copies."""
    par, st, y, u = bench.par.copy(), bench.st.copy(), bench.y.copy(), bench.u.copy()
    plant_sample(par, st, y)
    plant_advance(par, st, u)
    warm_up(bench.controller)
    if part.signals.shape[1] > len(y) + len(u) + 1:
        record_plant(part.signals[0].copy(), y, u, par, st)
    else:
        record_controller(part.signals[0].copy(), bench.controller.ctl, bench.controller.est)
