"""Memory at an address, inside numba: prefetches, rows, copies and numbers of a few bits; and the
ordered loads and stores of `gfm_plant.atomics`."""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core.cgutils import pack_array, raw_memcpy

from gfm_plant.atomics import load_acquire as load_acquire
from gfm_plant.atomics import pause as pause
from gfm_plant.atomics import store_release as store_release
from gfm_runtime.compiled import intrinsic

_WORD = ir.IntType(64)
_BYTES = ir.IntType(8).as_pointer()


@intrinsic
def prefetch(typingctx, address):
    """Prefetch the cache line at an address for writing."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        i32 = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [_BYTES, i32, i32, i32])
        name = "llvm.prefetch.p0i8"
        known = builder.module.globals.get(name)
        function = known or ir.Function(builder.module, kind, name)
        write, soon, data = i32(1), i32(3), i32(1)
        builder.call(function, [builder.inttoptr(arguments[0], _BYTES), write, soon, data])
        return context.get_dummy_value()

    return types.void(types.int64), make


@intrinsic
def row_at(typingctx, address, n, k):
    """Return row k of a table of n float64 columns at an address."""
    array = types.Array(types.float64, 1, "C")

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address, n, k = arguments
        made, stride = context.make_array(array)(context, builder), _WORD(8)
        first = builder.add(address, builder.mul(k, builder.mul(n, stride)))
        made.data = builder.inttoptr(first, made.data.type)
        made.shape, made.strides = pack_array(builder, [n]), pack_array(builder, [stride])
        made.itemsize, made.nitems = stride, n
        return made._getvalue()

    return array(types.int64, types.int64, types.int64), make


@intrinsic
def copy(typingctx, to, origin, size):
    """Copy ``size`` bytes from one address to another."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        to, origin = (builder.inttoptr(address, _BYTES) for address in arguments[:2])
        raw_memcpy(builder, to, origin, arguments[2], 1)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int64), make


def _make_load(bits: int, kind: types.Integer) -> Any:
    """An intrinsic that reads a little-endian number of ``bits`` bits at an address."""

    def load(typingctx, address):
        def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            pointer = builder.inttoptr(arguments[0], ir.IntType(bits).as_pointer())
            return builder.load(pointer, align=1)

        return kind(types.int64), make

    return intrinsic(load)


load32, load64 = _make_load(32, types.uint32), _make_load(64, types.uint64)


@intrinsic
def store32(typingctx, address, value):
    """Store a uint32 at an address, little-endian."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = builder.inttoptr(arguments[0], ir.IntType(32).as_pointer())
        builder.store(arguments[1], pointer, align=1)
        return context.get_dummy_value()

    return types.void(types.int64, types.uint32), make
