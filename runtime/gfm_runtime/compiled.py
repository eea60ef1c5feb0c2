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

numba names a compiled function by its arguments, and a record among them by a number that counts
the types of the process. The records of two sizes of plants, compiled by two processes, could so
have one name: a third process that loads both would call either for both. Here a record is named by
what it holds.
"""

from __future__ import annotations

import hashlib
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from numba import njit, types
from numba.core.caching import IndexDataCacheFile, _SourceFileBackedLocatorMixin

#: options of njit and cfunc; a division by 0 gives infinity or NaN as in C, and no branch
FREE: dict[str, Any] = {"cache": True, "nogil": True, "_nrt": False, "error_model": "numpy"}

#: decorator for such a function
compiled: Any = njit(**FREE)

#: decorator for the innermost functions, which become part of their callers: the compiler would
#: otherwise emit a call, pass every word of every array on the stack, and save registers
inlined: Any = njit(**FREE, forceinline=True)

#: decorator for a function of a tick that needs numba's runtime, as slices of arrays do
cached: Any = njit(cache=True, nogil=True, error_model="numpy")

#: where compiled functions, and constants that they contain, come from
_PLACES = {
    "gfm_runtime": ("",),
    "gfm_plant": ("",),
    "gfm_hil": ("core", "realtime", "links", "recording", "engine"),
}
#: rooms in these folders that generate text; no compiled function of another room calls theirs
_TEXT_ONLY = ("firmware",)
_own_stamp = _SourceFileBackedLocatorMixin.get_source_stamp


@cache
def _sources() -> tuple[tuple[Path, ...], bytes]:
    """The folders of our packages, and a digest of all that may be compiled into a function."""
    digest, folders = hashlib.sha256(), []
    for package, rooms in _PLACES.items():
        spec = find_spec(package)  # does not import it
        for folder in map(Path, (spec and spec.submodule_search_locations) or ()):
            folders.append(folder)
            for room in rooms:
                for file in sorted((folder / room).rglob("*.py")):
                    if file.relative_to(folder).parts[0] not in _TEXT_ONLY:
                        digest.update(file.read_bytes())
    return tuple(folders), digest.digest()


def _stamp(locator: Any) -> Any:
    """What numba compares with the stamp in its cache; of our files, it covers all of them."""
    folders, digest = _sources()
    own, file = _own_stamp(locator), Path(locator._py_file)
    return (own, digest) if any(file.is_relative_to(folder) for folder in folders) else own


_SourceFileBackedLocatorMixin.get_source_stamp = _stamp  # type: ignore[method-assign]


def _load_index(file: Any) -> Any:
    """What numba finds in a cache. It also holds the types of arguments, which an update may have
    taken away: such a cache is as good as none."""
    try:
        return _own_load_index(file)
    except (AttributeError, ImportError):
        return {}


_own_load_index = IndexDataCacheFile._load_index
IndexDataCacheFile._load_index = _load_index  # type: ignore[method-assign]


def _name_of_record(record: Any) -> tuple[str, tuple[int]]:
    """By what numba names a record among the arguments of a function."""
    return "Record", (int.from_bytes(hashlib.sha256(record.name.encode()).digest()[:8]),)


types.Record.mangling_args = property(_name_of_record)  # type: ignore[method-assign,assignment]
