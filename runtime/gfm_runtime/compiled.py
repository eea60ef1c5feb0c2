"""How what runs in a tick is compiled: laws, loops, frames, the quick links.

Without numba's runtime: what would allocate does not compile, and no call counts references to the
arrays that it is given. Each count is a locked instruction, and a tick had dozens.
Arrays belong to whoever calls from Python, and outlive the call. numba compiles helpers of its own
this way; the option begins with an underscore, so versions that are known to have it are pinned.
"""

from __future__ import annotations

from typing import Any

from numba import njit

#: options of njit and cfunc
FREE: dict[str, Any] = {"cache": True, "nogil": True, "_nrt": False}

#: decorates such a function
compiled: Any = njit(**FREE)

#: and one that becomes part of whoever calls it, for the innermost: left to itself the compiler
#: calls it, hands over every word of every array on the stack, and saves registers
inlined: Any = njit(**FREE, forceinline=True)
