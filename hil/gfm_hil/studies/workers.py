"""Tasks of a study on several processes, and how a study tells what goes on."""

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from itertools import islice
from multiprocessing import forkserver
from typing import Any, TypeVar

from gfm_hil.core.errors import Unfinished, UserError
from gfm_runtime.children import end_with_parent

MOST = 1024  # workers
_AHEAD = 2  # tasks in hand a worker
_POLL_S = 0.2

# One thread a worker: two would fight for the cores, and a sum split in two has other last bits.
_ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")

Task = TypeVar("Task")
Result = TypeVar("Result")


class WorkerLost(Unfinished):
    """A worker died or failed; the message says what is known."""

    result: Any = None  # of what was done before, if the study keeps it


class RunFailed(Exception):
    """A run ended by an error of the program; the message names the run."""


@dataclass(frozen=True)
class Watch:
    """Who watches a study.

    Attributes:
        progress: told how much is done, of how much, and a few words on what became of it.
        notice: told what a person should know while waiting.
        stopped: asked a few times a second whether to stop.
    """

    progress: Callable[[int, int, str], None] = lambda done, of, words: None
    notice: Callable[[str], None] = lambda text: None
    stopped: Callable[[], bool] = lambda: False


SILENT = Watch()


def check_workers(workers: int) -> None:
    """Raise UserError unless so many processes can be."""
    if not 1 <= workers <= MOST:
        raise UserError(f"workers = {workers}: must lie in [1, {MOST}]")


def run_tasks(
    function: Callable[[Task], Result],
    tasks: Iterable[Task],
    pool: Executor | None,
    workers: int,
    keep: Callable[[Result], None],
    stopped: Callable[[], bool],
) -> None:
    """Work on all tasks, here or at so many a time in a pool, until ``stopped``, which is asked
    after each or a few times a second; those under way then are still finished. ``keep`` gets every
    result. Raises WorkerLost: a worker died, or the function raised an error; the results of all
    other finished tasks are kept."""
    waiting = iter(tasks)
    if pool is None:
        for task in waiting:
            if stopped():
                return
            try:
                result = function(task)
            except Exception as problem:
                raise WorkerLost(str(problem) or repr(problem)) from problem
            keep(result)
        return
    pending: set[Future[Result]] = set()
    try:
        while True:
            if stopped():
                pending = {future for future in pending if not future.cancel()}
            else:
                free = _AHEAD * workers - len(pending)
                pending |= {pool.submit(function, task) for task in islice(waiting, free)}
            if not pending:
                return
            done, pending = wait(pending, timeout=_POLL_S, return_when=FIRST_COMPLETED)
            _keep(done, keep)
    finally:
        for future in pending:
            future.cancel()


def _keep(done: set[Future[Result]], keep: Callable[[Result], None]) -> None:
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
    before = {name: os.environ[name] for name in _ONE_THREAD if name in os.environ}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    context = multiprocessing.get_context("forkserver")
    # scipy loads its parts when they are first used
    first = f"{__package__}.forked"
    context.set_forkserver_preload([first, f"{__package__}.campaign.worker", "scipy.signal"])
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
        for name in _ONE_THREAD:
            del os.environ[name]
        os.environ.update(before)


def _set_up() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    end_with_parent(by=signal.SIGKILL)
    command = multiprocessing.parent_process()
    if command is not None and not command.is_alive():  # it ended before
        os._exit(1)


@contextlib.contextmanager
def pool_of(workers: int) -> Iterator[Executor | None]:
    """``processes``, or None for 1 worker, which works here. Raises UserError: so many processes
    cannot be."""
    check_workers(workers)
    if workers == 1:
        yield None
        return
    with processes(workers) as pool:
        yield pool
