"""A whole run: one process or two, and a run folder in the end, however it ended."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from gfm_hil.controllers import ControllerProtocol, PilController
from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.core.stopping import Interrupt
from gfm_hil.engine.compiling import compiled_bench, compiled_benches
from gfm_hil.engine.inproc import run_inproc
from gfm_hil.engine.process import run_role
from gfm_hil.engine.processes import Processes, Progress
from gfm_hil.engine.setup import Bench, make_bench, make_benches
from gfm_hil.engine.timeline import Timeline, TimelineInMemory
from gfm_hil.recording.columns import ColumnLike
from gfm_hil.recording.log import Outcome
from gfm_hil.recording.merge import known_laws, laws_used
from gfm_hil.recording.parts import Kept, RolePart, remove_parts
from gfm_hil.recording.run import Run
from gfm_hil.run.network_run import NetworkRun
from gfm_hil.run.run_folder import Report, check_free, cut_short, finish, in_use
from gfm_hil.run.summary import origin, stages, summarise
from gfm_hil.scenario import Scenario, write_scenario

Notice = Callable[[str], None]


def run_scenario(
    scenario: Scenario,
    folder: Path,
    progress: Progress = lambda ticks, misses: None,
    notice: Notice = lambda text: None,
    report: Report | None = None,
    controller_command: Sequence[str] = (),
) -> Run:
    """Run a scenario and leave a run folder.

    Args:
        scenario: checked, from ``load_scenario``.
        folder: where to write; new or empty.
        progress: told how far the run is.
        notice: told what a person should know while waiting.
        report: draws the figures and writes report.html, as ``results.report.write_report``
            does; None for a folder without them.
        controller_command: program and arguments of another controller instead of ours, for a
            link that is none of ``inproc``; see ``Processes``. Here ``{folder}`` becomes the run
            folder.

    Raises:
        UserError: the folder is in use, no operating point, an endpoint that is occupied. The
            folder is then left as it was.
    """
    check_free(folder, scenario.ticks, scenario.has_inner)
    # here, so that two processes do not compile the same at a time
    bench = compiled_bench(scenario, notice, ("plant",) if controller_command else ROLES)
    folder.mkdir(parents=True, exist_ok=True)
    with in_use(folder), cut_short(folder):
        outside: dict[str, Outcome] = {}
        try:
            with Interrupt() as interrupt:
                try:
                    write_scenario(folder, scenario)
                except OSError as problem:
                    raise UserError(f"{folder}: {problem.strerror}") from None
                if scenario.in_process:
                    began = _run_here([bench], [folder], progress, interrupt)
                else:
                    own = str(folder.absolute())
                    command = tuple(x.replace("{folder}", own) for x in controller_command)
                    both = Processes(scenario, folder, progress, notice, interrupt, command)
                    began, outside = both.run()
        except UserError:
            remove_parts(folder)
            shutil.rmtree(folder)
            raise
        wall_s = time.monotonic() - began
        labels = bench.controller.labels
        return finish(scenario, folder, labels, wall_s, report, outside.get(""))


def external_command(model: str, ports: Path | None) -> list[str]:
    """The ``controller_command`` of a run whose controller steps a model in place of the law.

    Args:
        model: ``dll:FILE``, ``fmu:FILE`` or ``c:FILE``.
        ports: file of the map of its ports.
    """
    command = [sys.executable, "-P", "-m", "gfm_hil", "controller", "{scenario}"]
    command += ["--endpoint", "{endpoint}", "--out", "{folder}", "--quiet"]
    command += ["--part", "--model", model]
    return command + (["--map", str(ports.absolute())] if ports else [])


def run_network(
    scenario: Scenario,
    folder: Path,
    progress: Progress = lambda ticks, misses: None,
    notice: Notice = lambda text: None,
    report: Report | None = None,
) -> NetworkRun:
    """Run a scenario with a network and leave a folder with a run folder for each converter.

    Args:
        scenario, folder, progress, notice, report: as for ``run_scenario``.

    Raises:
        UserError: the folder is in use, or there is no operating point.
    """
    names = scenario.converters
    check_free(folder, scenario.ticks * len(names), scenario.has_inner)
    benches = compiled_benches(scenario, notice)
    runs: dict[str, Run] = {}
    folder.mkdir(parents=True, exist_ok=True)
    write_scenario(folder, scenario)
    places = [folder / name for name in names]
    with ExitStack() as stack:
        stack.enter_context(cut_short(folder))
        for place, bench in zip(places, benches, strict=True):
            place.mkdir(parents=True, exist_ok=True)
            stack.enter_context(in_use(place))
            write_scenario(place, bench.scenario)
        interrupt = stack.enter_context(Interrupt())
        outside: dict[str, Outcome] = {}
        if scenario.in_process:
            began = _run_here(benches, places, progress, interrupt)
        else:
            try:
                began, outside = Processes(scenario, folder, progress, notice, interrupt).run()
            except UserError:
                for place in places:
                    remove_parts(place)
                shutil.rmtree(folder)
                raise
        wall_s = time.monotonic() - began
        for name, place, bench in zip(names, places, benches, strict=True):
            labels = bench.controller.labels
            runs[name] = finish(bench.scenario, place, labels, wall_s, report, outside.get(name))
        whole = NetworkRun(scenario, runs, folder)
        whole.conclude(folder, report)
    return whole


def run_side(
    role: Role,
    scenario: Scenario,
    folder: Path,
    endpoints: Mapping[str, str],
    notice: Notice = lambda text: None,
    report: Report | None = None,
    external: ControllerProtocol | PilController | None = None,
) -> Run | NetworkRun:
    """Run one side alone, whose peer another process or machine runs, and leave a run folder of
    what it recorded, or one for each converter of a network.

    Args:
        role: the side.
        scenario, folder, notice, report: as for ``run_scenario``.
        endpoints: by converter, in place of the scenario's.
        external: computes u in place of the law.

    Raises:
        UserError: the folder is in use, no operating point, an endpoint that is occupied.
    """
    places = _places(scenario, folder)
    check_free(folder, scenario.ticks * len(places), scenario.has_inner)
    if scenario.parts:
        benches = compiled_benches(scenario, notice, (role,))
    else:
        benches = [compiled_bench(scenario, notice, (role,))]
    for place in places.values():
        place.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    with ExitStack() as stack:
        for place in places.values():
            stack.enter_context(in_use(place))
        stack.enter_context(cut_short(folder))
        run_role(role, scenario, folder, dict(endpoints), notice, external)
        wall_s = time.monotonic() - began
        runs = {
            name: finish(bench.scenario, place, bench.controller.labels, wall_s, report)
            for bench, (name, place) in zip(benches, places.items(), strict=True)
        }
    if not scenario.parts:
        return runs[""]
    whole = NetworkRun(scenario, runs, folder)
    whole.conclude(folder, report)
    return whole


def run_part(
    role: Role,
    scenario: Scenario,
    folder: Path,
    endpoints: Mapping[str, str],
    external: ControllerProtocol | PilController | None,
) -> None:
    """Run one side in the folder of a run that another process has started and completes."""
    with ExitStack() as stack:
        for place in _places(scenario, folder).values():
            stack.enter_context(in_use(place))
        run_role(role, scenario, folder, dict(endpoints), lambda text: None, external)


def _places(scenario: Scenario, folder: Path) -> dict[str, Path]:
    """The run folder of each converter, "" for the only one of a scenario without a network."""
    return {name: folder / name for name in scenario.parts} or {"": folder}


def _run_here(
    benches: Sequence[Bench], places: Sequence[Path], progress: Progress, interrupt: Interrupt
) -> float:
    """Run both sides of each converter in this process; returns when the first tick was run."""
    ticks, inner = benches[0].scenario.ticks, benches[0].inner
    plant_parts = [RolePart.create(place, "plant", ticks, inner) for place in places]
    controller_parts = [RolePart.create(place, "controller", ticks, inner) for place in places]
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


def run_in_memory(scenario: Scenario, kept: tuple[Kept, Kept] | None = None) -> Run:
    """Run a scenario in this process and leave nothing on the disk.

    Args:
        scenario: checked; its link and mode do not matter.
        kept: what to record into, the plant's and the controller's columns, at least
            ``summary.READ`` of them. The run's columns lie in there, so they are good until the
            next run in the same room. None: new room for all columns.

    Raises:
        UserError: the scenario has no operating point.
    """
    bench = make_bench(scenario)
    (run,) = _in_memory([bench], [kept or _room(bench)])
    return run


def run_network_in_memory(scenario: Scenario) -> NetworkRun:
    """Run a scenario with a network in this process and leave nothing on the disk.

    Raises:
        UserError: the scenario has no operating point.
    """
    benches = make_benches(scenario)
    runs = _in_memory(benches, [_room(bench) for bench in benches])
    return NetworkRun(scenario, dict(zip(scenario.converters, runs, strict=True)))


def _room(bench: Bench) -> tuple[Kept, Kept]:
    """Room for all columns of a bench."""
    ticks, inner = bench.scenario.ticks, bench.inner
    return Kept("plant", ticks, inner), Kept("controller", ticks, inner)


def _in_memory(benches: Sequence[Bench], kept: Sequence[tuple[Kept, Kept]]) -> list[Run]:
    """Run benches; the runs' columns are those kept."""
    plants, controllers = zip(*kept, strict=True)
    timelines = [TimelineInMemory(bench) for bench in benches]
    began, date = time.monotonic(), time.time()
    with np.errstate(all="ignore"):  # a diverging run is a result
        done = run_inproc(benches, plants, controllers, timelines, lambda ticks: True)
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
        columns |= plant.named(done) | controller.named(done)
        outcome = timeline.outcome or Outcome("safe", "the run did not record its end", done)
        summary = summarise(scenario, columns, {}, timeline.lines, outcome, {}, wall_s)
        summary |= stages(scenario) | origin(scenario, date)
        laws = known_laws(bench.controller.labels, laws_used(columns["law"][:]))
        runs.append(Run(scenario, summary, columns, laws, timeline.lines))
    return runs
