"""The solution of one converter on its grid over whole counts of the timer that switches it.

Edges lie on counts, so that most intervals are c FINE + f of these, and

    x(h) = e^(A f count) e^(A c FINE count) x

takes two products with small matrices that are ready, and no series. That is so for a bridge of two
levels without drops in a balanced circuit. Its voltage is zero or one of six vectors that differ by
a turn, and turned so that it is along alpha all six have one matrix. In it alpha and beta have the
same rates, and beta takes no part in the DC link: one column serves both axes.

The matrices also depend on the speed of the grid and on what acts in the DC link. They are made
when these have stayed the same for a while; until then, and for an interval that is no whole
counts, there is the series of `powers`.
"""

from typing import Any

from llvmlite import ir
from numba import types

from gfm_plant.layout import COARSE, FINE, LARGEST, ORDER, POWERS, field
from gfm_plant.powers import ONE, P, begin_powers, go_to
from gfm_plant.records import PlantRecords
from gfm_plant.solution import grid_source
from gfm_plant.vectors import (
    FOUR,
    INT,
    VOID,
    ZERO,
    add,
    all_four,
    load,
    pointer,
    shuffle,
    splat,
    store,
)
from gfm_runtime.compiled import compiled, inlined, intrinsic

_PATIENCE = 2000  # intervals that the matrices would have served before they are made
_NEAR = 1e-9  # of a count; what is as near to a whole one is one
_ZERO = 1e-14  # p.u. of v_dc; a smaller voltage is that of three legs at one rail

# Rows of a matrix are i_f, v and i_o, alpha and beta, v_dc, and the integral of its source's
# control. Columns are i_f, v and i_o of a row's own axis, that is of alpha for the DC link, the
# latter two, 1, and the phasor of the grid along the row's axis and across it. A last row is how
# far the grid turns.
_OWN = [0, 1, 0, 1], [0, 1, 0, 0]
_NEXT = [2, 3, 2, 3], [2, 3, 2, 2]
_TURN = 8


def _turned(builder: Any, x: list[Any], cos: Any, sin: Any) -> list[Any]:
    """Return states that are turned by an angle."""
    c, s, one = all_four(builder, cos), all_four(builder, sin), ir.Constant(FOUR, [1.0] * 4)
    across = shuffle(builder, builder.fsub(ZERO, s), s, [0, 4, 0, 4])
    factors = c, shuffle(builder, c, one, [0, 0, 4, 4])
    others = across, shuffle(builder, across, ZERO, [0, 1, 4, 4])
    return [
        add(builder, shuffle(builder, part, VOID, [1, 0, 3, 2] if j == 0 else [1, 0, 2, 3]),
            others[j], builder.fmul(part, factors[j]))
        for j, part in enumerate(x)
    ]  # fmt: skip


def _grid_turned(builder: Any, grid: Any, cos: Any, sin: Any) -> Any:
    """Return the grid that is turned by an angle: p_alpha, p_beta, p_beta and -p_alpha."""
    across = shuffle(builder, grid, builder.fsub(ZERO, grid), [5, 0, 0, 1])
    return add(builder, across, sin, builder.fmul(grid, cos))


def _product(builder: Any, matrix: Any, x: list[Any], grid: Any) -> tuple[list[Any], Any]:
    """Return where a matrix leads the states and the grid to."""
    found = []
    for half in range(2):
        own, following = _OWN[half], _NEXT[half]
        factors = [
            shuffle(builder, x[0], VOID, own), shuffle(builder, x[0], VOID, following),
            shuffle(builder, x[1], VOID, own), splat(builder, x[1], 2), splat(builder, x[1], 3),
        ]  # fmt: skip
        column = [load(builder, matrix, _TURN * j + 4 * half) for j in range(_TURN)]
        to = add(builder, column[6], shuffle(builder, grid, VOID, own), column[5])
        to = add(builder, column[7], shuffle(builder, grid, VOID, following), to)
        to = add(builder, column[1], factors[1], add(builder, column[0], factors[0], to))
        more = add(builder, column[3], factors[3], builder.fmul(column[2], factors[2]))
        found.append(builder.fadd(to, add(builder, column[4], factors[4], more)))
    last = load(builder, matrix, _TURN * _TURN)
    return found, _grid_turned(builder, grid, splat(builder, last, 0), splat(builder, last, 1))


@intrinsic
def _stride(
    typingctx: Any, table: Any, coarse: Any, fine: Any, vectors: Any, cos: Any, sin: Any, turns: Any
) -> Any:
    """Take row 0 of ``vectors`` to where two matrices of a table lead; with ``turns`` those of a
    voltage along alpha, which is really along cos + j sin."""
    if not isinstance(turns, types.Literal):
        return None

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        base = pointer(context, builder, signature.args[0], arguments[0])
        rows = pointer(context, builder, signature.args[3], arguments[3])
        cos, sin = arguments[4:6]
        minus = builder.fsub(ir.Constant(sin.type, 0.0), sin)
        x, tail = [load(builder, rows, 0), load(builder, rows, 4)], load(builder, rows, ONE)
        grid = shuffle(builder, tail, builder.fsub(ZERO, tail), [1, 2, 2, 5])  # behind the 1
        if turns.literal_value:
            x = _turned(builder, x, cos, minus)
            grid = _grid_turned(builder, grid, all_four(builder, cos), all_four(builder, minus))
        for place in arguments[1:3]:
            matrix = builder.gep(base, [builder.mul(place, INT((_TURN + 1) * _TURN))])
            x, grid = _product(builder, matrix, x, grid)
        if turns.literal_value:
            x = _turned(builder, x, cos, sin)
            grid = _grid_turned(builder, grid, all_four(builder, cos), all_four(builder, sin))
        for j, part in enumerate(x):
            store(builder, part, rows, 4 * j)
        one = ir.Constant(FOUR, [1.0, 0.0, 0.0, 0.0])
        store(builder, shuffle(builder, one, grid, [0, 4, 5, 1]), rows, ONE)
        return context.get_dummy_value()

    real, whole = types.float64, types.int64
    return types.void(table, whole, whole, vectors, real, real, turns), make


@inlined
def ask_for_strides(plant: PlantRecords, c: int) -> None:
    """Note what the matrices would have to be for, and if that has been so for a while make one of
    them, so that no tick takes long.

    The bridge has two levels and no drops, and all its legs have a voltage; its slot of `powers`
    is filled.
    """
    r, s, now = plant.par[0], plant.st[0], plant.now[0]
    if now.order == ORDER or now.contact or s.limit != 0.0:
        return
    kind = 1 if abs(s.by_dc.real) + abs(s.by_dc.imag) > _ZERO else 0
    wanted, speed = field(now, "stride_for")[kind], field(now, "source_speed")
    key, w = _key(s, c), speed[grid_source(plant.net[0])]
    if wanted[2] != key or wanted[3] != w:
        wanted[2], wanted[3], wanted[4] = key, w, 0.0
    place = int(wanted[4]) - _PATIENCE
    wanted[4] += 1.0
    if 0 <= place < COARSE + FINE and r.counts <= COARSE * FINE:
        wanted[0], wanted[1] = 0.0, w
        _make(plant, c, kind, place)
        if place == COARSE + FINE - 1:
            wanted[0] = key


@compiled
def _make(plant: PlantRecords, c: int, kind: int, place: int) -> None:
    """Make one matrix of a kind by the powers of the slot in force."""
    r, s, now = plant.par[0], plant.st[0], plant.now[0]
    x, table, fastest = field(now, "vector"), field(now, "strides"), field(plant.net[0], "fastest")
    p_a, p_b, turn = x[0, P], x[0, P + 1], complex(1.0, 0.0)
    if kind == 1:
        turn = s.by_dc / abs(s.by_dc)
    h = r.count_s * (place * FINE if place < COARSE else place - COARSE)
    parts = 1 + int(h * fastest[c] / LARGEST)
    for one in range(P + 2):
        _set_unit(x, one, turn)
        for _ in range(parts):
            begin_powers(now, s.slot)
            go_to(now, s.slot, h / parts, 3)
            for j in range(P + 2):
                x[0, j] = x[POWERS, j]
        _write(x, table[kind, place], one, turn)
    for j in range(P):
        x[0, j] = s.ends[0, j] if j < ONE else 1.0
    x[0, P], x[0, P + 1] = p_a, p_b


@inlined
def _is_beta(one: int) -> bool:
    """Return whether a place of x is of the axis beta."""
    return one % 2 == 1 if one < 6 else one == P + 1


@inlined
def _set_unit(x: Any, one: int, turn: complex) -> None:
    """Write a unit vector, which is turned, to x."""
    for j in range(ORDER):
        x[0, j] = 0.0
    if 6 <= one < P:
        x[0, one] = 1.0
    elif _is_beta(one):
        x[0, one - 1], x[0, one] = -turn.imag, turn.real
    else:
        x[0, one], x[0, one + 1] = turn.real, turn.imag


@inlined
def _write(x: Any, matrix: Any, one: int, turn: complex) -> None:
    """Write where a unit vector leads to, row 0 of x, to a matrix."""
    pair, beta, back = one < 6 or one >= P, _is_beta(one), turn.conjugate()
    column = one // 2 if one < 6 else (one - 3 if one < P else 6)
    for j in (0, 2, 4, P):
        z = complex(x[0, j], x[0, j + 1]) * back
        x[0, j], x[0, j + 1] = z.real, z.imag
    for row in range(_TURN):
        of_beta = row < 6 and row % 2 == 1
        if not pair or beta == of_beta:
            matrix[column, row] = x[0, row]
        elif column == 6:  # across the row's axis; that of beta is -alpha
            matrix[7, row] = -x[0, row] if of_beta else x[0, row]
    if one == P:
        matrix[_TURN, 0], matrix[_TURN, 1] = x[0, P], x[0, P + 1]


@inlined
def serve(plant: PlantRecords, c: int) -> bool:
    """Return whether the matrices of both kinds are ready."""
    now, s = plant.now[0], plant.st[0]
    made_for, speed = field(now, "stride_for"), field(now, "source_speed")
    key, w = _key(s, c), speed[grid_source(plant.net[0])]
    return bool(
        now.order != ORDER and now.contact == 0 and s.limit == 0.0
        and made_for[0, 0] == key and made_for[0, 1] == w
        and made_for[1, 0] == key and made_for[1, 1] == w
    )  # fmt: skip


@inlined
def _key(s: Any, c: int) -> float:
    """Return a number > 0 of what the matrices depend on besides the speed of the grid."""
    return 4.0 * c + (2.0 if s.winds > 0.0 else 0.0) + (1.0 if s.chopper > 0.0 else 0.0) + 1.0


@inlined
def is_whole(plant: PlantRecords, t: float) -> bool:
    """Return whether an instant of a unit is a whole count."""
    counts = t / plant.par[0].count_s
    return abs(counts - int(counts + 0.5)) < _NEAR


@inlined
def stride(plant: PlantRecords, kind: int, h: float, cos: float, sin: float) -> bool:
    """Take x, row 0 of ``vector``, on by h s if these are whole counts; returns whether. The
    voltage of kind 1 is along cos + j sin."""
    r, now = plant.par[0], plant.now[0]
    counts = h / r.count_s
    whole = int(counts + 0.5)
    coarse, fine, first = whole // FINE, COARSE + whole % FINE, COARSE + FINE
    if abs(counts - whole) > _NEAR or coarse >= COARSE:
        return False
    table, x = field(now, "strides"), field(now, "vector")
    if kind == 0:
        _stride(table, coarse, fine, x, 1.0, 0.0, 0)
    else:
        _stride(table, first + coarse, first + fine, x, cos, sin, 1)
    return True
