"""The series of one converter on its grid, by the powers of a small matrix.

Between two edges its own states, those of its DC link, a constant and the phasors of the grid are
one system x' = A x. With Q_i = sum over k < POWERS of (hA)^k x / (POWERS i + k)! the series is

    x(h) = Q_0 + (hA)^POWERS (Q_1 + (hA)^POWERS (Q_2 + ...)),

after Paterson and Stockmeyer (SIAM J. Comput. 2, 1973): of ten terms only two products wait for
each other. The powers of A are kept by what A depends on: which devices conduct, the circuit, and
at which limit the DC source is. Matrices are stored by columns.
"""

import math
from typing import Any

from llvmlite import ir
from numba import types

from gfm_plant.layout import ORDER, POWERS, SLOTS, field
from gfm_plant.vectors import FOUR, INT, ZERO, add, all_four, load, pointer, splat, store
from gfm_runtime.compiled import compiled, inlined, intrinsic

ONE, P, SOURCE_AT, MID_AT, N = 8, 9, 12, 13, 14
"""Places in x, behind i_f, v, i_o (alpha and beta), v_dc and the integral of its source's control:
the constant 1, the positive sequence of the grid, and then what few plants have: the current of a
DC source with a lag, the midpoint, and the grid's negative sequence."""

SMALL = 12
"""Length of x without the latter."""
# of columns, in blocks of four rows, those that are not zero
_BLOCKS: dict[int, list[tuple[int, ...]]] = {
    SMALL: [(0, 1)] * 9 + [(0, 1, 2)] * 2,
    ORDER: [(0, 1, 2, 3)] * ORDER,
}
_SLOTS_TRIED = 32


def _column(builder: Any, matrix: Any, column: int, block: int) -> Any:
    return load(builder, matrix, column * ORDER + 4 * block)


def _sum(builder: Any, highest: Any, x: Any, h: Any, levels: int, size: int) -> list[Any]:
    """Return x(h) in blocks by A^k x, k < POWERS, in blocks; ``highest``: A^POWERS."""
    blocks, one = range(size // 4), all_four(builder, h)
    power, scaled = one, [x[0]]
    for k in range(1, POWERS):
        scaled.append([builder.fmul(part, power) for part in x[k]])
        power = builder.fmul(power, one)

    def partial(i: int) -> list[Any]:
        found: list[Any] = [None for _ in blocks]
        for k in range(POWERS):
            factor = ir.Constant(FOUR, [1 / math.factorial(POWERS * i + k)] * 4)
            found = [add(builder, scaled[k][block], factor, found[block]) for block in blocks]
        return found

    y = partial(levels - 1)
    for i in range(levels - 2, -1, -1):
        y, sums = [builder.fmul(part, power) for part in y], [partial(i), [None for _ in blocks]]
        for column, those in enumerate(_BLOCKS[size]):
            value, to = splat(builder, y[column // 4], column % 4), sums[column % 2]
            for block in those:
                entry = _column(builder, highest, column, block)
                to[block] = add(builder, entry, value, to[block])
        y = [
            one if other is None else builder.fadd(one, other)
            for one, other in zip(*sums, strict=True)
        ]
    return y


def _store(builder: Any, vectors: Any, row: int, values: list[Any]) -> None:
    for block, value in enumerate(values):
        store(builder, value, vectors, row * ORDER + 4 * block)


@intrinsic
def _series(
    typingctx: Any, power: Any, slot: Any, vectors: Any, h: Any, levels: Any, size: Any
) -> Any:
    """Write x(h), by A^k x in rows k, to the last row of ``vectors``; no ``levels``: write A^k x by
    x, row 0."""
    literals = levels, size
    if not all(isinstance(one, types.Literal) for one in literals):
        return None
    n_levels, n = (one.literal_value for one in literals)

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kinds, first = signature.args, builder.mul(arguments[1], INT(POWERS * ORDER * ORDER))
        base = builder.gep(pointer(context, builder, kinds[0], arguments[0]), [first])
        matrix = [builder.gep(base, [INT(k * ORDER * ORDER)]) for k in range(POWERS)]
        rows = pointer(context, builder, kinds[2], arguments[2])
        x: list[list[Any]] = [
            [load(builder, rows, k * ORDER + 4 * b) for b in range(n // 4)]
            for k in range(POWERS if n_levels else 1)
        ]
        if n_levels:
            y = _sum(builder, matrix[-1], x, arguments[3], n_levels, n)
            _store(builder, rows, POWERS, y)
        else:
            x += [[ZERO] * (n // 4) for _ in range(POWERS - 1)]
            for column, those in enumerate(_BLOCKS[n]):
                value = all_four(builder, builder.load(builder.gep(rows, [INT(column)])))
                for k in range(1, POWERS):
                    for b in those:
                        entry = _column(builder, matrix[k - 1], column, b)
                        x[k][b] = add(builder, entry, value, x[k][b])
            for k in range(1, POWERS):
                _store(builder, rows, k, x[k])
        return context.get_dummy_value()

    return types.void(power, types.int64, vectors, types.float64, *literals), make


@inlined
def begin_powers(now: Any, slot: int) -> None:
    """Find A^k x, rows k of ``vector``, from x, its row 0, as long as ``now.order`` says."""
    power, vector = field(now, "power"), field(now, "vector")
    if now.order == SMALL:
        _series(power, slot, vector, 0.0, 0, SMALL)
    else:
        _series(power, slot, vector, 0.0, 0, ORDER)


@inlined
def go_to(now: Any, slot: int, h: float, levels: int) -> None:
    """Find x(h), row POWERS of ``vector``, after ``begin_powers``; by ``levels`` of Q_i, 2 or 3."""
    power, vector = field(now, "power"), field(now, "vector")
    if now.order == SMALL:
        if levels == 2:
            _series(power, slot, vector, h, 2, SMALL)
        else:
            _series(power, slot, vector, h, 3, SMALL)
    elif levels == 2:
        _series(power, slot, vector, h, 2, ORDER)
    else:
        _series(power, slot, vector, h, 3, ORDER)


@compiled
def fill_powers(now: Any, slot: int, columns: int) -> None:
    """Find the powers of a slot's A: 0: all; 1: after a change of the column of the constant; 2: of
    those of the grid."""
    A = field(now, "power")
    for column in range(ORDER):
        if columns == 1 and column != ONE:
            continue
        if columns == 2 and not (P <= column <= P + 1 or column >= N):
            continue
        for k in range(1, POWERS):
            for row in range(ORDER):
                total = 0.0
                for j in range(ORDER):
                    total += A[slot, 0, j, row] * A[slot, k - 1, column, j]
                A[slot, k, column, row] = total


@inlined
def find_slot(now: Any, key: int) -> tuple[int, bool]:
    """Return the slot of a key > 0, and whether it holds it; else it is to be filled."""
    keys = field(now, "slot_key")
    first = (key * 2654435769) >> 16  # scatters
    for tried in range(_SLOTS_TRIED):
        slot = (first + tried) & (SLOTS - 1)
        if keys[slot] == key:
            return slot, True
        if keys[slot] == 0:
            keys[slot] = key
            return slot, False
    slot = first & (SLOTS - 1)
    keys[slot] = key
    return slot, False
