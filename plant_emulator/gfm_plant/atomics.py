"""Memory that threads or processes share, inside numba: ordered loads and stores at an address.

numba has no atomics on the CPU; llvmlite has the instructions. A thread whose acquire load reads
the value of a release store sees all writes before that store (C11 and LLVM's "Atomic Memory
Ordering").
"""

from typing import Any

from llvmlite import ir
from numba import types

from gfm_runtime.compiled import intrinsic

_WORD = ir.IntType(64)

#: yield_processor(): yield the processor
yield_processor: Any = types.ExternalFunction("sched_yield", types.int32())


@intrinsic
def load_acquire(typingctx, address):
    """Load the int64 at an address; later reads cannot be moved before it."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = builder.inttoptr(arguments[0], _WORD.as_pointer())
        return builder.load_atomic(pointer, "acquire", 8)

    return types.int64(types.int64), make


@intrinsic
def store_release(typingctx, address, value):
    """Store an int64 at an address; earlier writes become visible before it."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = builder.inttoptr(arguments[0], _WORD.as_pointer())
        builder.store_atomic(arguments[1], pointer, "release", 8)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64), make


@intrinsic
def pause(typingctx):
    """Hint to the processor that the thread spins: ``pause`` on x86, nothing elsewhere."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        module = builder.module
        if module.triple.startswith(("x86_64", "i386", "i686")):
            name = "llvm.x86.sse2.pause"
            known = module.globals.get(name)
            builder.call(known or ir.Function(module, ir.FunctionType(ir.VoidType(), []), name), [])
        return context.get_dummy_value()

    return types.void(), make


@intrinsic
def record_at(typingctx, address, like):
    """Return the record at an address; ``like``: another one, which is of the same type."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(like))

    return like(types.int64, like), make
