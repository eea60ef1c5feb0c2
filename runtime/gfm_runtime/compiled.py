"""Compilation of the functions of a tick: laws, loops, frames, and the fastest links.

They are compiled without numba's runtime: code that would allocate does not compile, and no call
counts references to its arrays. Each count is a locked instruction, and a tick had dozens.
The Python caller owns the arrays and keeps them alive during the call. numba compiles its own
helpers in this way. The option begins with an underscore, so pyproject.toml pins numba to versions
that are known to have it.
"""

from __future__ import annotations

from typing import Any

from numba import njit

#: options of njit and cfunc
FREE: dict[str, Any] = {"cache": True, "nogil": True, "_nrt": False}

#: decorator for such a function
compiled: Any = njit(**FREE)

#: decorator for the innermost functions, which become part of their callers: the compiler would
#: otherwise emit a call, pass every word of every array on the stack, and save registers
inlined: Any = njit(**FREE, forceinline=True)
