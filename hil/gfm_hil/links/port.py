"""A link's end as compiled loops use it: two first-class functions and a handle.

A loop is compiled once for all links: it gets the functions as values and calls them through
their address (3 ns). They hold no Python object and never the interpreter's lock.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import cfunc, types
from numpy.typing import NDArray

from gfm_runtime.compiled import FREE

#: what both functions look like: (handle, message) -> number
PORT_CALL = types.int64(types.int64[::1], types.uint8[::1])


@dataclass(frozen=True)
class Port:
    """One side's end of a link, for compiled loops.

    Attributes:
        handle: whatever the functions need (addresses, counters), int64; its owner keeps alive
            what it points to, and a closed link must no longer be called through it.
        send: hands the whole of ``message`` over: 1, or 0 if it had to be dropped.
        receive: writes the next message to ``message``; returns its bytes, 0 if none has arrived,
            or -1 if the link is gone: its own ``receive`` then raises and says why. One that is
            too long returns its length and is gone.
        spins: looks in vain before a waiting loop begins to yield its processor: many where
            the peer itself delivers, 0 where a thread of the link needs the processor for it.
        patient: as ``receive``, but may sleep for up to a millisecond until there is something:
            for loops without deadlines, once they have looked in vain for a while. On a crowded
            machine a thread that yields for ever keeps the very peer from running that it waits
            for. None: the loop takes naps.
        spin_limit: reads in vain after which a loop in lockstep may nap: some hundred microseconds,
            so that only a crowded machine sees naps.
    """

    handle: NDArray[np.int64]
    send: Any
    receive: Any
    spins: int
    patient: Any = None
    spin_limit: int = 5000


def port_function(function: Callable[[Any, Any], int], cached: bool = True) -> Any:
    """Compile a function of (handle, message) for a ``Port``; kept on disk unless told not to."""
    return cfunc(PORT_CALL, cache=cached)(function)


def free_port_function(function: Callable[[Any, Any], int]) -> Any:
    """The same for one that does without numba's runtime, see ``gfm_runtime.compiled``: quicker,
    and all that it calls has to do without as well."""
    return cfunc(PORT_CALL, **FREE)(function)
