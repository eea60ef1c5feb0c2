"""Compilation of the functions of a tick: laws, plant, loops, frames, and links.

``compiled`` functions do without numba's runtime: code that would allocate does not compile, and
no call counts references to its arrays. Each count is a locked instruction, and a tick had dozens.
The Python caller owns the arrays and keeps them alive during the call. numba compiles its own
helpers in this way. The option begins with an underscore, so pyproject.toml pins numba to versions
that are known to have it.

numba keeps what it compiles on disk, and takes it for current as long as the function's own file
has not changed. But a compiled function contains its callees, which are in other files: after an
update, a stale one would compute something else without a word. Here any change of any of our
compiled code makes all of it compile again.
"""

from __future__ import annotations

import hashlib
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from numba import njit
from numba.core.caching import _SourceFileBackedLocatorMixin

#: options of njit and cfunc
FREE: dict[str, Any] = {"cache": True, "nogil": True, "_nrt": False}

#: decorator for such a function
compiled: Any = njit(**FREE)

#: decorator for the innermost functions, which become part of their callers: the compiler would
#: otherwise emit a call, pass every word of every array on the stack, and save registers
inlined: Any = njit(**FREE, forceinline=True)

#: decorator for a function of a tick that needs numba's runtime, as slices of arrays do
cached: Any = njit(cache=True, nogil=True)

_PACKAGES = ("gfm_runtime", "gfm_plant", "gfm_hil")
_own_stamp = _SourceFileBackedLocatorMixin.get_source_stamp


def _folders() -> list[Path]:
    """The folders of the packages whose compiled functions call one another."""
    specs = [find_spec(package) for package in _PACKAGES]  # imports none of them
    return [Path(at) for s in specs if s for at in s.submodule_search_locations or ()]


@cache
def _sources() -> tuple[frozenset[str], bytes]:
    """Every file with compiled code, and a digest of all of them."""
    digest, files = hashlib.sha256(), []
    for folder in _folders():
        for file in sorted(folder.rglob("*.py")):
            text = file.read_bytes()
            if b"compiled" in text or b"numba" in text:
                files.append(str(file))
                digest.update(text)
    return frozenset(files), digest.digest()


def _stamp(locator: Any) -> Any:
    """What numba compares with the stamp in its cache: of our files, all of them together."""
    files, digest = _sources()
    return digest if str(locator._py_file) in files else _own_stamp(locator)


_SourceFileBackedLocatorMixin.get_source_stamp = _stamp  # type: ignore[method-assign]
