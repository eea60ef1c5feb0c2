"""The parts of all tests under all laws, on several processes: each is run, judged and drawn."""

import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gfm_hil import controllers
from gfm_hil.core import temporary as scratch
from gfm_hil.core.errors import UserError
from gfm_hil.engine.compiling import compile_external, compiled_benches
from gfm_hil.recording.run import Run
from gfm_hil.run import runner
from gfm_hil.scenario import LinkSettings, Scenario, write_scenario
from gfm_hil.studies.conformity.criteria import BY_KIND
from gfm_hil.studies.conformity.criteria.base import UnderTest, cannot_judge, judge, own_droop
from gfm_hil.studies.conformity.criteria.plot import Plot
from gfm_hil.studies.conformity.in_network import NetworkUnderTest
from gfm_hil.studies.conformity.panels import PartFigure, panels_of_plot, panels_of_run
from gfm_hil.studies.conformity.saturation import mark_saturation
from gfm_hil.studies.conformity.sets import Case, TestPart, scenario_of
from gfm_hil.studies.conformity.shared_start import SharedStart, after_settling, alike, first_event
from gfm_hil.studies.conformity.verdict import CANNOT, FAIL, PASS, Outcome, Verdict, worst
from gfm_hil.studies.workers import Pool, RunFailed, Watch, WorkerLost, pool_of, run_tasks
from gfm_runtime import get_law, law_file


@dataclass(frozen=True)
class ControllerUnderTest:
    """A model as the controller, in place of a law."""

    # ``dll:FILE``, ``fmu:FILE`` or ``c:FILE``, or ``pil:TARGET`` for the law itself as firmware
    # on a processor
    model: str
    ports: Path | None = None  # file of the map of its ports

    @property
    def command(self) -> list[str]:
        """The program that steps it."""
        return runner.external_command(self.model, self.ports)

    @property
    def map(self) -> controllers.PortMap:
        """The map of its ports."""
        return controllers.read_map(self.ports)

    @property
    def name(self) -> str:
        """What reports call it: its kind and the name of its file, or of its target. Raises
        UserError: there is no such file."""
        if self.model.startswith(controllers.PIL):
            return self.model
        kind, path = controllers.controller_file(self.model)
        return f"{kind}:{path.name}"


@dataclass(frozen=True)
class Job:
    """A part of a test under a law."""

    # law, file: its name, and what a scenario calls it. Of a model: its name, and the law at
    # whose operating point a run begins
    law: str
    file: str
    case: Case  # case, part: what to run
    part: TestPart
    inner: str | None  # stage of every law; the law's own if None
    under: UnderTest  # the converter under test
    converters: Path  # folder for converter files, which lasts while jobs run
    folder: Path | None  # where the scenario and the figure go; None writes neither
    figures: bool  # whether to draw one
    # the model that computes u in place of the law, or None
    external: ControllerUnderTest | None = None
    start: SharedStart | None = None  # that of a model's run, which others have too
    network: NetworkUnderTest | None = None  # over which the test is laid, or None

    @property
    def judged(self) -> str:
        """In a network: the converter whose signals are judged; the first one if empty."""
        return self.network.judged if self.network is not None else self.case.test.judged or ""

    @property
    def name(self) -> str:
        """Set, test and part, e.g. ``miso/2-rocof/down``."""
        return "/".join(x for x in (self.case.id, self.part.name) if x)


@dataclass(frozen=True)
class PartResult:
    """What became of a part of a test under a law."""

    law: str  # law, test, part: names; the part of a test without parts is empty
    test: str
    part: str
    status: str  # status, reason: how the run ended; ``none`` if it did not take place
    reason: str
    verdicts: list[Verdict]  # one a clause and time
    again: str = ""  # the command that repeats the run; empty if no scenario was written
    recording: str = ""  # SHA-256 of all that the run recorded; empty of a plot
    figure: PartFigure | None = None  # if one was drawn

    def plain(self) -> dict[str, Any]:
        """As data for JSON."""
        return {
            "part": self.part,
            "verdict": self.verdict,
            "status": self.status,
            "reason": self.reason,
            "recording": self.recording,
            "cause": self.cause and {"clause": self.cause.clause, "text": self.cause.text},
            "clauses": [v.plain() for v in self.verdicts],
        }

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
        return sorted(told, key=lambda v: BY_KIND[v.kind].explains)

    @property
    def cause(self) -> Verdict | None:
        """The first of ``wrong``; None if all pass or it did not run."""
        return next(iter(self.wrong), None)


def external_controller(model: str | None, ports: str | Path | None) -> ControllerUnderTest | None:
    """The model that a user names, checked as far as that goes without loading it. Raises
    UserError: there is no such file, the map is none, or there is a map but no model."""
    if model is None:
        if ports is not None:
            raise UserError(f"map {ports}: is of a controller; name it too")
        return None
    if model.startswith(controllers.PIL):
        if ports is not None:
            raise UserError(f"map {ports}: {model} has our signals, and takes no map")
        controllers.precision(model)
        return ControllerUnderTest(model)
    kind, path = controllers.controller_file(model, controllers.FORMS)
    file = None if ports is None else Path(ports).absolute()
    controllers.read_map(file)
    return ControllerUnderTest(f"{kind}:{path}", file)


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
    external: ControllerUnderTest | None = None,
    network: NetworkUnderTest | None = None,
) -> list[Job]:
    """A job for each part of each test under each law, and then under the model, which begins at
    the operating point of the first law or, without laws, of that which a scenario has by default.
    Raises UserError: the model measures currents, and its runs have no inner stage."""
    each: list[tuple[str, str, ControllerUnderTest | None]] = [(*law, None) for law in laws.items()]
    if external is not None:
        start = next(iter(laws.values()), Scenario.model_fields["law"].default)
        stage = law_file(start).behind(inner).inner
        controllers.check_currents(external.name, stage is not None)
        each.append((external.name, start, external))
    declared = {file: declared_for(under, file) for _, file, _ in each}
    return [
        Job(
            law,
            file,
            case,
            part,
            inner,
            declared[file],
            converters,
            folder,
            figures,
            model,
            network=network,
        )
        for law, file, model in each
        for case in cases
        for part in case.test.runs()
    ]


def declared_for(under: UnderTest, law: str) -> UnderTest:
    """What the owner declares, with the droop of a law if none is; of a model that of the law at
    whose operating point it begins."""
    if under.droop is not None:
        return under
    return under.model_copy(update={"droop": own_droop(get_law(law))})


def execute(
    jobs: Sequence[Job], workers: int | str, digest: Callable[[], object], watch: Watch
) -> list[PartResult]:
    """What becomes of all jobs. Raises UserError: so many workers cannot be, or those of a cluster
    see other files. Raises WorkerLost: workers died, or a run raised an error. Raises
    KeyboardInterrupt: the watch stopped it before its end.

    Args:
        jobs: of one report.
        workers: as of ``pool_of``.
        digest: over the files on which the report rests.
        watch: of the runs.
    """
    found: list[PartResult] = []

    def keep(one: PartResult) -> None:
        found.append(one)
        bad = sum(f.verdict in (FAIL, CANNOT) for f in found)
        words = f"{one.law}: {one.test}" + (f", {bad} not passed" if bad else "")
        watch.progress(len(found), len(jobs), words)

    lost = None
    try:
        with pool_of(workers) as pool, scratch.temporary("gfmhil-starts-") as place:
            pool.check_equal(digest)
            for folder in {job.folder or job.converters for job in jobs}:
                pool.check_shared(folder)
            if pool.is_local:
                if pool.workers > 1:
                    compile_once(jobs, watch.notice)
                jobs = share_starts(jobs, place, pool, watch)
            run_tasks(run_part, jobs, pool, keep, watch)
    except WorkerLost as problem:
        lost = problem
    except KeyboardInterrupt:  # of a second signal: the runs under way are lost
        if not watch.stopped():
            raise
    if len(found) < len(jobs):
        done = f"{len(found)} of {len(jobs)} runs were done; there is no report"
        raise WorkerLost(f"{lost}; {done}") if lost else KeyboardInterrupt(f"interrupted; {done}")
    return found


def share_starts(jobs: Sequence[Job], place: Path, pool: Pool, watch: Watch) -> list[Job]:
    """The jobs, those of a model that begin alike with one start, which is run here.

    Args:
        place: folder for these starts, which lasts while jobs run.
        pool: which uses that folder too.
        watch: of the runs.
    """
    groups: dict[str, list[tuple[int, Scenario]]] = {}
    for k, job in enumerate(jobs):
        if job.external is not None and job.part.cannot is None and _plot(job) is None:
            with suppress(UserError):  # which the verdict will say
                scenario = _scenario(job)
                groups.setdefault(alike(scenario), []).append((k, scenario))
    starts: list[tuple[SharedStart, Sequence[int]]] = []
    for n, group in enumerate(group for group in groups.values() if len(group) > 1):
        members, scenarios = zip(*group, strict=True)
        ticks, external = min(map(first_event, scenarios)), jobs[members[0]].external
        if ticks > 0 and external is not None:
            start = SharedStart(scenarios[0], ticks, place / f"{n}", tuple(external.command))
            starts.append((start, members))
    if not starts:
        return [*jobs]
    shared = sum(len(members) for _, members in starts)
    watch.notice(f"running what {shared} runs begin with, once …")
    good = set[Path | None]()
    begins = [start for start, _ in starts]
    run_tasks(SharedStart.make, begins, pool, good.add, watch)
    if {start.folder for start in begins} - good and not watch.stopped():
        watch.notice("the model does not go on from a snapshot: each of its runs settles anew")
    of = {k: start for start, members in starts if start.folder in good for k in members}
    return [replace(job, start=of.get(k)) for k, job in enumerate(jobs)]


def compile_once(jobs: Sequence[Job], notice: runner.Notice) -> None:
    """Fill numba's cache here, so that workers need not all compile the same."""
    seen = set[tuple[int, int, bool]]()
    for job in jobs:
        with suppress(UserError):  # which the verdict will say
            if job.part.cannot is not None:
                continue
            scenario = _scenario(job)
            kind = scenario.signal_set, len(scenario.converters), job.external is not None
            if kind in seen:
                continue
            if job.external is not None:
                compiled_benches(scenario, notice, ("plant",))
                compile_external(scenario, notice)
            else:
                compiled_benches(scenario, notice)
            seen.add(kind)


def _scenario(job: Job) -> Scenario:
    """The scenario of a job. Raises UserError: it cannot be run."""
    about = job.file, job.inner, job.converters
    if job.network is not None:
        return job.network.scenario_of(job.case, job.part, *about)
    found = scenario_of(job.case, job.part, job.under, *about)
    if job.external is None:
        return found
    if found.network is not None:
        raise UserError(f"{job.law} is one controller, and the test's network has several")
    asked = job.external.map
    changes: dict[str, Any] = {
        "link": LinkSettings(type="shm"), "T_s": min(found.T_s, asked.step_s or found.T_s),
    }  # fmt: skip
    return found.shifted(asked.settle_s).model_copy(update=changes)


def run_part(job: Job) -> PartResult:
    """Run, judge and draw a part; what cannot be run cannot be judged. Raises RunFailed: an error
    of the program; the message names law and test."""
    try:
        return _run_part(job)
    except Exception as problem:
        words = f"{job.law}, {job.name}: {type(problem).__name__}: {problem}"
        raise RunFailed(words) from problem


def _run_part(job: Job) -> PartResult:
    criteria = job.case.test.clauses(job.part)
    names = job.law, job.case.id, job.part.name
    if job.part.cannot is not None:
        reason = f"Cannot be judged: {job.part.cannot}"
        return PartResult(*names, "none", reason, cannot_judge(criteria, reason))
    external, plot = job.external, _plot(job)
    with ExitStack() as stack:
        try:
            scenario = _scenario(job)
            if plot is not None:
                found = plot.scan(scenario, external.command if external else ())
            else:
                run, others = _run(job, scenario, stack)
        except UserError as problem:
            text = str(problem).replace("\n", "; ").replace(job.file, job.law)
            reason = f"Cannot be judged: there is no such run: {text}"
            return PartResult(*names, "none", reason, cannot_judge(criteria, reason))
        if plot is not None:
            status, reason, recording = "completed", "", ""
            verdicts = plot.judge_scan(found)
        else:
            under = job.under
            if external is None:  # a controller that is not ours runs over a link alone
                for criterion in criteria:
                    under = criterion.declare(under, scenario)
            status, reason = run.status, str(run.summary["reason"])
            recording = run.digest
            verdicts = mark_saturation(run, judge(run, criteria, under, others), external is None)
        again, figure = list[str](), None
        if job.folder is not None:
            place = job.folder / "runs" / slug(job.law) / slug(job.name)
            place.mkdir(parents=True, exist_ok=True)
            write_scenario(place, scenario)
            again = _again(str(place / "scenario.toml"), plot, external)
            if job.figures and (plot is not None or run.ticks):
                from gfm_hil.studies.conformity.figure import draw_panels  # half a second to import

                if plot is not None:
                    panels = panels_of_plot(plot, found, verdicts)
                else:
                    panels = panels_of_run(run, verdicts)
                path = place / "figure.png"
                draw_panels(path, f"{job.law} · {job.name} · {scenario.title}", panels)
                figure = PartFigure(path, panels)
        again_text = shlex.join(again)
        return PartResult(*names, status, reason, verdicts, again_text, recording, figure)


def _plot(job: Job) -> Plot | None:
    """The plot by which a part is judged in place of a run, if it is."""
    first = job.case.test.clauses(job.part)[0]
    return first if isinstance(first, Plot) else None


def _again(scenario: str, plot: Plot | None, external: ControllerUnderTest | None) -> list[str]:
    """The command that repeats the run of a scenario file; none for the plot of a model."""
    if plot is not None:
        return plot.again(scenario) if external is None else []
    words = ["gfmhil", "run", scenario]
    if external is not None:
        words += ["--controller", external.model]
        words += ["--map", str(external.ports)] if external.ports else []
    return words


def _run(job: Job, scenario: Scenario, stack: ExitStack) -> tuple[Run, Mapping[str, Run]]:
    """The run that is judged, and those of the other converters; the stack keeps the folder from
    which a run of a model is read."""
    if job.external is not None:
        folder = stack.enter_context(scratch.temporary("gfmhil-conform-")) / "run"
        if job.start is None:
            run = runner.run_scenario(scenario, folder, controller_command=job.external.command)
        else:
            run = job.start.go_on(scenario, folder)
        if run.status == "interrupted":
            raise KeyboardInterrupt
        return after_settling(scenario, run, job.external.map.settle_s, job.start), {}
    if scenario.network is None:
        return runner.run_in_memory(scenario), {}
    runs = runner.run_network_in_memory(scenario)
    name = job.judged or scenario.converters[0]
    return runs[name], {other: run for other, run in runs.items() if other != name}
