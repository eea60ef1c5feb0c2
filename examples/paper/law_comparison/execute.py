"""All rows of the law comparison, in several processes if wanted; finished rows are kept."""

from __future__ import annotations

import json
import os
import queue
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from multiprocessing import get_context
from multiprocessing.managers import SyncManager
from pathlib import Path
from typing import Any

from gfm_hil.studies.workers import WorkerLost, processes
from gfm_runtime.children import end_with_parent
from law_comparison.row import Job, Row, make_row

_POLL_S = 0.2


class _Stopped(Exception):
    """The operator does not want the rest."""


def kept(folder: Path, job: Job) -> Row | None:
    """The row of an earlier run of the same job."""
    path = _path(folder, job)
    if not path.is_file():
        return None
    row: Row = json.loads(path.read_text(encoding="utf-8"))
    return row if row["digest"] == job.digest() else None


def run(
    jobs: Sequence[Job],
    folder: Path,
    workers: int,
    tell: Callable[[str, int, float], None],
    done: Callable[[Row], None],
    stopped: Callable[[], bool],
) -> None:
    """Make the rows of all jobs, or until ``stopped``.

    Args:
        jobs: what to make.
        folder: rows and law files go there, each row when it is made.
        workers: processes.
        tell: a law, its evaluations so far and the least gamma among them.
        done: given every finished row.
        stopped: asked a few times a second; a search under way then ends without a row.

    Raises:
        WorkerLost: a worker died or a row raised an error; rows made so far are kept.
    """
    with _manager() as manager, processes(workers) as pool:
        said, stop = manager.Queue(), manager.Event()
        left = {pool.submit(_work, job, folder, said, stop): job for job in jobs}
        try:
            while left:
                if stopped():
                    stop.set()
                _pass_on(said, tell)
                for future in [f for f in left if f.done()]:
                    _finish(future, left.pop(future), done)
        finally:
            stop.set()


def _manager() -> SyncManager:
    manager = SyncManager(ctx=get_context("spawn"))
    manager.start(end_with_parent, (os.getpid(), signal.SIGKILL))
    return manager


def _pass_on(said: Any, tell: Callable[[str, int, float], None]) -> None:
    try:
        tell(*said.get(timeout=_POLL_S))
        while True:
            tell(*said.get_nowait())
    except queue.Empty:
        return


def _finish(future: Future[Row | None], job: Job, done: Callable[[Row], None]) -> None:
    problem = future.exception()
    if problem is not None:
        raise WorkerLost(f"{job.law}: {type(problem).__name__}: {problem}") from problem
    row = future.result()
    if row is not None:
        done(row)


def _work(job: Job, folder: Path, said: Any, stop: Any) -> Row | None:
    """In a worker: make a row and keep it."""

    def tell(law: str, evaluations: int, best: float) -> None:
        if stop.is_set():
            raise _Stopped
        said.put((law, evaluations, best))

    try:
        tell(job.law, 0, float("inf"))
        row = make_row(job, folder, tell)
    except _Stopped:
        return None
    path = _path(folder, job)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(row, indent=1) + "\n", encoding="utf-8")
    return row


def _path(folder: Path, job: Job) -> Path:
    return folder / "rows" / f"{job.law}.json"
