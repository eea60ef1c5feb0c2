"""Studies: in memory and silent, or with a folder and watched by a command."""

import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from gfm_design.margins.certificate import GridClass
from gfm_hil.api.law import Law, law_files, scenario_under
from gfm_hil.core.errors import UserError
from gfm_hil.core.files import check_empty
from gfm_hil.recording.run import nominal_frequency
from gfm_hil.scenario import Scenario, load_scenario
from gfm_hil.scenario.schema import laws_digest
from gfm_hil.studies import unit_fit
from gfm_hil.studies.campaign.execute import run_campaign
from gfm_hil.studies.campaign.result import CampaignResult
from gfm_hil.studies.certificate import CertifiedLaws, certify_laws
from gfm_hil.studies.conformity import recorded
from gfm_hil.studies.conformity.execute import execute, external_controller, make_jobs
from gfm_hil.studies.conformity.hashes import file_hashes
from gfm_hil.studies.conformity.in_network import NetworkUnderTest
from gfm_hil.studies.conformity.recorded import part_of
from gfm_hil.studies.conformity.result import Conformity
from gfm_hil.studies.conformity.sets import ALL, load_cases, load_under_test, under_test_file
from gfm_hil.studies.envelopes import Unit
from gfm_hil.studies.scan import FrequencyScan, measure_admittance
from gfm_hil.studies.workers import SILENT, Watch
from gfm_runtime import law_file
from gfm_runtime.inner_file import named_inner


def campaign(
    given: str | Path | dict[str, Any],
    folder: str | Path | None = None,
    *,
    laws: Sequence[str | Path | Law] = (),
    workers: int | str = 1,
    resume: bool = False,
    x: str | None = None,
    y: str | None = None,
    watch: Watch = SILENT,
    **changes: Any,
) -> CampaignResult:
    """Run a scenario many times with drawn values, and keep one record a run.

    A record depends on the seed and on the run's number alone, not on ``workers``.

    Args:
        given: name of a shipped campaign, path of a file, or content of a file.
        folder: where to write the records as they come, campaign.json and the map; None keeps
            the campaign in memory.
        laws: names, law files or ``Law``; those of the campaign if there are none.
        workers: processes; 1 runs all in this one. A program that asks for more needs
            ``if __name__ == "__main__":``, as the module ``multiprocessing`` says. Or the
            address of a Dask cluster, e.g. ``tcp://host:8786``.
        resume: go on with what the folder holds.
        x, y: drawn paths of the map, or sums of them (``"a + b"``); those of the file if None.
        watch: of the runs; if it stops them, the result says how many are missing.
        changes: keys of the campaign file, e.g. ``runs=50``, ``seed=1``.

    Raises:
        UserError: one line a mistake; the folder is in use.
        LawError: one of the laws is none.
        WorkerLost: workers died of the same runs, or one raised an error; its ``result`` has all
            others.
    """
    with law_files(laws) as files:
        return run_campaign(
            given, None if folder is None else Path(folder), laws=files, changes=changes,
            workers=workers, resume=resume, x=x, y=y, watch=watch,
        )  # fmt: skip


def conform(
    law: str | Path | Law | Sequence[str | Path | Law] = (),
    against: str | Path | Sequence[str | Path] = ALL,
    folder: str | Path | None = None,
    *,
    inner: str | None = None,
    converter: str | Path | None = None,
    controller: str | None = None,
    ports: str | Path | None = None,
    network: str | Path | None = None,
    judged: str | None = None,
    workers: int | str = 1,
    figures: bool = True,
    watch: Watch = SILENT,
) -> Conformity:
    """Run the published tests of grid-forming converters, and judge them clause by clause.

    Args:
        law: name, law file or ``Law``, or several of them; none with a controller, and with a
            network the judged converter's own if none.
        against: shipped sets, ``all`` of them, or paths of your own.
        folder: where to write the report with figures, as a page and, if reportlab is installed,
            as PDF, results.json and junit.xml; None writes nothing.
        inner: inner stage of every law; each law's own if None.
        converter: file of the converter under test; the shipped one if None.
        controller: a model to test beside the laws, ``dll:FILE``, ``fmu:FILE`` or ``c:FILE``. It
            begins at the operating point of the first law, or of ``mimo-gfm`` without any. Or
            ``pil:TARGET``: that law as firmware on a processor.
        ports: file of the map of the model's ports.
        network: scenario of a network, name or path, over which the tests of one converter are
            laid: ``network.grid`` is the point of connection, with the line and the grid of the
            test behind it. Of ``converter`` only what its owner declares counts then.
        judged: the converter of the network that gets law and stage, and is judged; the first if
            None. The references of a test go to all.
        workers: as for ``campaign``.
        figures: draw one of each run.
        watch: of the runs.

    Raises:
        UserError: one line a mistake; the folder is in use.
        LawError: a law or the inner stage is none.
        WorkerLost: workers died of the same run, or one raised an error.
        KeyboardInterrupt: the watch stopped it.
    """
    over = _network(network, judged, controller)
    given = [law] if isinstance(law, str | Path | Law) else list(law)
    external = external_controller(controller, ports)
    if not given and over is not None:
        given = [over.own.law]
    if not given and external is None:
        raise UserError("law, controller: name one to test")
    sets = [against] if isinstance(against, str | Path) else list(against)
    place = _new_place(folder, workers)
    cases, under = load_cases([str(one) for one in sets]), load_under_test(converter)
    if over is not None:
        under = under.model_copy(update={"plant": over.plant})
    if inner is not None:
        named_inner(inner)
    with law_files(given) as files, tempfile.TemporaryDirectory() as temporary:
        for file in files.values():
            law_file(file)
        converters = Path(temporary) if place is None else place / "converters"
        jobs = make_jobs(files, cases, inner, under, converters, place, figures, external, over)
        digests = {name: laws_digest([file], inner) for name, file in files.items()}
        own = under_test_file(converter)
        droops = {job.law: job.under.droop for job in jobs}
        path = None if over is None else over.path
        hashed = partial(
            file_hashes, files, inner, own, under.plant.converter, cases, external, (), path
        )
        hashes = hashed()
        found = execute(jobs, workers, hashed, watch)
    names = [*files, *([external.name] if external else [])]
    words = over.words() if over else ""
    made = Conformity(
        names, inner, under, cases, found, place, hashes, digests, droops, network=words
    )
    return _write_report(made, watch)


def _network(
    network: str | Path | None, judged: str | None, controller: str | None
) -> NetworkUnderTest | None:
    """The network over which tests are laid, if there is one. Raises UserError: what goes with
    none, or not with one."""
    if network is None:
        if judged is not None:
            raise UserError(f"--judged {judged}: is of a --network, and none is given")
        return None
    over = NetworkUnderTest.load(network, judged)
    if controller is not None:
        raise UserError(f"--controller {controller}: is one controller; a network has several")
    return over


def _new_place(folder: str | Path | None, workers: int | str = 1) -> Path | None:
    """The folder of a report. Raises UserError: it holds something."""
    if folder is None:
        return None
    check_empty(Path(folder))
    # the workers of a cluster have working directories of their own
    return Path(folder).absolute() if isinstance(workers, str) else Path(folder)


def _write_report(made: Conformity, watch: Watch) -> Conformity:
    """What the tests showed, with its report in its folder if it has one."""
    if made.folder is not None:
        made.write(made.folder, watch.notice)
    return made


def judge_recording(
    file: str | Path,
    map_file: str | Path,
    against: str | Path,
    part: str | None = None,
    folder: str | Path | None = None,
    *,
    converter: str | Path | None = None,
    figures: bool = True,
    watch: Watch = SILENT,
) -> Conformity:
    """Judge a recording of hardware or of another simulator as a run of one part of a test.

    Args:
        file: CSV, COMTRADE (its .cfg or .cff), Parquet, MF4 or MAT.
        map_file: what its channels are.
        against: a test, such as ``"ercot/2-phase-jump"``, or the path of one of your own.
        part: of the test; its only one if None.
        folder, figures: as for ``conform``.
        converter: file of the converter under test, with what its owner declares; without a droop
            in it no clause that asks for the droop can be judged.
        watch: is told what a person who waits should know.

    Raises:
        UserError: one line a mistake, before anything is judged: a file cannot be read, a channel
            is missing, or the recording does not begin where the test does.
    """
    file, map_file, place = Path(file), Path(map_file), _new_place(folder)
    cases, under = load_cases([str(against)]), load_under_test(converter)
    if len(cases) > 1:
        raise UserError(f"--against {against}: a recording is of one test: {[c.id for c in cases]}")
    chosen = part_of(cases[0], part)
    with tempfile.TemporaryDirectory() as temporary:
        found, words = recorded.judge_recording(
            file, map_file, cases[0], chosen, under, Path(temporary), place if figures else None
        )
    own = under_test_file(converter)
    files = [x for x in (file, file.with_suffix(".dat"), map_file) if x.is_file()]
    hashes = file_hashes({}, None, own, under.plant.converter, cases, None, dict.fromkeys(files))
    name = file.stem
    made = Conformity(
        [name], None, under, cases, [found], place, hashes, droops={name: under.droop},
        recordings={name: words},
    )  # fmt: skip
    return _write_report(made, watch)


def scan(
    law: str | Path | Law | None = None,
    on: str | Path | Scenario = "pref_step",
    *,
    inner: str | None = None,
    controller_command: Sequence[str] = (),
    **how: Any,
) -> FrequencyScan:
    """Measure the dq admittance of a converter on the bench.

    Args:
        law: name, law file or ``Law``; the scenario's own if None.
        on: scenario (name, file or ``Scenario``), of which plant, references, sampling time and
            inner stage count, but no event.
        inner: inner stage, in place of the law's own.
        controller_command: program and arguments of another controller, which runs over the
            scenario's link; it has no model.
        how: ``start_hz``, ``stop_hz``, ``points``, ``amplitude``, ``settle_s``, ``window_s`` and
            ``watch``, as for ``gfm_hil.studies.scan.measure_admittance``.

    Raises:
        UserError: a value out of range, no operating point, a loop that is unstable, a run that
            does not complete, or a window whose ends still differ.
        LawError: the law is none.
    """
    with scenario_under(law, on, not controller_command, inner=inner) as scenario:
        found = measure_admittance(scenario, controller_command=controller_command, **how)
    return replace(found, name=law.name) if isinstance(law, Law) else found


def identify(*args: Any, **more: Any) -> FrequencyScan:
    """The name of ``scan`` up to version 0.2."""
    warnings.warn("gfmhil.identify is gfmhil.scan now", DeprecationWarning, stacklevel=2)
    return scan(*args, **more)


def measure_unit(
    law: str | Path | Law | None = None,
    on: str | Path | Scenario = "pref_step",
    *,
    degrees: float = 0.5,
    seconds: float = 4.0,
    **changes: Any,
) -> Unit:
    """D, H and X_eff of a converter under a law, fitted to its power after a phase jump.

    Args:
        law: name, law file or ``Law``; the scenario's own if None.
        on: scenario, of which no event counts; its line is not part of X_eff.
        degrees: of the jump; a small one, so that nothing limits and nothing bends.
        seconds: of the fit, after the jump.
        changes: keys of the scenario, as for ``run``.

    Raises:
        UserError: a mistake, a run that does not complete, or no swing equation fits.
        LawError: the law is none.
    """
    with scenario_under(law, on, **changes) as scenario:
        return unit_fit.measure_unit(scenario, degrees, seconds)


def certify(
    laws: str | Path | Law | Sequence[str | Path | Law],
    on: str | Path | Scenario = "pref_step",
    *,
    scr: tuple[float, float] = (1.5, 20.0),
    x_over_r: tuple[float, float] = (3.0, 20.0),
    powers: Sequence[float] = (0.0, 0.5, 1.0),
    loads: bool = False,
    watch: Watch = SILENT,
    **changes: Any,
) -> CertifiedLaws:
    """Say whether every network of a class is stable with any number of converters under laws.

    The class: R-L lines between converters and an ideal grid. docs/identification.md has the
    condition, and where it is void.

    Args:
        laws: names, law files or ``Law``.
        on: scenario of one converter: its plant, inner stage, T_s and other references.
        scr: least and largest generalised short-circuit ratio at the filter capacitors.
        x_over_r: of the lines, least and largest.
        powers: P_ref of the operating points, p.u.
        loads: whether resistors and R-L loads may be at any node.
        watch: told the grids tried.
        changes: keys of the scenario, as for ``run``, e.g. ``inner="virtual-stator"``.

    Raises:
        UserError: one line a mistake.
        LawError: a law is none.
    """
    several = [laws] if isinstance(laws, str | Path | Law) else list(laws)
    scenario = load_scenario(on, in_process=True, **changes)
    try:
        grids = GridClass(*scr, x_over_r, loads, nominal_frequency(scenario))
    except ValueError as problem:
        raise UserError(str(problem)) from None
    with law_files(several) as files:
        return certify_laws(scenario, [str(file) for file in files.values()], grids, powers, watch)
