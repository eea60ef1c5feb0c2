"""Functions that compiled code calls by an address in its records.

A compiled function contains all that it calls, and LLVM optimises the callees again in each caller.
What is called by its address is compiled once, and only for a run that needs it.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.errors import TypingError
from numpy.typing import NDArray

from gfm_runtime.compiled import FREE, callback, intrinsic


@cache
def address_of(kinds: tuple[Any, ...], way: Callable[..., None]) -> int:
    """Compile, or load, a function for ``call_at`` or ``call_records_at``, and return its address.

    Args:
        kinds: numba's types of what it works on: a pointer to a tuple of arrays, as a plant's
            records, or two records, which are pointers themselves.
        way: (each of these, two numbers).
    """
    signature = types.void(*kinds, types.float64, types.float64)
    address: Any = callback(way, signature, **FREE).address
    return address


def in_memory(records: tuple[Any, ...]) -> NDArray[np.int64]:
    """A tuple of arrays of one dimension, and of such tuples, as compiled functions have it in
    memory; the arrays have to live as long."""
    words = list[int]()
    for one in records:
        if isinstance(one, tuple):
            words += in_memory(one).tolist()
        else:  # not counted, of no object
            words += [0, 0, one.size, one.itemsize, one.ctypes.data, *one.shape, *one.strides]
    return np.array(words)


@intrinsic
def on_stack(typingctx: Any, records: Any) -> Any:
    """Copy a tuple of arrays to the stack, inside compiled functions; returns its address.

    Who is called knows the arrays as ``in_memory`` puts them there: others would be misread.
    """
    if any(one.layout != "C" or one.dtype == types.float32 for one in records):
        raise TypingError("arrays without gaps, of records or of float64")

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        with builder.goto_entry_block():  # numba's own ``alloca_once`` fills it with zeros there
            place = builder.alloca(arguments[0].type)
        builder.store(arguments[0], place)
        return builder.ptrtoint(place, ir.IntType(64))

    return types.int64(records), make


@intrinsic
def call_at(typingctx: Any, address: Any, records: Any, a: Any, b: Any) -> Any:
    """Call the function at an address, inside compiled functions; ``records`` is the address of a
    tuple of arrays."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        at, place, *numbers = arguments
        place = builder.inttoptr(place, ir.IntType(8).as_pointer())
        _call(builder, at, [place, *numbers])
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.float64, types.float64), make


@intrinsic
def call_records_at(typingctx: Any, address: Any, first: Any, second: Any, a: Any, b: Any) -> Any:
    """Call the function at an address with two records, inside compiled functions."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        at, *others = arguments
        _call(builder, at, others)
        return context.get_dummy_value()

    return types.void(types.int64, first, second, types.float64, types.float64), make


def _call(builder: Any, address: Any, arguments: Any) -> None:
    kind = ir.FunctionType(ir.IntType(8).as_pointer(), [one.type for one in arguments])
    builder.call(builder.inttoptr(address, kind.as_pointer()), arguments)
