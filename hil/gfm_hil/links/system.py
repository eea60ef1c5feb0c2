"""What the links' compiled functions share of libc: errno and poll."""

from typing import Any

from numba import int64, types

from gfm_hil.realtime.atomics import load32
from gfm_runtime.compiled import compiled

_errno_place: Any = types.ExternalFunction("__errno_location", types.int64())

#: poll(2): address of the structures, how many, and ms
poll: Any = types.ExternalFunction("poll", types.int32(types.int64, types.int64, types.int32))


@compiled
def errno_now():
    """errno of the previous call."""
    return int64(load32(_errno_place()))
