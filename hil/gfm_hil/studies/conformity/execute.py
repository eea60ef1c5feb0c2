"""The parts of all tests under all laws, on several processes: each is run, judged and drawn."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from gfm_hil.controllers import FORMS, PIL, check_currents, controller_file, precision, read_map
from gfm_hil.core import temporary as scratch
from gfm_hil.core.errors import UserError
from gfm_hil.engine.compiling import compile_external, compiled_bench, compiled_benches
from gfm_hil.recording.run import Run
from gfm_hil.run.runner import (
    external_command,
    run_in_memory,
    run_network_in_memory,
    run_scenario,
)
from gfm_hil.scenario.model import Link, Scenario
from gfm_hil.scenario.toml_out import write_scenario
from gfm_hil.studies.campaign.execute import WorkerLost, processes
from gfm_hil.studies.conformity.judge import PASS, Outcome, Verdict, cannot, judge, judge_nfp, worst
from gfm_hil.studies.conformity.model import Criterion, Declared, InEnvelope, Nfp, Part, UnderTest
from gfm_hil.studies.conformity.sets import Case, scenario_of
from gfm_hil.studies.envelopes import measure_unit
from gfm_hil.studies.identification import identify
from gfm_runtime import law_file
from gfm_runtime.inner_file import named_inner

if TYPE_CHECKING:
    from gfm_hil.results.figures import Picture

_POLL_S = 0.2


@dataclass(frozen=True)
class Foreign:
    """A model as the controller, in place of a law.

    Attributes:
        model: ``dll:FILE``, ``fmu:FILE`` or ``c:FILE``, or ``pil:TARGET`` for the law itself as
            firmware on a processor.
        ports: file of the map of its ports.
    """

    model: str
    ports: Path | None = None

    @property
    def name(self) -> str:
        """What reports call it: its kind and the name of its file, or of its target.

        Raises:
            UserError: there is no such file.
        """
        if self.model.startswith(PIL):
            return self.model
        kind, path = controller_file(self.model)
        return f"{kind}:{path.name}"


@dataclass(frozen=True)
class Job:
    """A part of a test under a law.

    Attributes:
        law, file: its name, and what a scenario calls it. Of a model: its name, and the law at
            whose operating point a run begins.
        case, part: what to run.
        inner: stage of every law; the law's own if None.
        under: the converter under test.
        converters: folder for converter files, which lasts while jobs run.
        folder: where the scenario and the figure go; None writes neither.
        figures: whether to draw one.
        foreign: the model that computes u in place of the law, or None.
    """

    law: str
    file: str
    case: Case
    part: Part
    inner: str | None
    under: UnderTest
    converters: Path
    folder: Path | None
    figures: bool
    foreign: Foreign | None = None

    @property
    def name(self) -> str:
        """Set, test and part, e.g. ``miso/2-rocof/down``."""
        return "/".join(x for x in (self.case.id, self.part.name) if x)


_CAUSES = {"no_trip": 0, "stays_in_step": 1}  # kinds of criteria


@dataclass(frozen=True)
class Found:
    """What became of a part of a test under a law.

    Attributes:
        law, test, part: names; the part of a test without parts is empty.
        status, reason: how the run ended; ``none`` if it did not take place.
        verdicts: one a clause and time.
        again: the command that repeats the run; empty if no scenario was written.
        figure: if one was drawn.
    """

    law: str
    test: str
    part: str
    status: str
    reason: str
    verdicts: list[Verdict]
    again: str = ""
    figure: Picture | None = None

    @property
    def verdict(self) -> Outcome:
        """The worst of the clauses; a part that did not run cannot be judged."""
        return worst([v.verdict for v in self.verdicts])

    @property
    def words(self) -> str:
        """What is wrong, a sentence for each clause that fails; empty if all passes."""
        texts = dict.fromkeys(v.text for v in self.wrong)
        return " ".join(texts) or ("" if self.verdict == PASS else self.reason)

    @property
    def wrong(self) -> list[Verdict]:
        """The clauses that make it not pass; the one first that says most about why: a trip, or a
        loss of step, explains whatever comes after it."""
        told = [v for v in self.verdicts if v.verdict == self.verdict != PASS]
        return sorted(told, key=lambda v: _CAUSES.get(v.kind, len(_CAUSES)))

    @property
    def cause(self) -> Verdict | None:
        """The first of ``wrong``; None if all pass or it did not run."""
        return next(iter(self.wrong), None)


def foreign_controller(model: str | None, ports: str | Path | None) -> Foreign | None:
    """The model that a user names, checked as far as that goes without loading it.

    Raises:
        UserError: there is no such file, the map is none, or there is a map but no model.
    """
    if model is None:
        if ports is not None:
            raise UserError(f"map {ports}: is of a controller; name it too")
        return None
    if model.startswith(PIL):
        if ports is not None:
            raise UserError(f"map {ports}: {model} has our signals, and takes no map")
        precision(model)
        return Foreign(model)
    kind, path = controller_file(model, FORMS)
    file = None if ports is None else Path(ports).absolute()
    read_map(file)
    return Foreign(f"{kind}:{path}", file)


def slug(name: str) -> str:
    """A name as that of a file."""
    return re.sub(r"[^\w.+-]+", "-", name.removesuffix(".toml")).strip("-")


def make_jobs(
    laws: Mapping[str, str],
    cases: Sequence[Case],
    inner: str | None,
    under: UnderTest,
    converters: Path,
    folder: Path | None,
    figures: bool,
    foreign: Foreign | None = None,
) -> list[Job]:
    """A job for each part of each test under each law, and then under the model.

    Args:
        laws: files by name. The model begins at the operating point of the first one, or, without
            laws, of the law that a scenario has by default.
        cases, inner, under, converters, folder, figures, foreign: as for ``Job``.

    Raises:
        UserError: the model measures currents, and its runs have no inner stage.
    """
    each: list[tuple[str, str, Foreign | None]] = [(*law, None) for law in laws.items()]
    if foreign is not None:
        start = next(iter(laws.values()), Scenario.model_fields["law"].default)
        stage = law_file(start).inner if inner is None else named_inner(inner)
        check_currents(foreign.name, stage is not None)
        each.append((foreign.name, start, foreign))
    return [
        Job(law, file, case, part, inner, under, converters, folder, figures, model)
        for law, file, model in each
        for case in cases
        for part in case.test.runs()
    ]


def execute(
    jobs: Sequence[Job],
    workers: int,
    keep: Callable[[Found], None],
    stopped: Callable[[], bool] = lambda: False,
    notice: Callable[[str], None] = lambda text: None,
) -> None:
    """Run all jobs, or until ``stopped``.

    Args:
        jobs: what to run.
        workers: processes; 1 runs all in this one.
        keep: given every finished part.
        stopped: asked after each part, or a few times a second.
        notice: told what a person should know while waiting.

    Raises:
        WorkerLost: a worker died, or a run raised an error.
    """
    if workers == 1:
        for job in jobs:
            if stopped():
                return
            keep(run_part(job))
        return
    _compile_once(jobs, notice)
    with ExitStack() as stack:
        pool: Executor = stack.enter_context(processes(workers))
        pending = {pool.submit(run_part, job): job for job in jobs}
        try:
            while pending and not stopped():
                done, _ = wait(pending, timeout=_POLL_S, return_when=FIRST_COMPLETED)
                for future in done:
                    _finish(future, pending.pop(future), keep)
        finally:
            for future in pending:
                future.cancel()


def _finish(future: Future[Found], job: Job, keep: Callable[[Found], None]) -> None:
    problem = future.exception()
    if problem is not None:
        words = f"{job.law}, {job.name}: {type(problem).__name__}: {problem}"
        raise WorkerLost(words) from problem
    keep(future.result())


def _compile_once(jobs: Sequence[Job], notice: Callable[[str], None]) -> None:
    """Fill numba's cache here, so that workers need not all compile the same."""
    seen: set[tuple[bool, int, bool]] = set()
    for job in jobs:
        if job.part.cannot is not None:
            continue
        try:
            scenario = _scenario(job)
            kind = scenario.has_inner, len(scenario.converters), job.foreign is not None
            if kind in seen:
                continue
            if job.foreign is not None:
                compiled_bench(scenario, notice, ("plant",))
                compile_external(scenario, notice)
            else:
                (compiled_bench if scenario.network is None else compiled_benches)(scenario, notice)
            seen.add(kind)
        except UserError:  # which the verdict will say
            continue


def _scenario(job: Job) -> Scenario:
    """The scenario of a job.

    Raises:
        UserError: it cannot be run.
    """
    found = scenario_of(job.case, job.part, job.under, job.file, job.inner, job.converters)
    if job.foreign is None:
        return found
    if found.network is not None:
        raise UserError(f"{job.law} is one controller, and the test's network has several")
    return found.model_copy(update={"link": Link(type="shm")})


def run_part(job: Job) -> Found:
    """Run, judge and draw a part; what cannot be run cannot be judged."""
    test, part = job.case.test, job.part
    criteria = [*test.criteria, *part.criteria]
    names = job.law, job.case.id, part.name
    if part.cannot is not None:
        reason = f"Cannot be judged: {part.cannot}"
        return Found(*names, "none", reason, cannot(criteria, reason))
    if isinstance(criteria[0], Nfp):
        return _plot(job, criteria[0])
    with ExitStack() as stack:
        try:
            scenario = _scenario(job)
            run, others = _run(job, scenario, stack)
        except UserError as problem:
            return _no_run(job, criteria, problem)
        verdicts = judge(run, criteria, _declared(job, scenario, criteria), others)
        again, figure = "", None
        if job.folder is not None:
            place = _place(job.folder, job, scenario)
            again = _again(place, job.foreign)
            if job.figures and run.ticks:
                from gfm_hil.studies.conformity.figure import draw_part  # half a second to import

                figure = draw_part(place / "figure.png", _title(job, scenario), run, verdicts)
        reason = str(run.summary["reason"])
        return Found(*names, run.status, reason, verdicts, again, figure)


def _declared(job: Job, scenario: Scenario, criteria: Sequence[Criterion]) -> UnderTest:
    """What the owner declares, with the unit that is measured where it is asked for."""
    under = job.under
    if under.unit is not None or not any(isinstance(c, InEnvelope) for c in criteria):
        return under
    if job.foreign is not None:  # which runs over a link alone
        return under
    try:
        found = measure_unit(None, scenario)
    except UserError:
        return under
    unit = Declared(D=found.D, H=found.H, X_eff=found.X_eff)
    return under.model_copy(update={"unit": unit})


def _plot(job: Job, asked: Nfp) -> Found:
    """Measure, judge and draw a network-frequency-perturbation plot."""
    foreign = job.foreign
    try:
        scenario = _scenario(job)
        found = identify(
            None, scenario, start_hz=asked.from_hz, stop_hz=asked.to_hz, points=asked.points,
            controller_command=external_command(foreign.model, foreign.ports) if foreign else (),
        )  # fmt: skip
    except UserError as problem:
        return _no_run(job, [asked], problem)
    again, figure = "", None
    if job.folder is not None:
        place = _place(job.folder, job, scenario)
        if foreign is None:
            again = shlex.join(
                ["gfmhil", "identify", str(place / "scenario.toml"), "--from", f"{asked.from_hz:g}",
                 "--to", f"{asked.to_hz:g}", "--points", str(asked.points)]
            )  # fmt: skip
        if job.figures:
            from gfm_hil.studies.conformity.figure import draw_plot

            figure = draw_plot(place / "figure.png", _title(job, scenario), found, asked)
    verdicts = judge_nfp(found.frequency, found.nfp, asked)
    return Found(job.law, job.case.id, job.part.name, "completed", "", verdicts, again, figure)


def _no_run(job: Job, criteria: Sequence[Criterion], problem: UserError) -> Found:
    text = str(problem).replace("\n", "; ").replace(job.file, job.law)
    reason = f"Cannot be judged: there is no such run: {text}"
    told = cannot(criteria, reason)
    return Found(job.law, job.case.id, job.part.name, "none", reason, told)


def _title(job: Job, scenario: Scenario) -> str:
    return f"{job.law} · {job.name} · {scenario.title}"


def _place(folder: Path, job: Job, scenario: Scenario) -> Path:
    """The folder of a part, with its scenario."""
    place = folder / "runs" / slug(job.law) / slug(job.name)
    place.mkdir(parents=True, exist_ok=True)
    write_scenario(place, scenario)
    return place


def _again(place: Path, foreign: Foreign | None) -> str:
    """The command that repeats the run of the scenario in a folder."""
    words = ["gfmhil", "run", str(place / "scenario.toml")]
    if foreign is not None:
        words += ["--controller", foreign.model]
        words += ["--map", str(foreign.ports)] if foreign.ports else []
    return shlex.join(words)


def _run(job: Job, scenario: Scenario, stack: ExitStack) -> tuple[Run, Mapping[str, Run]]:
    """The run that is judged, and those of the other converters.

    Args:
        stack: keeps what a run of a model is read from.
    """
    if job.foreign is not None:
        folder = stack.enter_context(scratch.temporary("gfmhil-conform-")) / "run"
        command = external_command(job.foreign.model, job.foreign.ports)
        run = run_scenario(scenario, folder, controller_command=command)
        if run.status == "interrupted":
            raise KeyboardInterrupt
        return run, {}
    if scenario.network is None:
        return run_in_memory(scenario), {}
    runs = run_network_in_memory(scenario)
    name = job.case.test.judged or scenario.converters[0]
    return runs[name], {other: run for other, run in runs.items() if other != name}
