"""Chunks of runs on the cores of this machine or on a Dask cluster; what is done is kept."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.core.errors import UserError
from gfm_hil.results.report import write_report
from gfm_hil.run.runner import run_scenario
from gfm_hil.studies.campaign.spec import Campaign
from gfm_hil.studies.campaign.worker import Job, Record, record, run_chunk
from gfm_runtime.children import end_with_parent

CHUNK = 8  # runs a task: a quarter of a second, so that little is lost and little is waited for
_AHEAD = 2  # tasks in hand a worker
_POLL_S = 0.2

# One thread a worker: two would fight for the cores, and a sum split in two has other last bits.
_ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


class WorkerLost(Exception):
    """A worker died or failed; the message says what is known."""


def execute(
    campaign: Campaign,
    jobs: Sequence[Job],
    pool: Executor,
    workers: int,
    keep: Callable[[list[Record]], None],
    stopped: Callable[[], bool],
) -> None:
    """Run all jobs, or until ``stopped``; chunks under way then are still finished and kept.

    Args:
        campaign, jobs: what to run.
        pool, workers: where, and how many tasks it works on at a time.
        keep: given the records of every finished chunk.
        stopped: asked a few times a second.

    Raises:
        WorkerLost: a worker died, or a run raised an error; all other finished chunks are kept.
    """
    chunks = iter([jobs[k : k + CHUNK] for k in range(0, len(jobs), CHUNK)])
    pending: set[Future[list[Record]]] = set()
    try:
        while True:
            if stopped():
                pending = {future for future in pending if not future.cancel()}
            else:
                while len(pending) < _AHEAD * workers and (chunk := next(chunks, None)):
                    pending.add(pool.submit(run_chunk, campaign, chunk))
            if not pending:
                return
            done, pending = wait(pending, timeout=_POLL_S, return_when=FIRST_COMPLETED)
            _keep(done, keep)
    finally:
        for future in pending:
            future.cancel()


def _keep(done: set[Future[list[Record]]], keep: Callable[[list[Record]], None]) -> None:
    failed = None
    for future in done:
        problem = future.exception()
        if problem is None:
            keep(future.result())
        else:
            failed = problem
    if isinstance(failed, BrokenProcessPool):
        raise WorkerLost("a worker process died (killed, or out of memory?)") from failed
    if failed is not None:
        raise WorkerLost(str(failed) or repr(failed)) from failed


@contextlib.contextmanager
def processes(workers: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of processes with one thread each. They are forked, when there is work, from a server
    that at once begins to import what all need. All end with this process, and a KeyboardInterrupt
    in this context ends them at once."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    context = multiprocessing.get_context("forkserver")
    # scipy loads its parts when they are first used
    first = f"{__package__}.forked"
    context.set_forkserver_preload([first, run_chunk.__module__, "scipy.signal"])
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_set_up)
    try:
        # it starts with SIGINT blocked: Ctrl-C is the parent's to handle, also while it imports
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        forkserver.ensure_running()
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        try:
            yield pool
        finally:
            pool.shutdown(cancel_futures=True)
    except KeyboardInterrupt:
        for process in multiprocessing.active_children():
            process.kill()
        raise
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _set_up() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    end_with_parent(by=signal.SIGKILL)
    command = multiprocessing.parent_process()
    if command is not None and not command.is_alive():  # it ended before
        os._exit(1)


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
    if folder.exists() and any(folder.iterdir()):
        raise UserError(f"{folder}: is not empty; choose another --out")
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
