"""Functions that compiled code calls by an address in a plant's records, see `ways`.

A compiled function contains all that it calls, and LLVM optimises the callees again in each caller.
What is called by its address is compiled once, and only for a plant that needs it.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

from llvmlite import ir
from numba import types

from gfm_plant.layout import intrinsic
from gfm_runtime.compiled import FREE, callback


@cache
def address_of(kinds: tuple[Any, ...], way: Callable[..., None]) -> int:
    """Compile, or load, a function for ``call_at`` or ``call_circuit_at``, and return its address.

    Args:
        kinds: numba's types of what it works on: a pointer to a plant's records, or the records
            ``n`` and ``now`` of its circuit, which are pointers themselves.
        way: (each of these, two numbers).
    """
    signature = types.void(*kinds, types.float64, types.float64)
    address: Any = callback(way, signature, **FREE).address
    return address


@intrinsic
def call_at(typingctx: Any, address: Any, plant: Any, a: Any, b: Any) -> Any:
    """Call the function of a plant at an address, inside compiled functions."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        at, records, *numbers = arguments
        with builder.goto_entry_block():  # numba's own ``alloca_once`` fills it with zeros there
            place = builder.alloca(records.type)
        builder.store(records, place)
        _call(builder, at, [place, *numbers])
        return context.get_dummy_value()

    return types.void(types.int64, plant, types.float64, types.float64), make


@intrinsic
def call_circuit_at(typingctx: Any, address: Any, n: Any, now: Any, a: Any, b: Any) -> Any:
    """Call the function of a circuit at an address, inside compiled functions."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        at, *others = arguments
        _call(builder, at, others)
        return context.get_dummy_value()

    return types.void(types.int64, n, now, types.float64, types.float64), make


def _call(builder: Any, address: Any, arguments: Any) -> None:
    kind = ir.FunctionType(ir.IntType(8).as_pointer(), [one.type for one in arguments])
    builder.call(builder.inttoptr(address, kind.as_pointer()), arguments)
