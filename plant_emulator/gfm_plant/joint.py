"""The modes of a circuit with several contacts, made in the loop when a phase has opened.

See `contacts` for its equations, q' = flow q + by_s s. With P, the projection away from the bars
of what is open, it is q' = P flow P q + P by_s s, and its modes come from the eigenvectors of that
real matrix, X diag(rate) X^-1. A state w = w_alpha + j w_beta is then driven by itself and by its
mirror image: with a and b for what X^-1 takes from both axes,

    z = (a - j b)/2 w + (a + j b)/2 mirror.
"""

import cmath
from typing import Any

from numba import types

from gfm_plant.layout import field
from gfm_plant.records import N_OWN
from gfm_runtime.compiled import compiled, inlined

_NOTHING = 1e-9  # of a bar that others already are
_LEAST = 1e-8  # 1/s; a smaller rate of `series` is rounding

_floats = types.CPointer(types.float64)
#: numba's own door to dgeev, which `contacts.join` loads: kind, left and right vectors, n, matrix,
#: rates, vectors; it brings its memory, and arrays are as Fortran has them
_dgeev: Any = types.ExternalFunction(
    "numba_ez_rgeev",
    types.intc(
        types.char, types.char, types.char, types.intp, _floats, types.intp, _floats, _floats,
        _floats, types.intp, _floats, types.intp,
    ),
)  # fmt: skip
_DOUBLE, _NO, _YES = ord("d"), ord("N"), ord("V")


@compiled
def make_joint(n: Any, now: Any) -> None:
    """Make the last circuit that of the contacts as they conduct now."""
    _find_flow(n, now, _find_bars(n, now))
    q, square, eigen = n.reals, field(now, "square"), field(now, "eigen")
    _dgeev(
        _DOUBLE, _NO, _YES, q, square[0].ctypes, square.shape[1], eigen[0].ctypes, eigen[1].ctypes,
        square[0].ctypes, square.shape[1], square[1].ctypes, square.shape[1],
    )  # fmt: skip
    _invert(n, now)
    _fill(n, now)
    if n.n_units:
        _fill_rates(n, now)
    now.made = 1


@inlined
def joint_circuit(n: Any) -> int:
    """Return the place of the circuit of several contacts."""
    return 0 if n.sparse else n.n_c - 1


@inlined
def fault_phases(now: Any) -> int:
    """Return the phases of the fault that conduct: 1 for a, 2 for b, 4 for c."""
    conducts = field(now, "conducts")
    return conducts[0, 0] + 2 * conducts[0, 1] + 4 * conducts[0, 2]


@compiled
def _find_bars(n: Any, now: Any) -> int:
    """Make an orthonormal basis of what cannot flow; returns how many vectors it has."""
    conducts, bars, count = field(now, "conducts"), field(now, "bars"), 0
    of_fault, of_poles, of_w = field(n, "fault_bars"), field(n, "pole_bars"), field(n, "to_w")
    phases = fault_phases(now)
    for p in range(3):
        count = _add(n, now, of_fault[phases, p], count)
        for j in range(n.poles):
            if not conducts[1 + j, p]:
                count = _add(n, now, of_poles[j, p], count)
    if now.row:
        for x in range(2):  # a blocked bridge
            count = _add(n, now, of_w[N_OWN * (now.row - 1), x], count)
    for b in range(count, n.reals):
        for i in range(n.reals):
            bars[b, i] = 0.0
    return count


@compiled
def drop_dead(n: Any, now: Any) -> None:
    """Open the poles whose currents the open ones leave no path."""
    conducts, of_poles, count = field(now, "conducts"), field(n, "pole_bars"), _find_bars(n, now)
    for j in range(n.poles):
        for p in range(3):
            if count == n.reals or _add(n, now, of_poles[j, p], count) == count:
                conducts[1 + j, p] = 0


@compiled
def _add(n: Any, now: Any, vector: Any, count: int) -> int:
    """Add what a vector has besides the basis to it, by Gram and Schmidt, twice."""
    bars, size = field(now, "bars"), 0.0
    for i in range(n.reals):
        bars[count, i] = vector[i]
        size += vector[i] * vector[i]
    for _ in range(2):
        for b in range(count):
            along = 0.0
            for i in range(n.reals):
                along += bars[b, i] * bars[count, i]
            for i in range(n.reals):
                bars[count, i] -= along * bars[b, i]
    left = 0.0
    for i in range(n.reals):
        left += bars[count, i] * bars[count, i]
    if not left > _NOTHING * _NOTHING * size:
        return count
    for i in range(n.reals):
        bars[count, i] /= left**0.5
    return count + 1


@compiled
def _find_flow(n: Any, now: Any, count: int) -> None:
    """Write P flow P to ``square``, transposed."""
    A, flow, bars = field(now, "square")[0], field(n, "flow")[fault_phases(now)], field(now, "bars")
    for i in range(n.reals):
        for j in range(n.reals):
            A[j, i] = flow[i, j]
    for b in range(count):
        for j in range(n.reals):
            along = 0.0
            for i in range(n.reals):
                along += bars[b, i] * A[j, i]
            for i in range(n.reals):
                A[j, i] -= along * bars[b, i]
        for i in range(n.reals):
            along = 0.0
            for j in range(n.reals):
                along += bars[b, j] * A[j, i]
            for j in range(n.reals):
                A[j, i] -= along * bars[b, j]


@inlined
def _vector(now: Any, m: int, i: int) -> complex:
    """Return entry i of eigenvector m: of a pair dgeev gives the real part, and then the other."""
    imag, X = field(now, "eigen")[1], field(now, "square")[1]
    if imag[m] == 0.0:
        return complex(X[m, i], 0.0)
    if imag[m] > 0.0:
        return complex(X[m, i], X[m + 1, i])
    return complex(X[m - 1, i], -X[m, i])


@compiled
def _invert(n: Any, now: Any) -> None:
    """Write X^-1 P to ``solved[1]``, transposed: by Gauss and Jordan, with pivots."""
    X, Y, bars = field(now, "solved")[0], field(now, "solved")[1], field(now, "bars")
    for m in range(n.reals):
        for i in range(n.reals):
            X[m, i] = _vector(now, m, i)
            Y[m, i] = 1.0 if m == i else 0.0
    for k in range(n.reals):
        pivot = k
        for m in range(k + 1, n.reals):
            if abs(X[m, k]) > abs(X[pivot, k]):
                pivot = m
        by = 1.0 / X[pivot, k]
        for i in range(n.reals):
            X[pivot, i], X[k, i] = X[k, i], X[pivot, i] * by
            Y[pivot, i], Y[k, i] = Y[k, i], Y[pivot, i] * by
        for m in range(n.reals):
            factor = X[m, k]
            if m != k and factor != 0.0:
                for i in range(n.reals):
                    X[m, i] -= factor * X[k, i]
                    Y[m, i] -= factor * Y[k, i]
    for b in range(n.reals):  # the basis ends where its vectors are zero
        for m in range(n.reals):
            along = 0j
            for i in range(n.reals):
                along += bars[b, i] * Y[i, m]
            for i in range(n.reals):
                Y[i, m] -= along * bars[b, i]


@compiled
def _fill(n: Any, now: Any) -> None:
    """Write modes, states and what drives them."""
    c, eigen, half_h = joint_circuit(n), field(now, "eigen"), field(n, "half_h")
    rate, decay, states = field(n, "rate"), field(n, "decay"), field(n, "states")
    of_w, node, node_w = field(n, "to_w"), field(n, "node_q"), field(n, "node_w")
    modes, drive, node_s = field(n, "modes"), field(n, "drive"), field(n, "node_s")
    field(n, "n_modes")[c], field(n, "unbalanced")[c] = n.reals, 1
    field(n, "node_turn")[c] = 1.0
    for place in range(node.shape[0]):
        for image in range(2):
            for i in range(n.n_states):
                node_w[c, place, image, i] = 0.0
            for s in range(now.n_s):
                node_s[c, place, image, s] = 0.0
    for m in range(n.reals):
        real = complex(eigen[0, m], eigen[1, m])
        rate[c, m] = real - 1j * n.omega_b
        for cut in range(len(half_h)):
            decay[c, cut, m] = cmath.exp(rate[c, m] * half_h[cut])
        for i in range(n.n_states):
            states[c, i, m] = _both(n, now, of_w[i], m)
            _split(n, now, field(n, "from_w")[i], m, modes, c, i)
        for s in range(now.n_s):
            _split(n, now, field(n, "from_s")[s], m, drive, c, s)
        for place in range(node.shape[0]):
            by_rate = _both(n, now, node[place, 1], m)
            by = _both(n, now, node[place, 0], m) + real * by_rate
            for image in range(2):
                for i in range(n.n_states):
                    node_w[c, place, image, i] += by * modes[c, image, m, i]
                for s in range(now.n_s):
                    node_s[c, place, image, s] += by_rate * drive[c, image, m, s]
    for place in range(node.shape[0]):  # `solution.node_voltage` turns the whole sum around
        for i in range(n.n_states):
            node_w[c, place, 1, i] = node_w[c, place, 1, i].conjugate()
        for s in range(now.n_s):
            node_s[c, place, 1, s] = node_s[c, place, 1, s].conjugate()


@inlined
def _both(n: Any, now: Any, rows: Any, m: int) -> complex:
    """Return what mode m gives to alpha + j beta, each a row by q."""
    found = 0j
    for i in range(n.reals):
        found += complex(rows[0, i], rows[1, i]) * _vector(now, m, i)
    return found


@inlined
def _split(n: Any, now: Any, rows: Any, m: int, out: Any, c: int, at: int) -> None:
    """Write what alpha and beta, each a row by q, give to mode m: directly and by the mirror."""
    a, b, Y = 0j, 0j, field(now, "solved")[1]
    for i in range(n.reals):
        a += Y[i, m] * rows[0, i]
        b += Y[i, m] * rows[1, i]
    out[c, 0, m, at], out[c, 1, m, at] = 0.5 * (a - 1j * b), 0.5 * (a + 1j * b)


@compiled
def _fill_rates(n: Any, now: Any) -> None:
    """Write the equations of w for `series`: W' of the modes, W and its conjugate."""
    c, N, own_rates = joint_circuit(n), n.n_converters, field(n, "own_rates")
    count, place, link = field(n, "n_links"), field(n, "link_place"), field(n, "link")
    for which in range(2):
        e, columns = 0, n.n_states if which == 0 else now.n_s
        for row in range(n.n_states):
            of_bridge = row < N_OWN * N and row % N_OWN == 0
            for column in range(columns):
                if of_bridge or (which == 1 and column < N):
                    continue
                aa, bb, ab, ba = _rates(n, now, row, column, which)
                j = -1
                if which == 0 and row < N_OWN * N and column // N_OWN == row // N_OWN:
                    j = row % N_OWN + column % N_OWN - 1 + (row % N_OWN == 2)
                if j >= 0 and not (row % N_OWN == 2 and column % N_OWN == 0):
                    own_rates[c, row // N_OWN, 0, j], own_rates[c, row // N_OWN, 1, j] = aa, bb
                    aa = bb = 0.0
                if max(abs(aa), abs(bb), abs(ab), abs(ba)) > _LEAST:
                    place[c, which, e, 0], place[c, which, e, 1] = row, column
                    link[c, which, e, 0], link[c, which, e, 1] = aa, bb
                    link[c, which, e, 2], link[c, which, e, 3] = ab, ba
                    e += 1
        count[c, which] = e


@compiled
def _rates(
    n: Any, now: Any, row: int, column: int, which: int
) -> tuple[float, float, float, float]:
    """Return what a state, or (which = 1) a source, does to W' of another one: alpha to alpha, beta
    to beta, beta to alpha, alpha to beta."""
    c, eigen, states = joint_circuit(n), field(now, "eigen"), field(n, "states")
    direct, mirrored = 0j, 0j
    for m in range(n.reals):
        if which == 0:
            by = states[c, row, m] * complex(eigen[0, m], eigen[1, m])
            direct += by * field(n, "modes")[c, 0, m, column]
            mirrored += by * field(n, "modes")[c, 1, m, column]
        else:
            direct += states[c, row, m] * field(n, "drive")[c, 0, m, column]
            mirrored += states[c, row, m] * field(n, "drive")[c, 1, m, column]
    both, less = direct + mirrored, direct - mirrored
    return both.real, less.real, -less.imag, both.imag
