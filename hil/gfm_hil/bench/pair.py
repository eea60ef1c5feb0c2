"""Two processes for a whole benchmark: one sends, one answers, each on its processor.

Both open every contender at the start, so that a round of one can follow a round of another at
once. Both are pinned; with the policy fifo they also get the real-time priority of a run's sides.
"""

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing import connection
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gfm_hil.bench.contenders import Contender
from gfm_hil.bench.pingpong import HYBRID, PingPong
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.realtime.priority import ask_for_real_time, no_collector_pauses, own_processor

Policy = Literal["fifo", "other"]

CAPACITY = 1 << 20  # most round trips in a round
_PATIENCE_S = 120.0
_WARM_NS = 20_000_000
_END_S = 1.5  # a loop that gets no answer ends after a second
_CLOSE_S = 5

# state in each of the two processes
_role: Role = "plant"
_ends: dict[str, PingPong] = {}
_took = np.zeros(0, np.int64)
_stop = np.zeros(3, np.int64)


class Pair:
    """Handle of the two processes."""

    def __init__(self, pools: dict[Role, ProcessPoolExecutor], stop: NDArray[np.int64]) -> None:
        self._pools, self._stop = pools, stop
        self.sides: dict[str, Any] = {}

    def here(self, role: Role, work: Any, *arguments: Any) -> Any:
        """Call a function in one of them."""
        return _wait(self._pools[role].submit(work, *arguments))

    def both(self, work: Any, *arguments: Any) -> dict[Role, Any]:
        """Call a function in both at the same time."""
        futures = {s: pool.submit(work, *arguments) for s, pool in self._pools.items()}
        return {s: _wait(future) for s, future in futures.items()}

    def open(self, contender: Contender, payload: int) -> bool:
        """Open a contender's ends; returns whether its loops are compiled. Raises UserError: it
        cannot be opened."""
        return bool([self.here(role, _open, contender, payload) for role in ROLES][-1])

    def round(
        self, contender: Contender, period_ns: int, seconds: float, how: int = HYBRID
    ) -> NDArray[np.int64]:
        """Times of the round trips of one round in ns; none if the peer stopped answering. What the
        round says of both ways is in ``sides``, see ``PingPong``."""
        self._stop[:] = 0, how, period_ns
        answers = self._pools["controller"].submit(_pong, contender.name)
        try:
            took, self.sides = self.here(
                "plant", _ping, contender.name, period_ns, int(seconds * 1e9)
            )
            return took
        finally:
            self._stop[0] = 1
            _wait(answers)


def _wait(future: Future[Any]) -> Any:
    try:
        return future.result(_PATIENCE_S)
    except BrokenProcessPool:
        raise RuntimeError("a process of the benchmark died") from None


@contextmanager
def pair(policy: Policy, place: Path) -> Iterator[Pair]:
    """Start both; ``place`` is a folder in memory."""
    path = place / "stop"
    path.write_bytes(bytes(24))
    context = multiprocessing.get_context("spawn")
    pools = {
        role: ProcessPoolExecutor(
            1, mp_context=context, initializer=_set_up, initargs=(role, policy, str(path))
        )
        for role in ROLES
    }
    stop = np.memmap(path, np.int64, "r+")
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:  # both start now and inherit this: only the parent handles Ctrl-C
        started = [pool.submit(os.getpid) for pool in pools.values()]
    finally:
        signal.signal(signal.SIGINT, handler)
    try:
        for one in started:  # done once ``_set_up`` is
            _wait(one)
        yield Pair(pools, stop)
    finally:
        stop[0] = 1
        for pool in pools.values():
            with suppress(BrokenProcessPool):
                pool.submit(_close)
        for pool in pools.values():
            pool.shutdown(cancel_futures=True)


def _set_up(role: Role, policy: Policy, stop: str) -> None:
    global _role, _took, _stop
    # before the priority of a run: its thread must not wait for a loop that never sleeps
    threading.Thread(target=_end_with_parent, daemon=True).start()
    (ask_for_real_time if policy == "fifo" else own_processor)(role)
    _role, _took = role, np.zeros(CAPACITY, np.int64)
    _took += 1  # touch all pages before a round
    _stop = np.asarray(np.memmap(stop, np.int64, "r+"))
    no_collector_pauses()


def _end_with_parent() -> None:
    """Once the parent is gone, even if it was killed: free the links, and end."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    _stop[0] = 1
    time.sleep(_END_S)  # the loops end by themselves
    signal.alarm(_CLOSE_S)  # ends this process if a binding waits for its peer for ever
    with suppress(Exception):
        _close()
    os._exit(1)


def _open(contender: Contender, payload: int) -> bool:
    end = _ends[contender.name] = contender.open(_role, payload)
    return end.compiled


def _pong(name: str) -> None:
    _ends[name].pong(_stop)


def _ping(name: str, period_ns: int, duration_ns: int) -> tuple[NDArray[np.int64], dict[str, Any]]:
    end = _ends[name]
    for duration in (_WARM_NS, duration_ns):
        if (n := end.ping(_stop, period_ns, duration, _took)) < 0:
            return _took[:0], {}
    return _took[:n], end.sides()


def waited_ns() -> int:
    """How long this thread, in a process of the pair, was ready and did not run, ns; 0 where the
    kernel does not count it."""
    with suppress(OSError):
        return int(Path("/proc/thread-self/schedstat").read_text("ascii").split()[1])
    return 0


def _close() -> None:
    for end in _ends.values():
        end.close()
    _ends.clear()
