"""What a notebook calls: a campaign, or conformity tests, in memory and silent."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gfm_hil.core.errors import UserError
from gfm_hil.studies.campaign.axes import find_axes
from gfm_hil.studies.campaign.execute import execute, processes
from gfm_hil.studies.campaign.loading import check_campaign, find_campaign
from gfm_hil.studies.campaign.result import CampaignResult, write_result
from gfm_hil.studies.campaign.store import Store
from gfm_hil.studies.campaign.worker import compile_once
from gfm_hil.studies.conformity import execute as conformity
from gfm_hil.studies.conformity.result import Conformity
from gfm_hil.studies.conformity.sets import ALL, load_cases, load_under_test
from gfm_hil.studies.law import Law, law_files
from gfm_runtime import law_file
from gfm_runtime.inner_file import named_inner
from gfm_runtime.toml_file import read_toml

if TYPE_CHECKING:
    pass


def campaign(
    given: str | Path | dict[str, Any],
    folder: str | Path | None = None,
    *,
    laws: Sequence[str | Path | Law] | None = None,
    workers: int = 1,
    resume: bool = False,
    **changes: Any,
) -> CampaignResult:
    """Run a scenario many times with drawn values, and keep one record a run.

    A record depends on the seed and on the run's number alone, not on ``workers``.

    Args:
        given: name of a shipped campaign, path of a file, or content of a file.
        folder: where to write the records as they come, campaign.json and the map; None keeps
            the campaign in memory.
        laws: names, law files or ``Law``; those of the campaign if None.
        workers: processes; 1 runs all in this one. A program that asks for more needs
            ``if __name__ == "__main__":``, as the module ``multiprocessing`` says.
        resume: go on with what the folder holds.
        changes: keys of the campaign file, e.g. ``runs=50``, ``seed=1``.

    Raises:
        UserError: one line a mistake; the folder is in use.
        LawError: one of the laws is none.
    """
    if not 1 <= workers <= 1024:
        raise UserError(f"workers = {workers}: must lie in [1, 1024]")
    if resume and folder is None:
        raise UserError("resume: goes with the folder to go on with")
    began, path = time.monotonic(), Path("campaign")
    if not isinstance(given, dict):
        path = find_campaign(os.fspath(given))
        try:
            given = read_toml(path)
        except ValueError as problem:
            raise UserError(f"{path}: {problem}") from None
    with law_files(laws or []) as files:
        content = {**given, **changes} | ({"laws": list(files)} if files else {})
        made = check_campaign(content, path, laws=files)
        axes, place = find_axes(made, None, None), None if folder is None else Path(folder)
        store = Store(place, made, resume)
        if jobs := store.missing(made):
            compile_once(made, lambda text: None)  # silent, as all of this module
            with ThreadPoolExecutor(1) if workers == 1 else processes(workers) as pool:
                execute(made, jobs, pool, workers, store.append, lambda: False)
        found = CampaignResult(made, store.sorted(made), place)
    if place is not None:
        write_result(found, place, axes, workers, time.monotonic() - began)
    return found


def conform(
    law: str | Path | Law | Sequence[str | Path | Law] = (),
    against: str | Path | Sequence[str | Path] = ALL,
    folder: str | Path | None = None,
    *,
    inner: str | None = None,
    converter: str | Path | None = None,
    controller: str | None = None,
    ports: str | Path | None = None,
    workers: int = 1,
) -> Conformity:
    """Run the published tests of grid-forming converters, and judge them clause by clause.

    Args:
        law: name, law file or ``Law``, or several of them; none with a controller.
        against: shipped sets, ``all`` of them, or paths of your own.
        folder: where to write the report with figures, results.json and junit.xml; None writes
            nothing.
        inner: inner stage of every law; each law's own if None.
        converter: file of the converter under test; the shipped one if None.
        controller: a model to test beside the laws, ``dll:FILE``, ``fmu:FILE`` or ``c:FILE``. It
            begins at the operating point of the first law, or of ``mimo-gfm`` without any. Or
            ``pil:TARGET``: that law as firmware on a processor.
        ports: file of the map of the model's ports.
        workers: as for ``campaign``.

    Raises:
        UserError: one line a mistake; the folder is in use.
        LawError: a law or the inner stage is none.
    """
    if not 1 <= workers <= 1024:
        raise UserError(f"workers = {workers}: must lie in [1, 1024]")
    given = [law] if isinstance(law, str | Path | Law) else list(law)
    foreign = conformity.foreign_controller(controller, ports)
    if not given and foreign is None:
        raise UserError("law, controller: name one to test")
    sets = [against] if isinstance(against, str | Path) else list(against)
    place = None if folder is None else Path(folder)
    if place is not None and place.exists() and any(place.iterdir()):
        raise UserError(f"{place}: is not empty; choose another folder")
    cases, under = load_cases([str(one) for one in sets]), load_under_test(converter)
    if inner is not None:
        named_inner(inner)
    found: list[conformity.Found] = []
    with law_files(given) as files, tempfile.TemporaryDirectory() as temporary:
        for file in files.values():
            law_file(file)
        converters = Path(temporary) if place is None else place / "converters"
        jobs = conformity.make_jobs(files, cases, inner, under, converters, place, True, foreign)
        conformity.execute(jobs, workers, found.append)
    names = [*files, *([foreign.name] if foreign else [])]
    made = Conformity(names, inner, under, cases, found, place)
    if place is not None:
        made.write(place)
    return made
