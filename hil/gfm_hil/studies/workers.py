"""Tasks of a study on several processes, and how a study tells what goes on."""

import contextlib
import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import forkserver
from pathlib import Path
from typing import Any, TypeVar

from gfm_hil.core.errors import Unfinished, UserError
from gfm_runtime.children import end_with_parent

MOST = 1024  # workers
_AHEAD = 2  # tasks in hand a worker
_DEATHS = 3  # of workers, of the same task, end a study
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


class Pool:
    """Where the tasks of a study are worked on: in this process, one after the other.

    Attributes:
        workers: how many tasks it works on at a time.
        in_hand: tasks that it should have at a time.
        is_local: whether its workers are on this machine, and use its files and numba's cache.
    """

    workers = 1
    in_hand = 1
    is_local = True

    def submit(self, function: Callable[..., Result], *args: Any) -> Future[Result]:
        """A task; an error that it raises is the future's."""
        future = Future[Result]()
        try:
            future.set_result(function(*args))
        except Exception as problem:
            future.set_exception(problem)
        return future

    def check_equal(self, digest: Callable[[], object]) -> None:
        """Raise UserError unless every worker has this version of the project, and gets from a
        function what this process gets from it."""

    def check_shared(self, folder: Path) -> None:
        """Raise UserError unless every worker sees a folder of this machine, which may be made
        later."""


def run_tasks(
    function: Callable[[Task], Result],
    tasks: Iterable[Task],
    pool: Pool,
    keep: Callable[[Result], None],
    watch: Watch,
) -> None:
    """Work on all tasks until ``watch.stopped``, which is asked after each or a few times a second;
    those under way then are still finished. ``keep`` gets every result. What a worker had in hand
    that died (killed, out of memory), another one takes up, one task after the other, so that it
    shows of which one they die. Raises WorkerLost: workers died of the same task again and again,
    or the function raised an error; the results of all other finished tasks are kept."""
    waiting = ((task, 0) for task in tasks)
    again = deque[tuple[Task, int]]()  # tasks that a worker's death ended, and how often theirs
    alone = False  # whether they are worked on one after the other
    pending: dict[Future[Result], tuple[Task, int]] = {}
    try:
        while True:
            if watch.stopped():
                again.clear()
                pending = {f: task for f, task in pending.items() if not f.cancel()}
            else:
                alone = bool(again) or (alone and bool(pending))
                while len(pending) < (1 if alone else pool.in_hand):
                    if (one := again.popleft() if again else next(waiting, None)) is None:
                        break
                    pending[pool.submit(function, one[0])] = one
            if not pending:
                return
            done = wait(pending, timeout=_POLL_S, return_when=FIRST_COMPLETED).done
            if any(isinstance(future.exception(), BrokenProcessPool) for future in done):
                watch.notice("a worker process died (killed, or out of memory?); going on …")
                done = wait(pending).done  # that ended all others too
            failed = None
            for future in done:
                task, deaths = pending.pop(future)
                problem = future.exception()
                if problem is None:
                    keep(future.result())
                elif isinstance(problem, BrokenProcessPool) and deaths + alone < _DEATHS:
                    again.append((task, deaths + alone))
                else:
                    failed = problem
            if isinstance(failed, BrokenProcessPool):
                words = f"{_DEATHS} worker processes died of the same work (out of memory?)"
                raise WorkerLost(words) from failed
            if failed is not None:
                raise WorkerLost(str(failed) or repr(failed)) from failed
    finally:
        for future in pending:
            future.cancel()


class ProcessPool(Pool):
    """So many processes with one thread each, forked when there is work from a server that has
    imported what all need; others take the place of those that died."""

    def __init__(self, workers: int) -> None:
        self.workers, self.in_hand = workers, _AHEAD * workers
        self._context = multiprocessing.get_context("forkserver")
        # scipy loads its parts when they are first used
        first = f"{__package__}.forked"
        self._context.set_forkserver_preload(
            [first, f"{__package__}.campaign.worker", "scipy.signal"]
        )
        self._executor = self._start()

    def _start(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(self.workers, mp_context=self._context, initializer=_set_up)

    def submit(self, function: Callable[..., Result], *args: Any) -> Future[Result]:
        try:
            return self._executor.submit(function, *args)
        except BrokenProcessPool:
            self._executor = self._start()
            return self._executor.submit(function, *args)

    def shut_down(self) -> None:
        """End the processes after what they work on now."""
        self._executor.shutdown(cancel_futures=True)


@contextlib.contextmanager
def processes(workers: int) -> Iterator[ProcessPool]:
    """A pool of processes, whose server begins to import at once. All end with this process, and a
    KeyboardInterrupt in this context ends them at once."""
    before = {name: os.environ[name] for name in _ONE_THREAD if name in os.environ}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    pool = ProcessPool(workers)
    try:
        # it starts with SIGINT blocked: Ctrl-C is the parent's to handle, also while it imports
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        forkserver.ensure_running()
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        try:
            yield pool
        finally:
            pool.shut_down()
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
def pool_of(workers: int | str) -> Iterator[Pool]:
    """So many processes, of which 1 is this one, or the Dask cluster at an address. Raises
    UserError: so many cannot be, or there is no such cluster."""
    if isinstance(workers, str):
        from gfm_hil.studies.cluster import cluster

        with cluster(workers) as there:
            yield there
    elif not isinstance(workers, int) or not 1 <= workers <= MOST:
        words = f"must lie in [1, {MOST}], or be the address of a cluster"
        raise UserError(f"workers = {workers}: {words}")
    elif workers == 1:
        yield Pool()
    else:
        with processes(workers) as pool:
            yield pool
