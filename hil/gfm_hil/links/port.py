"""A link's end for compiled loops: first-class functions and a handle.

A loop is compiled once for all links: it gets the functions as values and calls them through
their address (3 ns). They use no Python object and never take the interpreter's lock.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numba.experimental.function_type  # noqa: F401  so that numba knows a PortFunction
import numpy as np
from numba import types
from numpy.typing import NDArray

from gfm_runtime.compiled import FREE, callback

#: signature of the functions: (handle, message) -> number
PORT_CALL = types.int64(types.int64[::1], types.uint8[::1])


@dataclass(frozen=True)
class Port:
    """One side's end of a link, for compiled loops."""

    # state of the functions (addresses, counters), int64; its owner keeps alive the memory that it
    # points to. After the link is closed, nothing may be called through it
    handle: NDArray[np.int64]
    send: Any  # sends the whole of ``message``: returns 1, or 0 if it dropped it
    # writes the next message to ``message``; returns its length in bytes, 0 if none has arrived, or
    # -1 if the link is lost: the link's own ``receive`` then raises and says why. A message that is
    # too long is dropped, and its length returned
    receive: Any
    # empty polls before a waiting loop begins to yield its processor: many if the peer delivers
    # directly, 0 if a thread of the link needs the processor to deliver
    spins: int
    # as ``receive``, but may sleep for up to a millisecond until a message arrives: for loops
    # without deadlines, after many empty polls. On a crowded machine a thread that only yields
    # keeps the peer that it waits for from running. None: the loop sleeps briefly instead
    patient: Any = None
    # empty polls after which a loop in lockstep may sleep: some hundred microseconds, so that loops
    # sleep only on a crowded machine
    spin_limit: int = 5000
    # tells the link whether there are pauses between the messages, as in real time
    paced: Callable[[bool], object] = bool

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
        return callback(self._function, PORT_CALL, **self._options)

    def __wrapper_address__(self) -> int:
        return int(self._compiled.address)

    def signature(self) -> Any:
        """As numba asks for it."""
        return PORT_CALL


def port_function(function: Callable[[Any, Any], int], cached: bool = True) -> PortFunction:
    """Make a function of (handle, message) one of a ``Port``; numba keeps what it compiles on disk
    unless ``cached`` is False."""
    return PortFunction(function, kept=cached)


def free_port_function(function: Callable[[Any, Any], int]) -> PortFunction:
    """The same for a function that does without numba's runtime, see ``gfm_runtime.compiled``:
    quicker, and all that it calls has to do without as well."""
    return PortFunction(function, **FREE)
