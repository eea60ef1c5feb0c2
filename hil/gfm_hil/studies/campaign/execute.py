"""A campaign: checked, and run in chunks on the cores of this machine or on a Dask cluster."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.core.errors import UserError
from gfm_hil.core.files import check_empty
from gfm_hil.results.report import write_report
from gfm_hil.run.runner import run_scenario
from gfm_hil.studies.campaign.axes import find_axes
from gfm_hil.studies.campaign.loading import Tell, load_campaign
from gfm_hil.studies.campaign.result import CampaignResult, verdict
from gfm_hil.studies.campaign.spec import Campaign
from gfm_hil.studies.campaign.store import Store
from gfm_hil.studies.campaign.worker import Job, Record, compile_once, record, run_chunk
from gfm_hil.studies.workers import SILENT, Watch, WorkerLost, check_workers, pool_of, run_tasks

CHUNK = 8  # runs a task: a quarter of a second, so that little is lost and little is waited for
_PATIENCE_S = 1.0  # how long the checks may go on without a word


def run_campaign(
    given: str | Path | dict[str, Any],
    folder: Path | None,
    *,
    laws: Mapping[str, str],
    changes: Mapping[str, Any],
    workers: int,
    dask: str | None,
    resume: bool,
    x: str | None,
    y: str | None,
    watch: Watch = SILENT,
) -> CampaignResult:
    """As ``gfmhil.campaign``, with law files by name.

    Raises:
        UserError: one line a mistake; the folder is in use.
        WorkerLost: a worker died, or a run raised an error; its ``result`` has all others.
    """
    check_workers(workers)
    if resume and folder is None:
        raise UserError("resume: goes with the folder to go on with (--out)")
    began, lost, store = time.monotonic(), None, None
    try:
        with contextlib.ExitStack() as stack:
            # workers import while the runs are checked
            pool = None if dask else stack.enter_context(pool_of(workers))
            campaign = load_campaign(given, laws, changes, checks_progress(watch))
            axes = find_axes(campaign, x, y)
            if dask:  # before anything is written
                pool, workers = stack.enter_context(cluster(dask, campaign))
            store = Store(folder, campaign, resume)
            if jobs := store.missing(campaign):
                if not dask:
                    compile_once(campaign, watch.notice)
                _execute(campaign, jobs, pool, workers, store, watch)
    except WorkerLost as problem:
        lost = problem
    except KeyboardInterrupt:  # of a second signal: the runs under way are lost
        if store is None or not watch.stopped():
            raise
    assert store is not None
    where, wall_s = dask or workers, time.monotonic() - began
    found = CampaignResult(campaign, store.sorted(campaign), folder, where, wall_s, axes)
    if folder is not None:
        found.write(folder)
    if lost is not None:
        lost.result = found
        raise lost
    return found


def checks_progress(watch: Watch) -> Tell:
    """What tells a watch of the checks of a campaign, in a line once they take long."""
    began, told = time.monotonic(), False

    def tell(done: int, of: int) -> None:
        nonlocal told
        if watch.stopped():
            raise KeyboardInterrupt
        watch.progress(done, of, "checking the runs")
        if not told and time.monotonic() - began >= _PATIENCE_S:
            told = True
            watch.notice(f"checking the runs: {done} of {of} done …")

    return tell


def _execute(
    campaign: Campaign,
    jobs: Sequence[Job],
    pool: Executor | None,
    workers: int,
    store: Store,
    watch: Watch,
) -> None:
    """Run all jobs, or until the watch stops them; arguments and errors as for ``run_tasks``."""
    of = campaign.file.runs * len(campaign.file.laws)
    verdicts = [verdict(one) for one in store.sorted(campaign)]

    def keep(records: list[Record]) -> None:
        store.append(records)
        verdicts.extend(map(verdict, records))
        counts = {v: verdicts.count(v) for v in dict.fromkeys(verdicts)}
        told = ", ".join(f"{n} {v.replace('-', ' ')}" for v, n in counts.items())
        watch.progress(len(verdicts), of, told)

    chunks = (jobs[k : k + CHUNK] for k in range(0, len(jobs), CHUNK))
    run_tasks(partial(run_chunk, campaign), chunks, pool, workers, keep, watch.stopped)


@contextlib.contextmanager
def cluster(address: str, campaign: Campaign) -> Iterator[tuple[Executor, int]]:
    """A Dask cluster as (executor, number of threads).

    Raises:
        UserError: no distributed here, nobody at the address, or a worker with other contents.
    """
    try:
        from distributed import Client
    except ImportError:
        raise UserError(
            "--dask: needs the package distributed: pip install 'gfmhil[dask]'"
        ) from None
    try:
        client: Any = Client(address, timeout="10s")
    except (OSError, ValueError) as problem:
        raise UserError(f"--dask {address}: no scheduler there: {problem}") from None
    with client:
        threads = sum(client.nthreads().values())
        if not threads:
            raise UserError(f"--dask {address}: the cluster has no workers")
        mine = campaign.digest()
        for worker, theirs in client.run(campaign.digest, on_error="return").items():
            if theirs != mine:
                raise UserError(
                    f"--dask {address}: {worker} has another gfmhil, law or converter: {theirs!r}"
                )
        yield client.get_executor(pure=False), threads


def run_alone(campaign: Campaign, run: int, law: str, folder: Path) -> Record:
    """Write the run folder of one run, and its record beside as ``record.json``.

    A run without a steady state has nothing but the record.

    Raises:
        UserError: the folder is in use.
    """
    scenario, drawn = campaign.scenario(run, law)
    scenario = scenario.model_copy(update={"title": f"{campaign.file.title}: run {run}"})
    check_empty(folder)
    try:
        whole = run_scenario(scenario, folder, report=write_report)
        summary, p = whole.summary, whole.signals["true_p"]
    except UserError as problem:
        summary = {"status": "no-steady-state", "reason": str(problem), "events": []}
        p = np.empty(0)
    kept = record(run, law, scenario, drawn, summary, p)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "record.json").write_text(json.dumps(kept, indent=2) + "\n", "utf-8")
    return kept
