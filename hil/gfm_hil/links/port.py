"""A link's end as compiled loops use it: two first-class functions and a handle.

A loop is compiled once for all links: it gets the functions as values and calls them through
their address (3 ns). They hold no Python object and never the interpreter's lock.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
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

    def __post_init__(self) -> None:
        """Have the functions compiled before a loop calls them."""
        for function in (self.send, self.receive, self.patient):
            if isinstance(function, PortFunction):
                function.__wrapper_address__()


class PortFunction(types.WrapperAddressProtocol):
    """A function of (handle, message) that compiled loops call by its address.

    numba compiles it, or loads it from its cache, when its first ``Port`` is made: importing a
    link compiles nothing.
    """

    def __init__(self, function: Callable[[Any, Any], int], **options: Any) -> None:
        self._function, self._options = function, options

    @cached_property
    def _compiled(self) -> Any:
        return cfunc(PORT_CALL, **self._options)(self._function)

    def __wrapper_address__(self) -> int:
        return int(self._compiled.address)

    def signature(self) -> Any:
        """As numba asks for it."""
        return PORT_CALL


def port_function(function: Callable[[Any, Any], int], cached: bool = True) -> PortFunction:
    """Make a function of (handle, message) one of a ``Port``; numba keeps what it compiles on disk
    unless ``cached`` is False."""
    return PortFunction(function, cache=cached)


def free_port_function(function: Callable[[Any, Any], int]) -> PortFunction:
    """The same for a function that does without numba's runtime, see ``gfm_runtime.compiled``:
    quicker, and all that it calls has to do without as well."""
    return PortFunction(function, **FREE)
