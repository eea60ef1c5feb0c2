"""Compilation of the functions of a tick: laws, plant, loops, frames, and links.

``compiled`` functions do without numba's runtime: code that would allocate does not compile, and
no call counts references to its arrays. Each count is a locked instruction, and a tick had dozens.
The Python caller owns the arrays and keeps them alive during the call. numba compiles its own
helpers in this way. The option begins with an underscore, so pyproject.toml pins numba to versions
that are known to have it.

numba keeps what it compiles on disk, and takes it for current as long as the function's own file
has not changed. But a compiled function contains its callees, which are in other files: after an
update, a stale one would compute something else without a word. ``_Cache`` compiles again after any
change of any of our compiled code.

A wheel may carry what numba would compile; ``_Cache`` looks there first (``wheel_code``).

All act on the functions that are decorated here and on no others: a program that imports us keeps
numba as it is.
"""

import fcntl
import hashlib
import inspect
import os
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.ccallback import CFunc
from numba.core.runtime.nrt import rtsys
from numba.core.sigutils import normalize_signature
from numba.extending import intrinsic as _intrinsic

from gfm_runtime.deferred import DeferredDispatcher, Deferring, KeptResult
from gfm_runtime.wheel_code import WheelCode, name_of

#: where compiled functions, and constants that they contain, come from
_PLACES = {
    "gfm_runtime": ("",),
    "gfm_plant": ("",),
    "gfm_hil": ("core", "realtime", "links", "recording", "engine"),
}
#: rooms in these folders that generate text; no compiled function of another room calls theirs
_TEXT_ONLY = ("firmware",)


@cache
def sources() -> bytes:
    """A digest of all that may be compiled into a function."""
    digest = hashlib.sha256()
    for package, rooms in _PLACES.items():
        spec = find_spec(package)  # does not import it
        for folder in map(Path, (spec and spec.submodule_search_locations) or ()):
            for room in rooms:
                for file in sorted((folder / room).rglob("*.py")):
                    if file.relative_to(folder).parts[0] not in _TEXT_ONLY:
                        digest.update(file.read_bytes())
    return digest.digest()


@cache
def wheel_code() -> WheelCode:
    """The machine code that the wheel carries."""
    return WheelCode(sources().hex())


class _Index(IndexDataCacheFile):
    """The index of a cache: it also holds the types of arguments, which an update may have taken
    away. Such a cache is as good as none.

    Several processes may write at a time. numba numbers the files of a function, so that two would
    write code for different arguments to one file, and each would write an index without the
    other's. Here a file has the name of its arguments, and the index is changed under a lock."""

    _cache_path: str
    _save_data: Any
    _save_index: Any
    _data_name: Any

    def save(self, key: Any, data: Any) -> None:
        """As numba asks for it, with a function that it has compiled."""
        name = self._data_name(int(hashlib.sha256(repr(key).encode()).hexdigest()[:15], 16))
        self._save_data(name, data)
        folder = os.open(self._cache_path, os.O_RDONLY)
        try:
            with suppress(OSError):  # of a file system without locks
                fcntl.flock(folder, fcntl.LOCK_EX)
            kept = self._load_index()
            if kept.get(key) != name:
                self._save_index({**kept, key: name})
        finally:
            os.close(folder)

    def _load_index(self) -> Any:
        try:
            return super()._load_index()
        except (AttributeError, ImportError):
            return {}


class _Cache(FunctionCache):
    """numba's cache of a function, current as long as all our compiled code is the same."""

    _impl_class = KeptResult
    links = False  # numba compiles a caller, into which it links the function

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __getattr__(self, name: str) -> Any:
        """At its first use, find where it is on disk: a process uses few of our functions."""
        if name == "_function" or "_enabled" in vars(self):
            raise AttributeError(name)
        super().__init__(self._function)
        source = self._impl.locator.get_source_stamp()
        place = Path(inspect.getfile(self._function)).parent.name
        self._from = place, self._impl.filename_base, source
        stamp = (source, sources())
        self._cache_file = _Index(self._cache_path, self._impl.filename_base, stamp)
        return getattr(self, name)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """As numba asks for it: from the wheel, or from its own cache.

        numba would first import all that it can compile, and with it scipy.linalg, which takes
        longer than all our functions; when it compiles a caller, it has done so already."""
        rtsys.initialize(target_context)
        if self._enabled and not self.links:
            key = self._index_key(sig, target_context.codegen())
            kept = wheel_code().load(name_of(*self._from, key))
            if kept is not None:
                found = self._impl.rebuild(target_context, kept)
                found.entry_point.linkable = False
                return found
        return self._load_overload(sig, target_context)


#: options of numba; a division by 0 gives infinity or NaN as in C, and no branch. Without a word on
#: ``forceinline`` a function would inherit it from the caller that has it compiled first.
FREE: dict[str, Any] = {
    "nogil": True, "_nrt": False, "error_model": "numpy", "forceinline": False,
}  # fmt: skip


def _decorator(**options: Any) -> Any:
    """``numba.njit`` with our compiler and our cache."""

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = _dispatcher(function, options)
        dispatcher._cache = _Cache(function)
        return dispatcher

    return decorate


def _dispatcher(function: Callable[..., Any], options: dict[str, Any]) -> DeferredDispatcher:
    return DeferredDispatcher(function, {}, {**options, "nopython": True}, Deferring)


def callback(
    function: Callable[..., Any], signature: Any, kept: bool = True, **options: Any
) -> CFunc:
    """Compile a function for callers in C, who use its ``address``; ``kept``: in our cache."""
    made = CFunc(function, normalize_signature(signature), {}, options, Deferring)
    if kept:
        made._cache = _Cache(function)  # type: ignore[attr-defined]
    made.compile()
    return made


#: numba's decorator; its stubs count typingctx among the caller's arguments
intrinsic: Any = _intrinsic

#: decorator for such a function
compiled: Any = _decorator(**FREE)

#: decorator for the innermost functions, which become part of their callers: the compiler would
#: otherwise emit a call, pass every word of every array on the stack, and save registers
inlined: Any = _decorator(**{**FREE, "forceinline": True})

#: decorator for a function whose sums may be taken in any order, so that they are taken of several
#: numbers at a time; their last bits then depend on the processor
summing: Any = _decorator(**FREE, fastmath={"reassoc"})


def expanded(function: Callable[..., Any]) -> Any:
    """For a function that returns a view of its argument: numba puts it into its callers before it
    looks at types, since a function without numba's runtime cannot return an array of its own."""
    return _dispatcher(function, {**FREE, "inline": "always"})


def inlined_as(name: str, function: Callable[..., Any]) -> Any:
    """As ``inlined``, for a function that is made at run time and calls functions it was made with.

    It is kept as part of its callers alone, under this name, which tells it from others that were
    made in the same place.
    """
    function.__name__ = function.__qualname__ = name
    return _dispatcher(function, {**FREE, "forceinline": True})


#: decorator for a function of a tick that needs numba's runtime, as slices of arrays do
cached: Any = _decorator(**{**FREE, "_nrt": True})
