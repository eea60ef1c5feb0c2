"""One role as a process of its own: set up the bench, shake hands, run, record."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import PeerLost, UserError
from gfm_hil.core.files import write_text
from gfm_hil.core.roles import OUR_CONTROLLER, Role
from gfm_hil.core.stopping import Interrupt
from gfm_hil.engine.command_server import CommandServer
from gfm_hil.engine.drive import compile_loops
from gfm_hil.engine.handshake import shake_hands
from gfm_hil.engine.loop_records import FLAGS, WAKE
from gfm_hil.engine.loop_thread import run_loop
from gfm_hil.engine.model_ticks import SteppedModel
from gfm_hil.engine.sd_notify import Watched, notify
from gfm_hil.engine.setup import Bench, make_bench
from gfm_hil.engine.timeline import Timeline
from gfm_hil.links import Link, open_link, pump
from gfm_hil.links.frame import DATA_IDS, FrameReader, FrameWriter, judge
from gfm_hil.links.impaired.link import ImpairedLink
from gfm_hil.models import Model, ModelError
from gfm_hil.realtime.prevent_idle import prevent_idle
from gfm_hil.realtime.priority import ask_for_real_time, no_collector_pauses, ordinary_priority
from gfm_hil.recording.log import Outcome
from gfm_hil.recording.parts import Part, keep_in_memory
from gfm_hil.recording.recorder import record_command, record_controller, record_sample
from gfm_hil.scenario.events import Gains, LawChange
from gfm_hil.scenario.model import Scenario
from gfm_hil.scenario.toml_out import write_scenario
from gfm_plant import plant_command, plant_sample, plant_step
from gfm_runtime.assembly import warm_up
from gfm_runtime.signals import carried


def run_role(
    role: Role,
    scenario: Scenario,
    folder: Path,
    notice: Callable[[str], None] = print,
    model: Model | None = None,
) -> Outcome:
    """Run one side of a scenario at ``scenario.link.endpoint``, which is set; record to ``folder``.

    Args:
        role, scenario, folder: which side of what, and where it records.
        notice: told what a person should know while waiting.
        model: of the controller: what computes u in place of the law.

    Returns:
        How it ended; the parts of the recording, ``events_<role>.jsonl`` and ``link_<role>.json``
        (frame counters) are in ``folder``.

    Raises:
        UserError: the endpoint cannot be opened, or the scenario has no operating point.
    """
    assert scenario.link.endpoint is not None
    with Interrupt() as interrupt:
        return _run(role, scenario, scenario.link.endpoint, folder, notice, interrupt, model)


def _run(
    role: Role,
    scenario: Scenario,
    endpoint: str,
    folder: Path,
    notice: Callable[[str], None],
    interrupt: Interrupt,
    model: Model | None,
) -> Outcome:
    bench = make_bench(scenario)
    if model is not None:
        bench.model = _stepped(model, bench)
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "scenario.toml").exists():  # started alone: observers read here what it runs
        write_scenario(folder, scenario)
    if scenario.mode == "realtime":
        keep_in_memory(folder, scenario.ticks, notice, bench.inner)
    part = Part.create(folder, role, scenario.ticks, bench.inner)
    compile_role(role, bench, part)
    timeline = Timeline(bench, folder / f"events_{role}.jsonl", (role,))
    flags = np.zeros(FLAGS, np.int64)

    def wake() -> None:
        flags[WAKE] += 1

    # the command server first: its threads must not inherit the loop's priority
    with CommandServer(role, bench, timeline, folder, wake, interrupt.ask):
        try:
            seen = _meet_and_run(role, bench, endpoint, part, timeline, flags, interrupt, notice)
            with contextlib.suppress(OSError):  # a full disk costs these counts and nothing else
                write_text(folder / f"link_{role}.json", json.dumps({"role": role, **seen}))
        except PeerLost as problem:
            timeline.end("interrupted" if interrupt.came else "safe", str(problem), 0)
        finally:
            timeline.close()
    assert timeline.outcome is not None
    return timeline.outcome


def _stepped(model: Model, bench: Bench) -> SteppedModel:
    """A model ready for tick 0 at the operating point.

    Raises:
        UserError: it refuses, or the scenario has events that are about a law.
    """
    for event in bench.scenario.events:
        if isinstance(event, (LawChange, Gains)):
            raise UserError(f"events, {event.label()}: {model.name} has a law of its own")
    try:
        return SteppedModel(model, bench.u)
    except ModelError as problem:
        raise UserError(str(problem)) from None


def _meet_and_run(
    role: Role,
    bench: Bench,
    endpoint: str,
    part: Part,
    timeline: Timeline,
    flags: NDArray[np.int64],
    interrupt: Interrupt,
    notice: Callable[[str], None],
) -> dict[str, Any]:
    """Open the link, meet the other side, run; returns what the link counted.

    Raises:
        PeerLost: the other side did not come.
        UserError: the endpoint cannot be opened.
    """
    scenario = bench.scenario
    rights = ask_for_real_time(role) if scenario.mode == "realtime" else None
    kind, options = scenario.link.type, scenario.link.options
    good: Link = open_link(kind, role, endpoint, options, bench.inner)
    link = good

    def stopped() -> bool:
        return interrupt.came

    resources = ExitStack()
    try:
        if scenario.link.impairment is not None and scenario.link.impairment.hits(role):
            link = ImpairedLink(good, scenario.link.impairment, role)  # compiles: before START
        if rights is not None:
            if good.port is None:  # a thread in Python pumps its messages, and hardly ever sleeps
                rights["policy"] = ordinary_priority()
            else:
                busy = prevent_idle(rights["processor"], scenario.prevent_idle)
                rights["idle_prevented"] = resources.enter_context(busy)
            timeline.write(0, "scheduling", role=role, **rights)
        no_collector_pauses()
        notify(f"STATUS=waiting for the other side at {endpoint}")
        name = OUR_CONTROLLER if bench.model is None else bench.model.name
        start = shake_hands(role, good, scenario, stopped, notice, name)
        met = {"controller": start.controller, "run": start.run, "one_clock": start.one_clock}
        timeline.write(0, "handshake", role=role, **met)  # in the log: a kill does not lose it
        with Watched(scenario, part.progress):
            reader = run_loop(role, bench, link, part, timeline, start.t0_ns, stopped, flags)
    finally:
        resources.close()
        link.close()
        if bench.model is not None:
            bench.model.close()
    injected = {"injected": link.injected} if isinstance(link, ImpairedLink) else {}
    counted = getattr(good, "counters", {})  # of a link in several frames a message
    faults = {**reader.faults, **counted, "refused_greetings": start.refused}
    return {"faults": faults, "e2e": reader.e2e, **injected}


def compile_role(role: Role, bench: Bench, part: Part) -> None:
    """Compile (or load from cache) every function that a tick calls, on copies."""
    plant, y, u = bench.plant.copy().records, bench.y.copy(), bench.u.copy()
    plant_sample(plant, 0, y)
    plant_step(plant)
    plant_command(plant, 0, u)
    warm_up(bench.controller)
    for group in DATA_IDS:
        values = np.zeros(len(carried(group, bench.inner)))
        reader, writer = FrameReader(group, bench.inner), FrameWriter(group, bench.inner)
        reader.unpack(writer.pack(0, 0, 0, values), values)
        judge(reader.record, False, False)
    compile_loops(role, bench, part)
    pump.warm_up()
    if role == "plant":
        record_sample(part.signals[0].copy(), y, plant, 0)
        record_command(part.signals[0].copy(), u)
    else:
        c = bench.controller
        record_controller(part.signals[0].copy(), c.ctl, c.states, c.est)
