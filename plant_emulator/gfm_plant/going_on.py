"""How a plant goes on between two instants of a sampling period: averaged, or from edge to edge;
without components that have states of their own, or with them.

A compiled function contains all that it calls, and LLVM optimises the callees again in each caller.
The ways are large and have several callers. So callers reach them by an address in the plant's
records: each is compiled once, and only for a plant that needs it.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

from llvmlite import ir
from numba import typeof, types
from numba.core import cgutils

from gfm_plant.bridge import advance_bridges
from gfm_plant.layout import intrinsic
from gfm_plant.moving import advance_moving
from gfm_plant.period import advance_alone, advance_with_components
from gfm_plant.records import PlantRecords
from gfm_runtime.compiled import FREE, callback, inlined


def find_address(plant: PlantRecords) -> int:
    """Compile, or load, the way of this plant, and return its address."""
    net = plant.net[0]
    ways = (_switched, _moving) if net["n_units"] else (_alone, _with_components)
    return address_of(typeof(plant), ways[int(net["n_dynamic"] > 0)])


@cache
def address_of(kind: Any, way: Callable[..., None]) -> int:
    """Compile, or load, a function for ``call_at``, and return its address; ``kind``: numba's type
    of the plant's records."""
    signature = types.void(types.CPointer(kind), types.float64, types.float64)
    address: Any = callback(way, signature, **FREE).address
    return address


def _alone(plant: Any, begin: float, end: float) -> None:
    advance_alone(plant[0], begin, end)


def _with_components(plant: Any, begin: float, end: float) -> None:
    advance_with_components(plant[0], begin, end)


def _switched(plant: Any, begin: float, end: float) -> None:
    advance_bridges(plant[0], begin, end)


def _moving(plant: Any, begin: float, end: float) -> None:
    advance_moving(plant[0], begin, end)


@inlined
def advance(plant: PlantRecords, begin: float, end: float) -> None:
    """Go on between two instants of the period, s after its beginning; inf: to its end."""
    call_at(plant.net[0].advance, plant, begin, end)


@intrinsic
def call_at(typingctx: Any, address: Any, plant: Any, begin: Any, end: Any) -> Any:
    """Call the function at an address, with these arguments, inside compiled functions."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        at, *others = arguments
        others[0] = cgutils.alloca_once_value(builder, others[0])
        kind = ir.FunctionType(ir.IntType(8).as_pointer(), [one.type for one in others])
        builder.call(builder.inttoptr(at, kind.as_pointer()), others)
        return context.get_dummy_value()

    return types.void(types.int64, plant, types.float64, types.float64), make
