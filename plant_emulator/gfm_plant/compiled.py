"""Compilation of the functions of a tick. This repeats ``gfm_runtime.compiled``, so that the plant
needs nothing of the controller."""

from __future__ import annotations

from typing import Any

from numba import njit

_FREE: dict[str, Any] = {"cache": True, "nogil": True, "_nrt": False}

#: without numba's runtime: nothing allocates, no references are counted
compiled: Any = njit(**_FREE)
