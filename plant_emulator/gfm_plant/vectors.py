"""Vectors of four numbers in compiled functions, for sums that numba would add up one by one."""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from gfm_runtime.compiled import intrinsic

REAL, INT = ir.DoubleType(), ir.IntType(64)
FOUR = ir.VectorType(REAL, 4)
VOID = ir.Constant(FOUR, ir.Undefined)
ZERO = ir.Constant(FOUR, [0.0] * 4)
ROWS = 12
"""How many rows of a table `add_product` goes through at a time; a table has a multiple of them."""


def splat(builder: Any, vector: Any, lane: int) -> Any:
    return shuffle(builder, vector, VOID, [lane] * 4)


def shuffle(builder: Any, one: Any, other: Any, lanes: list[int]) -> Any:
    chosen = ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), lanes)
    return builder.shuffle_vector(one, other, chosen)


def all_four(builder: Any, value: Any) -> Any:
    return splat(builder, builder.insert_element(VOID, value, INT(0)), 0)


def at(builder: Any, base: Any, place: Any) -> Any:
    """A pointer to four numbers, ``place`` numbers behind another one."""
    place = INT(place) if isinstance(place, int) else place
    return builder.bitcast(builder.gep(base, [place]), FOUR.as_pointer())


def load(builder: Any, base: Any, place: Any) -> Any:
    return builder.load(at(builder, base, place), align=8)


def store(builder: Any, value: Any, base: Any, place: Any) -> None:
    builder.store(value, at(builder, base, place), align=8)


def add(builder: Any, a: Any, b: Any, to: Any) -> Any:
    """a b + to, in one rounding where the processor can."""
    if to is None:
        return builder.fmul(a, b)
    name, kind = "llvm.fmuladd.v4f64", ir.FunctionType(FOUR, [FOUR] * 3)
    call = builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
    return builder.call(call, [a, b, to])


def pointer(context: Any, builder: Any, kind: Any, array: Any) -> Any:
    return context.make_array(kind)(context, builder, array).data


def rows_of(context: Any, builder: Any, kind: Any, array: Any) -> tuple[Any, Any]:
    """A pointer to an array of two axes, and how long its rows are."""
    one = context.make_array(kind)(context, builder, array)
    return one.data, cgutils.unpack_tuple(builder, one.shape)[1]


@intrinsic
def add_product(
    typingctx: Any, table: Any, columns: Any, first: Any, rows: Any, x: Any, y: Any
) -> Any:
    """Add to y, (2, .), from row ``first`` to ``rows`` the product of a table, (columns, .), with
    x, (2, columns)."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kinds = signature.args
        base, width = rows_of(context, builder, kinds[0], arguments[0])
        x, x_width = rows_of(context, builder, kinds[4], arguments[4])
        y, y_width = rows_of(context, builder, kinds[5], arguments[5])
        columns, first, rows = arguments[1:4]
        sums = [cgutils.alloca_once(builder, FOUR) for _ in range(2 * ROWS // 4)]
        with cgutils.for_range_slice(builder, first, rows, INT(ROWS), INT) as (row, _):
            places = [
                builder.add(row, INT(4 * b)) if axis == 0
                else builder.add(builder.add(row, y_width), INT(4 * b))
                for axis in range(2) for b in range(ROWS // 4)
            ]  # fmt: skip
            for one, place in zip(sums, places, strict=True):
                builder.store(load(builder, y, place), one)
            with cgutils.for_range(builder, columns) as loop:
                entry = builder.add(builder.mul(loop.index, width), row)
                entries = [
                    load(builder, base, builder.add(entry, INT(4 * b))) for b in range(ROWS // 4)
                ]
                for axis in range(2):
                    place = builder.add(loop.index, x_width) if axis else loop.index
                    value = all_four(builder, builder.load(builder.gep(x, [place])))
                    for b, four in enumerate(entries):
                        one = sums[axis * ROWS // 4 + b]
                        builder.store(add(builder, four, value, builder.load(one)), one)
            for one, place in zip(sums, places, strict=True):
                store(builder, builder.load(one), y, place)
        return context.get_dummy_value()

    whole = types.int64
    return types.void(table, whole, whole, whole, x, y), make
