"""How everything that runs in a tick is compiled; see ``gfm_runtime.compiled``, which this repeats
so that the plant needs nothing of the controller."""

from __future__ import annotations

from typing import Any

from numba import njit

_FREE: dict[str, Any] = {"cache": True, "nogil": True, "_nrt": False}

#: without numba's runtime: nothing allocates, no references are counted
compiled: Any = njit(**_FREE)
