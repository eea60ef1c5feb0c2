"""Eight numbers at a time, inside compiled functions: a register of the processor, or two.

LLVM makes such instructions of a loop over eight numbers by itself, but each loop begins with a
look whether its arrays overlap, and leaves its numbers in memory. A vector is a value as a number
is: ``+``, ``-``, ``*``, ``/``, ``abs``, ``max``, ``min``, ``np.sqrt``, ``np.floor``, comparisons,
and ``&``, ``|`` and ``~`` of these act on all eight, with the bits that each would have alone, so
that functions without a branch take vectors too. A number beside a vector counts eight times.
"""

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.cgutils import get_or_insert_function
from numba.core.imputils import lower_builtin, lower_cast
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import models, register_model

from gfm_runtime.compiled import inlined, intrinsic

WIDTH = 8
_INT32 = ir.IntType(32)
_KINDS = {types.float64: ir.DoubleType(), types.int64: ir.IntType(64), types.boolean: ir.IntType(1)}


class Vector(types.Type):
    """numba's type of eight numbers of a kind."""

    def __init__(self, kind: Any) -> None:
        self.kind, self.llvm = kind, ir.VectorType(_KINDS[kind], WIDTH)
        super().__init__(f"{kind}x{WIDTH}")


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, vector: Vector) -> None:
        super().__init__(manager, vector, vector.llvm)


_FLOATS, _INTEGERS, _TRUTHS = map(Vector, _KINDS)


@lower_cast(types.Number, Vector)
@lower_cast(types.Boolean, Vector)
def _repeat(context: Any, builder: Any, kind: Any, vector: Vector, number: Any) -> Any:
    one = context.cast(builder, number, kind, vector.kind)
    first = builder.insert_element(vector.llvm(ir.Undefined), one, _INT32(0))
    return builder.shuffle_vector(
        first, first, ir.Constant(ir.VectorType(_INT32, WIDTH), [0] * WIDTH)
    )


_OF_ONE = (operator.neg, operator.invert, abs, np.sqrt, np.floor)


def _operator(symbol: Any, of: Vector, result: Vector, make: Callable[..., Any]) -> None:
    """Define an operator of vectors of a kind, and of such a vector and a number."""

    class Template(AbstractTemplate):
        key = symbol

        def generic(self, args: Any, kws: Any) -> Any:
            vectors = [one for one in args if isinstance(one, Vector)]
            if vectors and all(one == of for one in vectors):
                return signature(result, *[of] * len(args))
            return None

    infer_global(symbol)(Template)
    operands = 1 if symbol in _OF_ONE else 2
    lower_builtin(symbol, *[of] * operands)(lambda _, builder, kind, args: make(builder, *args))


def _compare(how: str) -> Callable[..., Any]:
    return lambda builder, a, b: builder.fcmp_ordered(how, a, b)


def _chosen(how: str) -> Callable[..., Any]:
    return lambda builder, a, b: builder.select(builder.fcmp_ordered(how, b, a), b, a)


for _symbol, _made in (
    (operator.add, ir.IRBuilder.fadd), (operator.sub, ir.IRBuilder.fsub),
    (operator.mul, ir.IRBuilder.fmul), (operator.truediv, ir.IRBuilder.fdiv),
    (operator.neg, ir.IRBuilder.fneg),
):  # fmt: skip
    _operator(_symbol, _FLOATS, _FLOATS, _made)
for _symbol, _how in (
    (operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">="),
):  # fmt: skip
    _operator(_symbol, _FLOATS, _TRUTHS, _compare(_how))
for _symbol, _how in ((max, ">"), (min, "<")):  # the second, if it is; a NaN that is first stays
    _operator(_symbol, _FLOATS, _FLOATS, _chosen(_how))
_operator(operator.ne, _FLOATS, _TRUTHS, lambda builder, a, b: builder.fcmp_unordered("!=", a, b))
_operator(operator.eq, _INTEGERS, _TRUTHS, lambda builder, a, b: builder.icmp_signed("==", a, b))
_operator(operator.and_, _TRUTHS, _TRUTHS, ir.IRBuilder.and_)
_operator(operator.or_, _TRUTHS, _TRUTHS, ir.IRBuilder.or_)
_operator(operator.invert, _TRUTHS, _TRUTHS, lambda builder, a: builder.not_(a))


def _of_llvm(name: str) -> Callable[..., Any]:
    def make(builder: Any, x: Any) -> Any:
        kind = ir.FunctionType(_FLOATS.llvm, [_FLOATS.llvm])
        function = get_or_insert_function(builder.module, kind, f"llvm.{name}.v{WIDTH}f64")
        return builder.call(function, [x])

    return make


_operator(np.sqrt, _FLOATS, _FLOATS, _of_llvm("sqrt"))
_operator(np.floor, _FLOATS, _FLOATS, _of_llvm("floor"))
_operator(abs, _FLOATS, _FLOATS, _of_llvm("fabs"))


@intrinsic
def vector(typingctx, row):
    """The eight numbers of a row, float64 or int64, without gaps."""
    kind = {types.float64: _FLOATS, types.int64: _INTEGERS}[row.dtype]

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(_place(context, builder, row, arguments[0], kind), align=8)

    return kind(row), make


@intrinsic
def put(typingctx, row, numbers):
    """Put eight numbers into a row."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        place = _place(context, builder, row, arguments[0], numbers)
        builder.store(arguments[1], place, align=8)
        return context.get_dummy_value()

    return types.void(row, numbers), make


def _place(context: Any, builder: Any, kind: Any, row: Any, vector: Vector) -> Any:
    data = context.make_array(kind)(context, builder, row).data
    return builder.bitcast(data, vector.llvm.as_pointer())


@intrinsic
def where(typingctx, truths, one, other):
    """Of each of eight numbers ``one`` if it is true, else ``other``; either may be a number."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(*arguments)

    return _FLOATS(_TRUTHS, _FLOATS, _FLOATS), make


@intrinsic
def everywhere(typingctx, truth):
    """A truth eight times."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return arguments[0]

    return _TRUTHS(_TRUTHS), make


@intrinsic
def bits(typingctx, truths):
    """Eight truths as the bits of an integer, the first the lowest."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.zext(builder.bitcast(arguments[0], ir.IntType(WIDTH)), ir.IntType(64))

    return types.int64(_TRUTHS), make


@inlined
def times(a, b):
    """The product of complex numbers, each (real, imaginary)."""
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


@inlined
def plus(a, b):
    """The sum of complex numbers."""
    return a[0] + b[0], a[1] + b[1]
