"""One role as a process of its own: set up the bench, shake hands, run, record."""

import json
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import ExitStack, suppress
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from gfm_hil.controllers import ControllerError, ExternalController
from gfm_hil.core.errors import PeerLost, UserError
from gfm_hil.core.files import write_text
from gfm_hil.core.roles import OUR_CONTROLLER, Role
from gfm_hil.core.stopping import Interrupt
from gfm_hil.engine.command_server import CommandServer
from gfm_hil.engine.drive import Share, compile_loops, run_loop
from gfm_hil.engine.external_ticks import SteppedController
from gfm_hil.engine.handshake import Meeting, Start, shake_hands
from gfm_hil.engine.loop_records import FLAGS, WAKE
from gfm_hil.engine.sd_notify import Watched, notify
from gfm_hil.engine.setup import Bench, make_benches
from gfm_hil.engine.snapshot import restore_external
from gfm_hil.engine.timeline import Timeline
from gfm_hil.links import Link, open_link, pump
from gfm_hil.links.frame import DATA_IDS, FrameReader, FrameWriter
from gfm_hil.links.impaired.link import ImpairedLink
from gfm_hil.realtime.prevent_idle import prevent_idle
from gfm_hil.realtime.priority import (
    ask_for_real_time,
    no_collector_pauses,
    one_processor,
    ordinary_priority,
    processors,
)
from gfm_hil.recording.log import SEVERITY, Outcome
from gfm_hil.recording.parts import RolePart, keep_in_memory
from gfm_hil.scenario import Scenario, write_scenario
from gfm_hil.scenario.events.gains import gains_of
from gfm_runtime.signals import carried


def run_role(
    role: Role,
    scenario: Scenario,
    folder: Path,
    endpoints: Mapping[str, str] = MappingProxyType({}),
    notice: Callable[[str], None] = print,
    external: ExternalController | None = None,
) -> Outcome:
    """Run one side of a scenario at its endpoints; record to ``folder``.

    The plant of a network records each converter to a folder of its own in ``folder``.

    Args:
        endpoints: by converter, where the scenario's links name none.
        external: of the controller: what computes u in place of the law.

    Returns:
        How it ended, of several converters the weightiest; the parts of the recording,
        ``events_<role>.jsonl`` and ``link_<role>.json`` (frame counters) are in the folders.

    Raises:
        UserError: an endpoint cannot be opened, or the scenario has no operating point.
    """
    with Interrupt() as interrupt, ExitStack() as stack:
        real = "float64" if external is None else external.real
        benches = make_benches(scenario, real)
        sides = []
        if external is not None:
            stack.enter_context(one_processor(scenario.mode))
            benches[0].external = _stepped(external, benches[0])
            stack.callback(benches[0].external.close)
        _begin(folder, scenario)
        for bench in benches:
            name = bench.scenario.converter or ""
            place = folder / name if scenario.parts else folder
            if name in endpoints:
                link = bench.scenario.link.model_copy(update={"endpoint": endpoints[name]})
                bench.scenario = bench.scenario.model_copy(update={"link": link})
            sides.append(_SideResources(role, bench, place, stack, notice))
        compile_role(role, benches, [side.part for side in sides])
        return _run(role, sides, notice, interrupt)


def _stepped(external: ExternalController, bench: Bench) -> SteppedController:
    """An external controller ready for tick 0 at the operating point. Raises UserError: it refuses,
    or the scenario has events that are about a law."""
    scenario = bench.scenario
    if not external.has_laws:
        for event in scenario.sorted_events():
            if event.changes_law:
                raise UserError(f"events, {event.label()}: {external.name} has a law of its own")
    elif scenario.mode == "realtime":
        raise UserError(f"mode = 'realtime': {external.name} keeps no time; choose --mode lockstep")
    if (scenario.snapshot is not None or scenario.start_from) and not external.gives_state:
        key = "snapshot" if scenario.start_from is None else "start_from"
        raise UserError(f"{key}: {external.name} gives no state, so it has no snapshot")
    try:
        found = SteppedController(
            external, bench.controller, bench.u, gains_of(scenario, bench.controller.omega_b)
        )
        if scenario.start_from is not None:
            restore_external(scenario, bench, found)
        return found
    except ControllerError as problem:
        raise UserError(str(problem)) from None


def _begin(folder: Path, scenario: Scenario) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "scenario.toml").exists():  # started alone: observers read here what it runs
        write_scenario(folder, scenario)


class _SideResources:
    """A role's side of one converter: its bench, its recording and its log."""

    def __init__(
        self,
        role: Role,
        bench: Bench,
        folder: Path,
        stack: ExitStack,
        notice: Callable[[str], None],
    ) -> None:
        self.role, self.bench, self.folder = role, bench, folder
        self.scenario = scenario = bench.scenario
        _begin(folder, scenario)
        if scenario.mode == "realtime":
            keep_in_memory(folder, scenario.ticks, notice, bench.columns)
        self.part = RolePart.create(folder, role, scenario.ticks, bench.columns)
        self.timeline = Timeline(bench, folder / f"events_{role}.jsonl", (role,))
        stack.callback(self.timeline.close)

    def open(self, stack: ExitStack) -> None:
        """Open the link. Raises UserError: the endpoint cannot be opened."""
        given = self.scenario.link
        assert given.endpoint is not None
        signals = self.bench.signal_set
        self.good = open_link(given.type, self.role, given.endpoint, given.options, signals)
        self.link: Link = self.good
        if given.impairment is not None and given.impairment.hits(self.role):
            self.link = ImpairedLink(self.good, given.impairment, self.role)  # compiles: now
        stack.callback(self.link.close)

    def keep_counts(self, reader: FrameReader, start: Start) -> None:
        """Write down what this end of the link counted."""
        link = self.link
        injected = {"injected": link.injected} if isinstance(link, ImpairedLink) else {}
        counted = getattr(self.good, "counters", {})  # of a link in several frames a message
        faults = {**reader.faults, **counted, "refused_greetings": start.refused}
        seen = {"role": self.role, "faults": faults, "e2e": reader.e2e, **injected}
        with suppress(OSError):  # a full disk costs these counts and nothing else
            write_text(self.folder / f"link_{self.role}.json", json.dumps(seen))


def _run(
    role: Role, sides: list[_SideResources], notice: Callable[[str], None], interrupt: Interrupt
) -> Outcome:
    flags = np.zeros(FLAGS, np.int64)

    def wake() -> None:
        flags[WAKE] += 1

    # the command server first: its threads must not inherit the loop's priority
    timelines = [side.timeline for side in sides]
    places = [(side.folder, side.bench) for side in sides]
    with CommandServer(role, places, timelines, wake, interrupt.ask):
        try:
            _meet_and_run(role, sides, flags, notice, interrupt)
        except PeerLost as problem:
            for timeline in timelines:
                timeline.end("interrupted" if interrupt.came else "safe", str(problem), 0)
    outcomes = [timeline.outcome for timeline in timelines if timeline.outcome is not None]
    assert len(outcomes) == len(sides)
    return max(outcomes, key=lambda outcome: SEVERITY.index(outcome.status))


def _meet_and_run(
    role: Role,
    sides: list[_SideResources],
    flags: NDArray[np.int64],
    notice: Callable[[str], None],
    interrupt: Interrupt,
) -> None:
    """Open the links, meet the other sides, run, and keep what the links counted. Raises PeerLost:
    another side did not come; UserError: an endpoint cannot be opened."""
    scenario = sides[0].scenario
    rights = None
    if scenario.mode == "realtime":
        several = len(scenario.converters) or 1
        rights = ask_for_real_time(role, sides[0].bench.place, several)

    def stopped() -> bool:
        return interrupt.came

    with ExitStack() as resources:
        for side in sides:
            side.open(resources)
        if rights is not None:
            if any(side.good.port is None for side in sides):
                # a thread in Python pumps its messages, and hardly ever sleeps
                rights["policy"] = ordinary_priority()
            else:
                busy = prevent_idle(rights["processor"], scenario.prevent_idle)
                rights["idle_prevented"] = resources.enter_context(busy)
            for side in sides:
                side.timeline.write(0, "scheduling", role=role, **rights)
        no_collector_pauses()
        where = ", ".join(str(side.scenario.link.endpoint) for side in sides)
        notify(f"STATUS=waiting for the other side at {where}")
        starts = _meet(role, sides, stopped, notice)
        for side, start in zip(sides, starts, strict=True):
            met = {"controller": start.controller, "run": start.run, "one_clock": start.one_clock}
            side.timeline.write(0, "handshake", role=role, **met)  # so that a kill does not lose it
        with Watched(scenario, sides[0].part.progress):
            loops = 1 + len(scenario.converters)
            crowded = loops > processors() if rights is None else rights["shared"]
            shares = [
                Share(side.bench, side.link, side.part, side.timeline, crowded) for side in sides
            ]
            readers = run_loop(role, shares, starts[0].t0_ns, stopped, flags)
    for side, reader, start in zip(sides, readers, starts, strict=True):
        side.keep_counts(reader, start)


def _meet(
    role: Role,
    sides: list[_SideResources],
    stopped: Callable[[], bool],
    notice: Callable[[str], None],
) -> list[Start]:
    """Shake hands over all links at a time: the controllers of a plant may come in any order.
    Raises PeerLost: one did not come."""
    meeting, failed = Meeting(len(sides)), threading.Event()
    external = sides[0].bench.external

    def meet(side: _SideResources) -> Start:
        try:
            return shake_hands(
                role, side.good, side.scenario, lambda: stopped() or failed.is_set(), notice,
                meeting, OUR_CONTROLLER if external is None else external.name,
            )  # fmt: skip
        except PeerLost as problem:
            if len(sides) > 1 and not failed.is_set():
                problem = PeerLost(f"{side.scenario.converter}: {problem}")
            failed.set()
            raise problem from None

    if len(sides) == 1:
        return [meet(sides[0])]
    with ThreadPoolExecutor(len(sides)) as pool:
        found = [pool.submit(meet, side) for side in sides]
        wait(found)
    problems = [str(one.exception()) for one in found if one.exception() is not None]
    if problems:
        said = [text for text in problems if not text.startswith("interrupted")]
        raise PeerLost("; ".join(said or problems[:1]))
    return [one.result() for one in found]


def compile_role(role: Role, benches: Sequence[Bench], parts: Sequence[RolePart]) -> None:
    """Compile (or load from cache) every function that Python calls for a side; those that only
    these call become part of them."""
    signals = benches[0].scenario.frame_signals
    for group in DATA_IDS:
        values = np.zeros(len(carried(group, signals)))
        frame = FrameWriter(group, signals).pack(0, 0, 0, values)
        FrameReader(group, signals).unpack(frame, values)
    compile_loops(role, benches, parts)
    pump.warm_up()
