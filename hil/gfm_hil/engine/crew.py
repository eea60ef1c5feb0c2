"""Processor cores that run the parts of one plant, a thread each.

Parts ask nothing of each other within a tick, see `gfm_plant.parted`. Twice a tick the threads
meet: when all have taken over what the others sent, and when all have gone on. So each part sees
the same at the same tick, whoever runs it, and the bits do not depend on how many threads there
are.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from gfm_hil.realtime.atomics import load_acquire, store_release
from gfm_hil.realtime.clock import spin_or_yield
from gfm_plant import Network
from gfm_runtime.compiled import compiled

_SPINS = 2000  # looks at the others before the first yield
_WORD, _LINE = 8, 64  # bytes


class Share(NamedTuple):
    """What a thread has, as compiled loops take it."""

    table: int  # address of a line for each thread: how often it came, and whether it would leave
    threads: int
    me: int
    first: int  # of the parts of the plant
    end: int  # before which they end


ALL = Share(0, 1, 0, 0, 1 << 30)
"""That of the only thread."""


@compiled
def meet(share: Share, leaves: bool) -> bool:
    """Wait until all threads have come here; returns whether one of them leaves."""
    if share.threads == 1:
        return leaves
    mine = share.table + share.me * _LINE
    store_release(mine + _WORD, 1 if leaves else 0)
    turn = load_acquire(mine) + 1
    store_release(mine, turn)
    for other in range(share.threads):
        at, looks = share.table + other * _LINE, 0
        while load_acquire(at) < turn:
            looks += 1
            spin_or_yield(looks, _SPINS)
        leaves = leaves or load_acquire(at + _WORD) != 0
    return leaves


class Crew:
    """Threads for the parts of a plant, with about as many converters each."""

    def __init__(self, plant: Network, cores: int) -> None:
        ends = np.cumsum([len(part.par) for part in plant.pieces])
        cores = min(cores, len(ends))
        cuts = [0]
        for k in range(1, cores):
            best = int(np.abs(ends - ends[-1] * k / cores).argmin()) + 1
            cuts.append(min(max(best, cuts[-1] + 1), len(ends) - cores + k))
        self._table = np.zeros((cores + 1) * _LINE // _WORD, np.int64)
        at = self._table.ctypes.data
        at += -at % _LINE
        spans = zip(cuts, [*cuts[1:], len(ends)], strict=True)
        self.shares = [Share(at, cores, me, *span) for me, span in enumerate(spans)]
        self._pool = ThreadPoolExecutor(max(1, cores - 1), "parts")

    def run(self, work: Callable[..., Any], *args: Any) -> Any:
        """Call ``work`` with a share in each thread; all return the same."""
        others = [self._pool.submit(work, *args, share) for share in self.shares[1:]]
        found = work(*args, self.shares[0])
        for other in others:
            other.result()
        return found
