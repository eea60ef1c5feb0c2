"""A whole run: one process or two, and a run folder in the end, however it ended."""

import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import MappingProxyType

import numpy as np

from gfm_hil.controllers import (
    FORMS,
    PIL,
    ExternalController,
    check_currents,
    controller_file,
    precision,
    read_map,
)
from gfm_hil.core.errors import UserError, naming
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.core.stopping import Interrupt
from gfm_hil.engine.compiling import compile_external, compiled_benches
from gfm_hil.engine.inproc import Converters, Steps, drive, run_inproc, run_steps
from gfm_hil.engine.process import run_role
from gfm_hil.engine.processes import Processes, Progress
from gfm_hil.engine.setup import ONE_CONVERTER, Bench, make_benches
from gfm_hil.engine.timeline import Timeline, TimelineInMemory
from gfm_hil.recording.columns import ColumnLike, ColumnSet
from gfm_hil.recording.log import Outcome
from gfm_hil.recording.merge import known_laws, laws_used
from gfm_hil.recording.parts import MemoryPart, RolePart, remove_parts
from gfm_hil.recording.run import Run
from gfm_hil.run.network_run import NetworkRun
from gfm_hil.run.run_folder import Report, check_free, cut_short, finish, in_use
from gfm_hil.run.summary import origin, stages, summarise
from gfm_hil.scenario import INPROC, Scenario, write_scenario
from gfm_runtime.children import module

Notice = Callable[[str], None]


def run_scenario(
    scenario: Scenario,
    folder: Path,
    progress: Progress = lambda ticks, misses: None,
    notice: Notice = lambda text: None,
    report: Report | None = None,
    controller_command: Sequence[str] = (),
) -> Run:
    """Run a scenario and leave a run folder. Raises UserError: the folder is in use, no operating
    point, an endpoint that is occupied. The folder is then left as it was.

    Args:
        scenario: checked, from ``load_scenario``.
        folder: where to write; new or empty.
        progress: told how far the run is.
        notice: told what a person should know while waiting.
        report: draws the figures and writes report.html, as ``results.report.write_report``
            does; None for a folder without them.
        controller_command: program and arguments of another controller instead of ours, for a
            link that is none of ``inproc``; see ``Processes``.
    """
    if scenario.parts:
        raise UserError(ONE_CONVERTER)
    commands = {"": controller_command} if controller_command else {}
    return _run(scenario, folder, progress, notice, report, commands)[""]


def controller_program(
    scenario: Scenario, controller: str | None, ports: str | Path | None, notice: Notice
) -> list[str]:
    """The ``controller_command`` of a run whose controller steps a model in place of the law, or
    runs the laws on another processor; empty without one. Raises UserError: there is no such
    controller or map, or the run is in process, has no operating point, or does not carry what it
    measures.

    Args:
        scenario: of the run.
        controller: ``dll:FILE``, ``fmu:FILE``, ``c:FILE`` or ``pil:TARGET``.
        ports: file of the map of its ports.
        notice: as for ``run_scenario``.
    """
    if controller is None:
        if ports is not None:
            raise UserError("a port map is for an external controller; name the controller too")
        return []
    if scenario.link.type == INPROC:
        raise UserError(
            "an external controller is a process, which a run in process has not; choose a link"
        )
    real = precision(controller)
    if not controller.startswith(PIL):
        controller_file(controller, FORMS)
    places = None if ports is None else Path(ports)
    read_map(places)
    check_currents(controller, scenario.signal_set)
    compile_external(scenario, notice, real)
    return external_command(controller, places)


def external_command(model: str, ports: Path | None) -> list[str]:
    """The ``controller_command`` of a run whose controller steps a model in place of the law.

    Args:
        model: ``dll:FILE``, ``fmu:FILE`` or ``c:FILE``.
        ports: file of the map of its ports.
    """
    words = ["controller", "{scenario}", "--endpoint", "{endpoint}", "--out", "{folder}"]
    words += ["--quiet", "--part", "--model", model]
    return module("gfm_hil", *words, *(["--map", str(ports.absolute())] if ports else []))


def run_network(
    scenario: Scenario,
    folder: Path,
    progress: Progress = lambda ticks, misses: None,
    notice: Notice = lambda text: None,
    report: Report | None = None,
    controller_commands: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> NetworkRun:
    """Run a scenario with a network and leave a folder with a run folder for each converter. Raises
    UserError: the folder is in use, or there is no operating point.

    Args:
        scenario, folder, progress, notice, report: as for ``run_scenario``.
        controller_commands: by converter, as ``controller_command`` there.
    """
    runs = _run(scenario, folder, progress, notice, report, controller_commands)
    return NetworkRun(scenario, runs, folder).conclude(folder, report)


def _run(
    scenario: Scenario,
    folder: Path,
    progress: Progress,
    notice: Notice,
    report: Report | None,
    controller_commands: Mapping[str, Sequence[str]],
) -> dict[str, Run]:
    """Run both sides of each converter, and complete their run folders."""

    def work(benches: Sequence[Bench], places: Mapping[str, Path]) -> _Outcomes:
        try:
            with Interrupt() as interrupt:
                with naming(folder):
                    write_scenario(folder, scenario)
                    for name, bench in zip(scenario.parts, benches, strict=False):
                        write_scenario(places[name], bench.scenario)
                if scenario.in_process:
                    return _run_here(benches, [*places.values()], progress, interrupt), {}
                return Processes(
                    scenario, folder, progress, notice, interrupt, controller_commands
                ).run()
        except UserError:
            for place in places.values():
                remove_parts(place)
            shutil.rmtree(folder)
            raise

    ours = len(controller_commands) < max(1, len(scenario.parts))
    roles: Sequence[Role] = ROLES if ours else ("plant",)
    return _record(scenario, folder, roles, notice, report, work)


#: when the first tick ran (``time.monotonic``), and by converter how its run ended as seen from
#: outside the sides
_Outcomes = tuple[float, Mapping[str, Outcome]]


def _record(
    scenario: Scenario,
    folder: Path,
    roles: Sequence[Role],
    notice: Notice,
    report: Report | None,
    work: Callable[[Sequence[Bench], Mapping[str, Path]], _Outcomes],
) -> dict[str, Run]:
    """Have ``work`` run the benches of some roles in the folders of a run, and complete them."""
    places = _places(scenario, folder)
    check_free(folder, scenario.ticks, ColumnSet.of(scenario), len(places))
    # here, so that two processes do not compile the same at a time
    benches = compiled_benches(scenario, notice, roles)
    with ExitStack() as stack:
        for place in places.values():
            place.mkdir(parents=True, exist_ok=True)
            stack.enter_context(in_use(place))
        stack.enter_context(cut_short(folder))
        began, outside = work(benches, places)
        wall_s = time.monotonic() - began
        return {
            name: finish(
                bench.scenario, place, bench.controller.labels, wall_s, report, outside.get(name)
            )
            for bench, (name, place) in zip(benches, places.items(), strict=True)
        }


def run_side(
    role: Role,
    scenario: Scenario,
    folder: Path,
    endpoints: Mapping[str, str],
    notice: Notice = lambda text: None,
    report: Report | None = None,
    external: ExternalController | None = None,
) -> Run | NetworkRun:
    """Run one side alone, whose peer another process or machine runs, and leave a run folder of
    what it recorded, or one for each converter of a network. Raises UserError: the folder is in
    use, no operating point, an endpoint that is occupied.

    Args:
        role: the side.
        scenario, folder, notice, report: as for ``run_scenario``.
        endpoints: by converter, in place of the scenario's.
        external: computes u in place of the law.
    """

    def work(benches: Sequence[Bench], places: Mapping[str, Path]) -> _Outcomes:
        began = time.monotonic()
        run_role(role, scenario, folder, endpoints, notice, external)
        return began, {}

    runs = _record(scenario, folder, (role,), notice, report, work)
    if scenario.parts:
        return NetworkRun(scenario, runs, folder).conclude(folder, report)
    return runs[""]


def run_part(
    role: Role,
    scenario: Scenario,
    folder: Path,
    endpoints: Mapping[str, str],
    external: ExternalController | None,
) -> None:
    """Run one side in the folder of a run that another process has started and completes."""
    with ExitStack() as stack:
        for place in _places(scenario, folder).values():
            stack.enter_context(in_use(place))
        run_role(role, scenario, folder, endpoints, lambda text: None, external)


def _places(scenario: Scenario, folder: Path) -> dict[str, Path]:
    """The run folder of each converter, "" for the only one of a scenario without a network."""
    return {name: folder / name for name in scenario.parts} or {"": folder}


def _run_here(
    benches: Sequence[Bench], places: Sequence[Path], progress: Progress, interrupt: Interrupt
) -> float:
    """Run both sides of each converter in this process; returns when the first tick was run."""
    plant_parts, controller_parts = (
        [
            RolePart.create(place, role, bench.scenario.ticks, bench.columns)
            for place, bench in zip(places, benches, strict=True)
        ]
        for role in ("plant", "controller")
    )
    timelines = [
        Timeline(bench, place / "events_both.jsonl", ROLES)
        for bench, place in zip(benches, places, strict=True)
    ]
    began = time.monotonic()

    def go_on(ticks: int) -> bool:
        progress(ticks, 0)
        return not interrupt.came

    run_inproc(benches, plant_parts, controller_parts, timelines, go_on)
    for timeline in timelines:
        timeline.close()
    return began


def run_in_memory(
    scenario: Scenario,
    kept: tuple[MemoryPart, MemoryPart] | None = None,
    notice: Notice | None = None,
) -> Run:
    """Run a scenario in this process and leave nothing on the disk. Raises UserError: the scenario
    has no operating point.

    Args:
        scenario: checked; its link and mode do not matter.
        kept: what to record into, the plant's and the controller's columns, at least
            ``summary.READ`` of them. The run's columns lie in there, so they are good until the
            next run in the same room. None: new room for all columns.
        notice: is called with what is compiled meanwhile; None: each function is compiled when it
            is first called, without a word.
    """
    if scenario.parts:
        raise UserError(ONE_CONVERTER)
    benches = _benches(scenario, notice)
    with np.errstate(all="ignore"):  # a diverging run is a result
        (run,) = drive(memory_steps(benches, [kept] if kept else make_room(benches)))
    return run


def run_network_in_memory(scenario: Scenario, notice: Notice | None = None) -> NetworkRun:
    """Run a scenario with a network in this process and leave nothing on the disk; ``notice`` as of
    ``run_in_memory``. Raises UserError: the scenario has no operating point."""
    benches = _benches(scenario, notice)
    with np.errstate(all="ignore"):
        runs = drive(memory_steps(benches, make_room(benches)))
    return NetworkRun(scenario, dict(zip(scenario.converters, runs, strict=True)))


def _benches(scenario: Scenario, notice: Notice | None) -> list[Bench]:
    return make_benches(scenario) if notice is None else compiled_benches(scenario, notice)


def make_room(benches: Sequence[Bench]) -> list[tuple[MemoryPart, MemoryPart]]:
    """Room for all columns of the benches of a run, of the plant and of the controller each."""
    whats = [(bench.scenario.ticks, bench.columns) for bench in benches]
    return [(MemoryPart("plant", *what), MemoryPart("controller", *what)) for what in whats]


def memory_steps(
    benches: Sequence[Bench], kept: Sequence[tuple[MemoryPart, MemoryPart]]
) -> Steps[list[Run]]:
    """Run the benches of a scenario step by step; the runs' columns are those kept. Raises
    UserError: a snapshot has no place."""
    if benches[0].scenario.snapshot is not None:
        raise UserError("snapshot: is kept in a run folder, and a run in memory has none")
    plants, controllers = zip(*kept, strict=True)
    timelines = [TimelineInMemory(bench) for bench in benches]
    began, date = time.monotonic(), time.time()
    whole = Converters(benches, plants, controllers, timelines)
    done = yield from run_steps(whole)
    wall_s = time.monotonic() - began
    runs = []
    for bench, plant, controller, timeline in zip(
        benches, plants, controllers, timelines, strict=True
    ):
        timeline.close()
        scenario = bench.scenario
        columns: dict[str, ColumnLike] = {
            "tick": np.arange(done),
            "t": np.arange(done) * scenario.T_s,
        }
        columns |= plant.by_name(done) | controller.by_name(done)
        outcome = timeline.outcome or Outcome("safe", "the run did not record its end", done)
        summary = summarise(scenario, columns, {}, timeline.lines, outcome, {}, wall_s)
        summary |= stages(scenario) | origin(scenario, date)
        laws = known_laws(bench.controller.labels, laws_used(columns["law"][:]))
        runs.append(Run(scenario, summary, columns, laws, timeline.lines))
    return runs
