"""Time for compiled loops: read CLOCK_MONOTONIC, sleep until a deadline, yield.

They call libc directly, so that they allocate nothing and numba can cache them.
"""

from typing import Any

from llvmlite import ir
from numba import types

from gfm_hil.realtime.atomics import pause as pause
from gfm_plant.atomics import yield_processor as yield_processor
from gfm_runtime.compiled import compiled, intrinsic

_MONOTONIC, _ABSTIME = 1, 1  # CLOCK_MONOTONIC, TIMER_ABSTIME of time.h on Linux
_NS = 1_000_000_000
_SIGKILL = 9

_I32, _I64 = ir.IntType(32), ir.IntType(64)
_TIMESPEC = ir.LiteralStructType([_I64, _I64])

_SPINS_A_YIELD = 16  # polls per yield, once a peer that delivers directly is late

#: wake this long before a deadline and spin the rest: a sleep may end this late
AHEAD_NS = 40_000

_raise: Any = types.ExternalFunction("raise", types.int32(types.int32))


def _libc(builder: Any, name: str, arguments: list[ir.Type]) -> Any:
    kind = ir.FunctionType(_I32, arguments)
    known = builder.module.globals.get(name)
    return known if known is not None else ir.Function(builder.module, kind, name)


def _timespec(builder: Any) -> Any:
    with builder.goto_entry_block():  # allocate once per call, not once per iteration
        return builder.alloca(_TIMESPEC)


def _field(builder: Any, timespec: Any, k: int) -> Any:
    return builder.gep(timespec, [_I32(0), _I32(k)], inbounds=True)


@intrinsic
def now_ns(typingctx):
    """CLOCK_MONOTONIC in ns, int64."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        timespec = _timespec(builder)
        read = _libc(builder, "clock_gettime", [_I32, _TIMESPEC.as_pointer()])
        builder.call(read, [_I32(_MONOTONIC), timespec])
        seconds, ns = (builder.load(_field(builder, timespec, k)) for k in (0, 1))
        return builder.add(builder.mul(seconds, _I64(_NS)), ns)

    return types.int64(), make


@intrinsic
def sleep_until(typingctx, deadline_ns):
    """Sleep until a time of CLOCK_MONOTONIC, int64 ns; returns at once if it has passed."""
    if not isinstance(deadline_ns, types.Integer):
        return None

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        timespec = _timespec(builder)
        parts = builder.sdiv(arguments[0], _I64(_NS)), builder.srem(arguments[0], _I64(_NS))
        for k, part in enumerate(parts):
            builder.store(part, _field(builder, timespec, k))
        pointer = _TIMESPEC.as_pointer()
        sleep = _libc(builder, "clock_nanosleep", [_I32, _I32, pointer, pointer])
        return builder.call(sleep, [_I32(_MONOTONIC), _I32(_ABSTIME), timespec, pointer(None)])

    return types.int32(types.int64), make


@compiled
def end_this_process():
    """Kill this process: send SIGKILL to itself."""
    return _raise(_SIGKILL)


@compiled
def wait_until(deadline_ns, spins):
    """Sleep until shortly before a deadline, then spin; returns the longest gap in the spin, ns.

    Under SCHED_FIFO the kernel throttles a thread that only spins; a thread that only sleeps wakes
    late. A gap is time that other work on the processor, or the host, took.
    """
    gap = 0
    before = now_ns()
    if deadline_ns - before > AHEAD_NS:
        sleep_until(deadline_ns - AHEAD_NS)
        before = now_ns()
    while before < deadline_ns:
        now = now_ns()
        gap = max(gap, now - before)
        before = now
        if spins == 0:
            yield_processor()
    return gap


@compiled
def spin_or_yield(looks, spins):
    """Spin or yield after a waiting loop's ``looks``-th empty poll. If the peer delivers directly
    (``spins`` > 0), it spins for ``spins`` polls and then yields every 16th poll only, since a
    yield takes as long as a message; else it yields every time."""
    if looks <= spins or (spins > 0 and looks % _SPINS_A_YIELD != 0):
        pause()
    else:
        yield_processor()
