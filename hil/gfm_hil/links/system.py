"""What the links' compiled functions share of libc: errno and poll."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import carray, types  # type: ignore[attr-defined]

from gfm_runtime.compiled import cached

_errno_place: Any = types.ExternalFunction("__errno_location", types.CPointer(types.int32)())

#: poll(2): address of the structures, how many, and ms
poll: Any = types.ExternalFunction("poll", types.int32(types.int64, types.int64, types.int32))


@cached
def errno_now():
    """errno of the previous call."""
    return np.int64(carray(_errno_place(), 1)[0])
