"""Large circuits: the series of their sparse equations, in the frame that stands still.

The modes of `solution` cost the states of a circuit times its states and sources a tick. Its
equations have a few entries a state: with the currents of branches and the voltages of capacitors
as x, the voltages u of the other nodes, and the sources s,

    L i' / omega_b = (the voltages at its ends) - R i,   C v' / omega_b = (what arrives) - v / R,
    u = R (what arrives) at a resistor,   D x' = 0, so D L^-1 D' u = D L^-1 (R i - the rest),

where D says which currents add up to nothing at a node that has no more than branches. The last is
solved by its sparse factors, whose rows are sums like all others. Two branches in series are one.
While sources turn at constant speeds, Taylor's series of x is exact to rounding:

    c_(j+1) = h / (j + 1) (A c_j + B s_j),   s_(j+1) = j Omega h / (j + 1) s_j.

It ends where all that is left out is below 1e-15 of x and s, by the root of the stored energy. The
norm of A bounds how many terms that can take; near a steady state they fall as Omega h does, so
that the sizes of the terms themselves end it sooner.

Filters and lines of the converters, which are all alike, are vectors over the converters, which the
compiler makes instructions of several numbers of; all else are rows of sums. In an unbalanced
circuit the real parts of all space vectors, turned to its axis, have equations of their own and the
imaginary parts others, see `circuit`: both go through the series, and one part of each is taken.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from numpy.typing import NDArray

from gfm_plant.circuit import GROUND, Branch, Circuit, check_parts
from gfm_plant.layout import MOST_OF_SEVERAL, field
from gfm_plant.records import I_F, N_OWN
from gfm_runtime.compiled import compiled, inlined, summing

if TYPE_CHECKING:
    from gfm_plant.wiring import Wiring

Row = dict[int, float]

LARGEST = 6.0
"""Of the norm of A times the length of an interval; a longer one is cut."""
MOST_STEPS = 1000
"""Into which a tick is cut, at most; a circuit that needs more is refused."""
DENSE = 200
"""States up to which a norm is taken of the whole matrix."""

_SMALLEST = 1e-15  # p.u.; of the first term that is left out
_MOST = 44  # terms
_PER = np.array([1.0 / max(j, 1) for j in range(_MOST + 1)])  # 1 / j
# an index without a sign: numba lets a negative one count from the end, and asks for each entry;
# such a loop has no instructions of several numbers
_U = np.uint64
_0, _1, _2, _3, _4, _5 = (np.uint64(k) for k in range(6))
ENOUGH = np.array([(_SMALLEST * math.factorial(j + 1)) ** (1 / (j + 1)) for j in range(_MOST)])


@dataclass(frozen=True)
class Sums:
    """Rows of sums: that of row k has the entries from ``begin[k]`` on."""

    begin: NDArray[np.int64]
    column: NDArray[np.int64]
    value: NDArray[np.float64]

    @staticmethod
    def of(rows: Iterable[Row]) -> Sums:
        """Those of rows from column to value."""
        rows = list(rows)
        begin = np.cumsum([0, *(len(row) for row in rows)])
        column = np.array([c for row in rows for c in row], np.int64)
        return Sums(begin, column, np.array([v for row in rows for v in row.values()], float))


@dataclass(frozen=True)
class Sparse:
    """What ``find_sparse`` returns: the equations of a circuit, for w of n_w states.

    Their columns are the states x, ``own`` first: i_f, v, i_o of each converter; the sources at
    their places; and the voltages u. Rows of ``sums`` are u, and then the slopes of the other
    states, 1/s, those with the fewest entries first, and what else the slopes of those in
    ``extra`` have.
    """

    sums: Sums
    n_x: int
    n_u: int
    few: tuple[int, int, int]  # rows of other states with up to two, three and four entries
    extra: NDArray[np.int64]
    own: NDArray[np.float64]  # (6, N): see `_slopes`
    line_to: NDArray[np.int64]  # column of the voltage at the end of each converter's line, (N,)
    state: NDArray[np.int64]  # place in w of each x, (n_x,)
    of: NDArray[np.int64]  # the x of each w, -1: it has none, (n_w,)
    by: NDArray[np.float64]  # w over that x
    enter: Sums  # of w: sums on the way, then w as this circuit can hold it
    n_enter: int  # how many are on the way
    node: Mapping[str, int]  # column of the voltage of each node
    norm: float  # of the equations in energy coordinates, 1/s
    least: float  # of the last term's square over that of x and s, as numbers in p.u.
    fastest: float  # without resistances, rad/s


@dataclass
class _Merged:
    """Branches in series as one: what its current takes from each node, see `Branch.taken`."""

    taken: dict[str, float]
    L: float
    R: float
    parts: dict[str, float]  # the current of each by its own

    @property
    def name(self) -> str:
        """That of the branch whose current it is."""
        return next(iter(self.parts))


@lru_cache(maxsize=64)
def find_sparse(
    circuit: Circuit,
    omega_b: float,
    order: tuple[str, ...],
    units: tuple[tuple[str, str, str], ...],
    sources: tuple[tuple[str, tuple[int, ...]], ...],
    n_s: int,
    kept: frozenset[str] = frozenset(),
) -> Sparse:
    """Return the sparse equations of a circuit.

    Args:
        circuit, omega_b, order: as for `circuit.find_modes`.
        units: names of the states of each converter.
        sources: places of each source and sink, of which there are n_s; that of the grid has two.
        kept: nodes whose voltage is looked at.

    Raises:
        ValueError: as `circuit.find_modes`, but for modes that cannot be told apart.
    """
    found = _Equations(circuit, omega_b, units, dict(sources), n_s, kept)
    slopes = found.slopes()
    own, line_to = found.take_own(units, slopes)
    first = N_OWN * len(units)
    others = sorted(found.names[first:], key=lambda name: len(slopes[name]))
    for name in others:
        if len(slopes[name]) < 2:  # it has itself
            slopes[name] |= {next(c for c in range(2) if c != found.at[name]): 0.0}
    wide = [len(slopes[name]) for name in others]
    extra = [name for name in found.names[:first] if slopes.get(name)]
    rows = found.of_nodes() + [slopes[name] for name in (*others, *extra)]

    # the other states in the order of their rows
    moved = {found.at[name]: first + k for k, name in enumerate(others)}
    names = [*found.names[:first], *others]
    at = {name: j for j, name in enumerate(names)}
    rows = [{moved.get(c, c): value for c, value in row.items()} for row in rows]
    column = {node: moved.get(c, c) for node, c in found.column.items()}

    of, by = np.full(len(order), -1), np.zeros(len(order))
    where = {name: j for j, name in enumerate(order)}
    for cap in circuit.capacitors:
        of[where[cap.name]], by[where[cap.name]] = at[cap.name], 1.0
    for one in found.branches:
        for part, factor in one.parts.items():
            of[where[part]], by[where[part]] = at[one.name], factor
    enter, n_enter = _entering(circuit, where)
    lossless, norm = _norms(found.branches, circuit, found.solved, omega_b)
    stores = [*(one.L for one in found.branches), *(cap.C for cap in circuit.capacitors)]
    least = _SMALLEST**2 * min(stores) / max(stores)
    return Sparse(
        Sums.of(rows), found.n_x, found.n_u,
        (sum(w < 3 for w in wide), wide.count(3), wide.count(4)),
        np.array([at[e] for e in extra], int),
        own, np.array([moved.get(c, c) for c in line_to], np.int64),
        np.array([where[name] for name in names]), of, by, enter, n_enter,
        column | {node: columns[0] for node, columns in found.drives.items()},
        norm, least, lossless,
    )  # fmt: skip


class _Equations:
    """The equations of a circuit as rows, with the states of converters first.

    Args:
        circuit, omega_b, units, n_s, kept: as for ``find_sparse``.
        place: of each source and sink.

    Attributes:
        branches: those in series as one.
        names: of the states; ``at``: their columns.
        column: of the voltage of each node that no source holds; ``drives``: those of the others.
        solved: the factors by which the voltages of free nodes follow.
        n_x, n_u: how many states and voltages there are.
    """

    def __init__(
        self,
        circuit: Circuit,
        omega_b: float,
        units: Sequence[tuple[str, str, str]],
        place: Mapping[str, tuple[int, ...]],
        n_s: int,
        kept: frozenset[str],
    ) -> None:
        fixed, charged, through = check_parts(circuit)
        known = {GROUND, *fixed, *charged, *through}
        self._circuit, self._omega_b, self._place = circuit, omega_b, place
        self._known, self._through = known, through
        lines = {unit[2] for unit in units}
        self.branches = _in_series(circuit.branches, known | kept, lines)

        own = [unit[j] for j in range(N_OWN) for unit in units]
        states = (*(one.name for one in self.branches), *(cap.name for cap in circuit.capacitors))
        self.names = own + [name for name in states if name not in {*own}]
        self.at = {name: j for j, name in enumerate(self.names)}
        self.n_x = len(self.names)

        self._meets = defaultdict[str, list[tuple[float, _Merged]]](list)
        for one in self.branches:
            for node, sign in one.taken.items():
                self._meets[node].append((sign, one))
        held = {*fixed, *charged}
        self._resistive = [node for node in through if node not in held and node in self._meets]
        self._free = [node for node in self._meets if node not in known]
        self.solved = _Factors.of(self._free, self.branches)
        self.n_u = len(self._resistive) + 2 * len(self._free)

        self.drives = {
            one.node: tuple(self.n_x + k for k in place[one.name]) for one in circuit.sources
        }
        self.column = {one.node: self.at[one.name] for one in circuit.capacitors}
        for k, node in enumerate(self._resistive):
            self.column[node] = self.n_x + n_s + k
        self._on_the_way = self.n_x + n_s + len(self._resistive)
        begin = self._on_the_way + len(self._free)
        for k, node in enumerate(self._free):
            self.column[node] = begin + self.solved.place[k]

    def _add_voltage(self, node: str, factor: float, row: Row) -> None:
        if node in self.drives:
            for k in self.drives[node]:
                row[k] = row.get(k, 0.0) + factor
        elif node != GROUND:
            row[self.column[node]] = row.get(self.column[node], 0.0) + factor

    def of_nodes(self) -> list[Row]:
        """The voltages of nodes with resistors, and then what gives those of free ones."""
        at, meets = self.at, self._meets
        rows: list[Row] = [
            {at[b.name]: -sign * self._through[node] for sign, b in meets[node]}
            for node in self._resistive
        ]
        right = []
        for node in self._free:
            row: Row = {}
            for sign, one in meets[node]:
                row[at[one.name]] = row.get(at[one.name], 0.0) + sign * one.R / one.L
                for other, factor in one.taken.items():
                    if other in self._known:
                        self._add_voltage(other, -sign * factor / one.L, row)
            right.append(row)
        return rows + self.solved.rows(right, self._on_the_way)

    def slopes(self) -> dict[str, Row]:
        """The slope of each state, 1/s."""
        omega_b, at = self._omega_b, self.at
        slopes: dict[str, Row] = {}
        for one in self.branches:
            row = {at[one.name]: -omega_b * one.R / one.L}
            for node, sign in one.taken.items():
                self._add_voltage(node, omega_b * sign / one.L, row)
            slopes[one.name] = row
        for cap in self._circuit.capacitors:
            row = {at[b.name]: -omega_b * sign / cap.C for sign, b in self._meets[cap.node]}
            if cap.node in self._through:
                row[at[cap.name]] = -omega_b / cap.C / self._through[cap.node]
            for sink in self._circuit.sinks:
                if sink.node == cap.node:
                    row |= {self.n_x + k: -omega_b / cap.C for k in self._place[sink.name]}
            slopes[cap.name] = row
        return slopes

    def take_own(
        self, units: Sequence[tuple[str, str, str]], slopes: Mapping[str, Row]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """What all converters have alike, which their slopes lose: see ``Sparse.own``, and the
        column of the voltage at the end of each line."""
        at = self.at
        capacitance = {one.name: one.C for one in self._circuit.capacitors}
        own, line_to = np.zeros((6, len(units))), np.zeros(len(units), np.int64)
        for k, (i_f, v, i_o) in enumerate(units):
            filters = slopes.get(i_f, {})
            b = own[:, k]
            b[0] = _take(filters, self.n_x + k)
            _take(filters, at[v])
            b[1] = -_take(filters, at[i_f])
            b[2] = self._omega_b / capacitance[v]
            _take(slopes[v], at[i_f])
            if i_o in slopes:
                line = slopes[i_o]
                _take(slopes[v], at[i_o])
                b[3], b[4] = _take(line, at[v]), -_take(line, at[i_o])
                if len(line) == 1:
                    ((line_to[k], factor),) = line.items()
                    b[5] = -factor
                    line.clear()
        return own, line_to


def _take(row: Row, column: int) -> float:
    """The entry of a row, which loses it."""
    return row.pop(column, 0.0)


def _in_series(branches: Sequence[Branch], known: set[str], first: set[str]) -> list[_Merged]:
    """The branches, those that meet at nothing else as one; those of ``first`` give their name."""
    found = [_Merged(dict(b.taken()), b.L, b.R, {b.name: 1.0}) for b in branches]
    at = defaultdict[str, list[_Merged]](list)
    for one in found:
        for node in one.taken:
            at[node].append(one)
    gone = set[int]()
    for node in [node for node in at if node not in known]:
        if len(at[node]) != 2:
            continue
        a, b = sorted(at[node], key=lambda one: one.name not in first)
        if a is b or b.name in first:
            continue
        ratio = -a.taken.pop(node) / b.taken.pop(node)
        a.L, a.R = a.L + ratio**2 * b.L, a.R + ratio**2 * b.R
        for other, sign in b.taken.items():
            a.taken[other] = a.taken.get(other, 0.0) + ratio * sign
            at[other] = [one for one in at[other] if one is not b and one is not a] + [a]
        a.parts |= {name: ratio * factor for name, factor in b.parts.items()}
        for other in [other for other, sign in a.taken.items() if sign == 0.0]:
            del a.taken[other]
            at[other] = [one for one in at[other] if one is not a]
        gone.add(id(b))
    return [one for one in found if id(one) not in gone]


@dataclass(frozen=True)
class _Factors:
    """L U of the rows and columns, permuted, of D L^-1 D'; for no free node None."""

    of_all: Any
    pinned: NDArray[np.int64]  # nodes without any path to a known voltage, one of each part
    matrix: Any
    place: NDArray[np.int64]  # of each node's voltage among the last rows of ``rows``

    @staticmethod
    def of(free: Sequence[str], branches: Iterable[_Merged]) -> _Factors:
        n, index = len(free), {node: k for k, node in enumerate(free)}
        if not n:
            return _Factors(None, np.zeros(0, int), None, np.zeros(0, int))
        G, to_known = defaultdict[tuple[int, int], float](float), set[int]()
        for one in branches:
            those = [(index[node], sign) for node, sign in one.taken.items() if node in index]
            if len(those) < len(one.taken) or len(one.taken) < 2:
                to_known |= {k for k, _ in those}
            for j, a in those:
                for k, b in those:
                    G[j, k] += a * b / one.L
        i, j = np.array(list(G)).T
        matrix = scipy.sparse.csc_matrix((list(G.values()), (i, j)), (n, n))
        parts = scipy.sparse.csgraph.connected_components(matrix, directed=False)[1]
        grounded = {parts[k] for k in to_known}
        pinned = [np.flatnonzero(parts == p)[0] for p in range(max(parts) + 1) if p not in grounded]
        for k in pinned:  # a part that hangs on nothing: its voltages are up to a constant
            matrix = matrix + scipy.sparse.csc_matrix(([matrix[k, k]], ([k], [k])), (n, n))
        lu = scipy.sparse.linalg.splu(
            matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )  # fmt: skip
        return _Factors(lu, np.array(pinned, int), matrix, n - 1 - lu.perm_c.astype(int))

    def rows(self, right: Sequence[Row], begin: int) -> list[Row]:
        """Sums for the right sides, the first of them at column ``begin``: forwards, and back."""
        if self.of_all is None:
            return []
        lu, n = self.of_all, len(right)
        lower, upper = scipy.sparse.csr_matrix(lu.L), scipy.sparse.csr_matrix(lu.U)
        at_row = np.argsort(lu.perm_r)
        found: list[Row] = []
        for k in range(n):
            row = dict(right[at_row[k]])
            found.append(_less(row, lower[k], {k}, begin, 1.0))
        for k in reversed(range(n)):
            pivot = upper[k, k]
            row = {begin + k: 1.0 / pivot}
            entries = upper[k]
            for j, value in zip(entries.indices, entries.data, strict=True):
                if j != k and value != 0.0:
                    row[begin + n + n - 1 - int(j)] = -value / pivot
            found.append(row)
        return found


def _less(row: Row, entries: Any, without: set[int], begin: int, by: float) -> Row:
    for j, value in zip(entries.indices, entries.data, strict=True):
        if j not in without and value != 0.0:
            row[begin + int(j)] = -by * value
    return row


def _entering(circuit: Circuit, where: Mapping[str, int]) -> tuple[Sums, int]:
    """Sums that project w onto what the nodes of a circuit allow, by stored energy: less
    L^-1 D' (D L^-1 D')^-1 D w. Returns how many are on the way besides."""
    _, charged, through = check_parts(circuit)
    known = {GROUND, *charged, *through, *(one.node for one in circuit.sources)}
    each = [_Merged(dict(b.taken()), b.L, b.R, {b.name: 1.0}) for b in circuit.branches]
    free = list(dict.fromkeys(n for one in each for n in one.taken if n not in known))
    index, n_w, n = {node: k for k, node in enumerate(free)}, len(where), len(free)
    right: list[Row] = [{} for _ in free]
    for one in each:
        for node, sign in one.taken.items():
            if node in index:
                right[index[node]][where[one.name]] = sign
    solved = _Factors.of(free, each)
    rows, out = solved.rows(right, n_w), [Row() for _ in where]
    for cap in circuit.capacitors:
        out[where[cap.name]] = {where[cap.name]: 1.0}
    for one in each:
        row = {where[one.name]: 1.0}
        for node, sign in one.taken.items():
            if node in index:
                row[n_w + n + int(solved.place[index[node]])] = -sign / one.L
        out[where[one.name]] = row
    return Sums.of([*rows, *out]), 2 * n


def _norms(
    branches: Sequence[_Merged], circuit: Circuit, solved: _Factors, omega_b: float
) -> tuple[float, float]:
    """The largest rate without resistances, and the norm of A, both in energy coordinates, 1/s:
    there A is a skew-symmetric matrix less a symmetric one of the resistances."""
    fixed, charged, through = check_parts(circuit)
    n_b, caps = len(branches), circuit.capacitors
    at = {one.node: k for k, one in enumerate(caps)}
    resistive = {node: k for k, node in enumerate(n for n in through if n not in charged)}
    free = list(
        dict.fromkeys(
            n for one in branches for n in one.taken
            if n not in {GROUND, *fixed, *charged, *through}
        )
    )  # fmt: skip
    index = {node: k for k, node in enumerate(free)}

    def incidence(place: Mapping[str, int]) -> Any:
        entries = [
            (j, place[node], sign) for j, one in enumerate(branches)
            for node, sign in one.taken.items() if node in place
        ]  # fmt: skip
        i, k, value = zip(*entries, strict=True) if entries else ((), (), ())
        return scipy.sparse.csr_matrix((value, (i, k)), (n_b, max(1, len(place))))

    per_L = scipy.sparse.diags([one.L**-0.5 for one in branches])
    per_C = scipy.sparse.diags([cap.C**-0.5 for cap in caps])
    to_caps = per_L @ incidence(at) @ per_C
    D = (per_L @ incidence(index)).T
    lose = scipy.sparse.diags([one.R / one.L for one in branches])
    if resistive:
        to_R = per_L @ incidence(resistive)
        lose = lose + to_R @ scipy.sparse.diags([through[node] for node in resistive]) @ to_R.T
    leak = scipy.sparse.diags(
        [1 / through[c.node] / c.C if c.node in through else 0.0 for c in caps]
    )

    def project(i: Any) -> Any:
        return i if solved.of_all is None else i - D.T @ solved.of_all.solve(D @ i)

    def skew(x: Any) -> Any:
        i, v = project(x[:n_b]), x[n_b:]
        return np.concatenate([project(to_caps @ v), -(to_caps.T @ i)])

    def loss(x: Any) -> Any:
        return np.concatenate([project(lose @ project(x[:n_b])), leak @ x[n_b:]])

    def largest(square: Any) -> float:
        n = n_b + len(caps)
        if n <= DENSE:
            return float(np.sqrt(np.abs(np.linalg.eigvalsh(square(np.eye(n)))).max()))
        start = np.random.default_rng(0).standard_normal(n)
        operator = scipy.sparse.linalg.LinearOperator((n, n), matvec=square, dtype=float)
        found = scipy.sparse.linalg.eigsh(
            operator, 1, which="LA", tol=1e-3, v0=start, return_eigenvectors=False
        )
        return float(1.001 * np.sqrt(found[0]))

    norm = largest(lambda x: (y := skew(x) - loss(x), -skew(y) - loss(y))[1])
    return omega_b * largest(lambda x: -skew(skew(x))), omega_b * norm


def pack_sparse(net: Any, wiring: Wiring, looked_at: Mapping[int, str]) -> float:
    """Set the equations of all circuits of a wiring; returns the fastest rate that the pieces of
    Simpson's rule follow, rad/s: where no component draws a current, that of a converter's filter
    and line. Behind its capacitor a bridge sees little of the network's own, and a machine neither.

    Args:
        net: an element of the record.
        wiring: one of a plant that is large.
        looked_at: see `layout.net_dtype`: nodes by their places.

    Raises:
        ValueError: as ``find_sparse``.
    """
    each = ((1 / unit.L_f + 1 / unit.L_g) / unit.C_f for unit in wiring.units)
    fastest = wiring.omega_b * math.sqrt(max(each))
    if wiring.joint and not net["n_q"]:
        raise ValueError(
            f"{wiring.poles[-1][0]}: opens while another breaker or a fault does; a network of more"
            f" than {MOST_OF_SEVERAL} currents and voltages cannot have both"
        )
    net["unbalanced"] = 0
    for j, contact in enumerate(wiring.contacts):
        balanced = contact is None or contact.balanced
        net["unbalanced"][1 + j] = not balanced
        net["contact_axis"][j] = 1.0 if balanced or contact is None else np.exp(-1j * contact.angle)
        for axis in range(1 if balanced else 2):
            circuit, hanging = wiring.circuit(wiring.blocked, contact, axis)
            one = of_circuit(wiring, circuit, frozenset(looked_at.values()))
            _write(net, 2 * j + axis, one)
            if one.norm * float(net["T_s"]) > LARGEST * MOST_STEPS:
                raise ValueError(_stiffest(circuit, wiring.omega_b))
            if wiring.sinks:
                fastest = max(fastest, one.fastest)
            for place, node in looked_at.items():
                there = wiring.hangs_on(node, circuit, hanging)
                net["node_column"][2 * j + axis, place] = one.node.get(there, -1)
    return fastest


def _stiffest(circuit: Circuit, omega_b: float) -> str:
    """Which part of a circuit makes it stiff, and what to do."""
    charged, by_L = {bank.node for bank in circuit.capacitors}, defaultdict[str, float](float)
    for branch in circuit.branches:
        for node, _ in branch.taken():
            by_L[node] += 1 / branch.L
    rates = [(branch.R / branch.L, branch.name, branch.R) for branch in circuit.branches]
    rates += [(s.R * by_L[s.node], s.name, s.R) for s in circuit.shunts if s.node not in charged]
    rate, name, R = max(rates)
    return (
        f"{name}: with its R = {R:.3g} p.u. and the inductors there the circuit is too stiff:"
        f" {omega_b * rate:.2g} 1/s; a load needs some Q, or its node one of network.capacitors"
    )


def of_circuit(wiring: Wiring, circuit: Circuit, kept: frozenset[str] = frozenset()) -> Sparse:
    """The equations of a circuit of a wiring. Raises ValueError: as ``find_sparse``."""
    places, g = wiring.sources(), len(wiring.units)  # of the grid, whose negative sequence follows
    each = tuple((name, (k, k + 1) if k == g else (k,)) for name, k in places.items())
    states = tuple(unit.states for unit in wiring.units)
    return find_sparse(circuit, wiring.omega_b, wiring.order, states, each, wiring.places, kept)


def entries_of(wiring: Wiring) -> int:
    """How many entries sums may have: those that a wiring has now, and room for what events do."""
    one = of_circuit(wiring, wiring.circuit(frozenset(), None, 0)[0])
    return 2 * max(len(one.sums.value), len(one.enter.value)) + 1000


def _write(net: Any, which: int, one: Sparse) -> None:
    """Write the equations of a circuit to their place."""
    net["n_sums"][which] = one.n_x, one.n_u, len(one.extra), one.n_enter, *one.few
    net["norm"][which], net["least"][which] = one.norm, one.least
    net["own_by"][which], net["line_to"][which] = one.own, one.line_to
    for name, values in (
        ("state_at", one.state), ("x_of", one.of), ("x_by", one.by), ("extra_at", one.extra),
        ("sum_begin", one.sums.begin), ("sum_column", one.sums.column),
        ("sum_value", one.sums.value), ("enter_begin", one.enter.begin),
        ("enter_column", one.enter.column), ("enter_value", one.enter.value),
    ):  # fmt: skip
        if len(values) > net[name].shape[1]:
            raise ValueError(f"the circuit has too many connections: {len(values)} entries")
        net[name][which, : len(values)] = values


@compiled
def how_many(x: float) -> int:
    """Return how many terms the series needs for x = norm of A times h <= LARGEST."""
    j = 3
    while x > ENOUGH[j] and j < _MOST - 1:
        j += 1
    return j


@compiled
def series_half(n: Any, now: Any, half: float, which: int) -> None:
    """Take the circuit on by half a piece: ``which`` is 0 for its first half, 1 for its second.

    Args:
        n, now: elements of ``net`` and ``now``, also below.
        half: its length, s.
    """
    axes, norm = _axes(n, now), field(n, "norm")
    # what is held at another value in the second half asks for two series
    once = now.held == 0
    for axis in range(axes):
        once = once and 2.0 * half * norm[2 * now.contact + axis] <= LARGEST
    if which == 0:
        now.back = turned(-n.omega_b * half)
    elif once:
        return
    for axis in range(axes):
        c = 2 * now.contact + axis
        _begin(n, now, c, axis, which)
        steps = 1
        if not once:
            steps = max(1, math.ceil(half * norm[c] / LARGEST))
        h = (2.0 if once else 1.0) * half / steps
        for step in range(steps):
            if step > 0:
                _turn_sources(now, h)
            _series(n, now, c, axis, h)
        if which == 0 and not once:  # the end of the first half is the middle
            end, middle = field(now, "x_end"), field(now, "x_middle")
            for part in range(2):
                for k in range(field(n, "n_sums")[c, 0]):
                    middle[axis, part, k] = end[axis, part, k]


@inlined
def by_series(n: Any, now: Any) -> bool:
    """Whether the circuit in force is solved here."""
    return n.sparse != 0 and now.joint == 0


@inlined
def _axes(n: Any, now: Any) -> int:
    return 2 if field(n, "unbalanced")[1 + now.contact] else 1


@inlined
def _upright(n: Any, now: Any) -> complex:
    """Return what takes space vectors from the common frame to the axis of the circuit."""
    if field(n, "unbalanced")[1 + now.contact]:
        upright: complex = now.upright * field(n, "contact_axis")[now.contact]
        return upright
    return complex(1.0, 0.0)


@compiled
def _begin(n: Any, now: Any, c: int, axis: int, which: int) -> None:
    """Set the states, and the sources, at the beginning of a piece or in its middle."""
    to, end, s_now = _upright(n, now), field(now, "x_end"), field(now, "s_now")
    if which == 0:
        w, at, source = field(now, "w"), field(n, "state_at"), field(now, "source")
        for k in range(field(n, "n_sums")[c, 0]):
            x = w[at[c, k]] * to
            end[axis, 0, k], end[axis, 1, k] = x.real, x.imag
    else:
        to *= now.back.conjugate()
        source = field(now, "source_next")
    for k in range(now.n_s):
        s = source[k] * to
        s_now[0, k], s_now[1, k] = s.real, s.imag


@compiled
def _turn_sources(now: Any, h: float) -> None:
    """Take the sources on by h s."""
    s_now, speed = field(now, "s_now"), field(now, "source_speed")
    for k in range(now.n_s):
        s = complex(s_now[0, k], s_now[1, k]) * turned(speed[k] * h)
        s_now[0, k], s_now[1, k] = s.real, s.imag


@compiled
def _series(n: Any, now: Any, c: int, axis: int, h: float) -> None:
    """Take ``x_end`` on by h s; ``x_middle`` is in the middle of it."""
    n_x, n_s, N = field(n, "n_sums")[c, 0], now.n_s, n.n_converters
    n_u, n_extra = field(n, "n_sums")[c, 1], field(n, "n_sums")[c, 2]
    columns, end, middle = field(now, "columns"), field(now, "x_end"), field(now, "x_middle")
    s_now, speed = field(now, "s_now"), field(now, "source_speed")
    begin, column, value = field(n, "sum_begin"), field(n, "sum_column"), field(n, "sum_value")
    blocked, halves, size = now.row - 1, 1.0, 0.0
    for part in range(2):
        for k in range(n_x):
            columns[0, part, k] = middle[axis, part, k] = end[axis, part, k]
        for k in range(n_s):
            columns[0, part, n_x + k] = s_now[part, k]
        size += _square(columns[0, part], 0, n_x + n_s)
    least, norm_h = field(n, "least")[c] * size, h * field(n, "norm")[c]
    for j in range(1, how_many(norm_h) + 1):
        x, y, d = columns[(j - 1) % 2], columns[j % 2], h * _PER[j]
        halves *= 0.5
        _sum(begin[c], column[c], value[c], 0, n_u, x, 1.0, x, n_x + n_s)
        for part in range(2):
            _slopes(field(n, "own_by")[c], field(n, "line_to")[c], x[part], y[part], d, N, n_x)
        _slopes_of_others(n, c, n_u, n_x - N_OWN * N, x, d, y, N_OWN * N)
        _add(n, now, c, n_u + n_x - N_OWN * N, n_extra, x, d, y)
        if blocked >= 0:
            y[0, blocked] = y[1, blocked] = 0.0
        _turn(speed, x, y, d, n_x, n_s)
        size = 0.0
        for part in range(2):
            size += _gather(end[axis, part], middle[axis, part], y[part], halves, n_x)
            size += _square(y[part], n_x, n_s)
        # all further terms are together no larger: each is at most half of the one before
        if size < least and 2.0 * norm_h < j + 1:
            break


@summing
def _square(x: Any, begin: int, n: int) -> float:
    """Return the square of n columns from ``begin`` on."""
    first, size = _U(begin), 0.0
    for k in range(_U(n)):
        size += x[first + k] * x[first + k]
    return size


@compiled
def _sum(
    begin: Any, column: Any, value: Any, first: int, rows: int, x: Any, d: float, out: Any, at: int
) -> None:
    """Write d times the sums of rows from ``first`` on to columns of ``out`` from ``at`` on."""
    for row in range(rows):
        re = im = more_re = more_im = 0.0
        e, last = _U(begin[first + row]), _U(begin[first + row + 1])
        while e + _1 < last:
            i, j, a, b = _U(column[e]), _U(column[e + _1]), value[e], value[e + _1]
            re += a * x[_0, i]
            im += a * x[_1, i]
            more_re += b * x[_0, j]
            more_im += b * x[_1, j]
            e += _2
        if e < last:
            i, a = _U(column[e]), value[e]
            re += a * x[_0, i]
            im += a * x[_1, i]
        to = _U(at + row)
        out[_0, to], out[_1, to] = d * (re + more_re), d * (im + more_im)


@compiled
def _slopes_of_others(
    n: Any, c: int, first: int, rows: int, x: Any, d: float, y: Any, at: int
) -> None:
    """Write d times some rows of sums to y from ``at`` on. Rows of two, three and four entries
    come first, and each length has a loop without a branch."""
    begin, column, value = field(n, "sum_begin"), field(n, "sum_column"), field(n, "sum_value")
    few, col, val = field(n, "n_sums"), column[c], value[c]
    e, to = _U(begin[c, first]), _U(at)
    for _ in range(few[c, 4]):
        i, j, a, b = _U(col[e]), _U(col[e + _1]), d * val[e], d * val[e + _1]
        y[_0, to] = a * x[_0, i] + b * x[_0, j]
        y[_1, to] = a * x[_1, i] + b * x[_1, j]
        e, to = e + _2, to + _1
    for _ in range(few[c, 5]):
        i, j, k = _U(col[e]), _U(col[e + _1]), _U(col[e + _2])
        a, b, g = d * val[e], d * val[e + _1], d * val[e + _2]
        y[_0, to] = a * x[_0, i] + b * x[_0, j] + g * x[_0, k]
        y[_1, to] = a * x[_1, i] + b * x[_1, j] + g * x[_1, k]
        e, to = e + _3, to + _1
    for _ in range(few[c, 6]):
        i, j, k, m = _U(col[e]), _U(col[e + _1]), _U(col[e + _2]), _U(col[e + _3])
        a, b, g, f = d * val[e], d * val[e + _1], d * val[e + _2], d * val[e + _3]
        y[_0, to] = (a * x[_0, i] + b * x[_0, j]) + (g * x[_0, k] + f * x[_0, m])
        y[_1, to] = (a * x[_1, i] + b * x[_1, j]) + (g * x[_1, k] + f * x[_1, m])
        e, to = e + _4, to + _1
    short = few[c, 4] + few[c, 5] + few[c, 6]
    _sum(begin[c], col, val, first + short, rows - short, x, d, y, at + short)


@compiled
def _slopes(by: Any, line_to: Any, x: Any, y: Any, d: float, N: int, n_x: int) -> None:
    """Write the next terms of the converters' filters and lines."""
    v, i_o, s = _U(N), _U(2 * N), _U(n_x)
    for k in range(_U(N)):
        y[k] = d * (by[_0, k] * (x[s + k] - x[v + k]) - by[_1, k] * x[k])
    for k in range(_U(N)):
        y[v + k] = d * (by[_2, k] * (x[k] - x[i_o + k]))
    for k in range(_U(N)):
        there = x[_U(line_to[k])]
        y[i_o + k] = d * (by[_3, k] * x[v + k] - by[_4, k] * x[i_o + k] - by[_5, k] * there)


@compiled
def _add(n: Any, now: Any, c: int, first: int, rows: int, x: Any, d: float, y: Any) -> None:
    """Add what else the slopes of converters' states have."""
    begin, column, value = field(n, "sum_begin"), field(n, "sum_column"), field(n, "sum_value")
    for row in range(rows):
        at = field(n, "extra_at")[c, row]
        for e in range(begin[c, first + row], begin[c, first + row + 1]):
            y[0, at] += d * value[c, e] * x[0, column[c, e]]
            y[1, at] += d * value[c, e] * x[1, column[c, e]]


@compiled
def _turn(speed: Any, x: Any, y: Any, d: float, n_x: int, n_s: int) -> None:
    """Write the next terms of the sources."""
    first = _U(n_x)
    for k in range(_U(n_s)):
        y[_0, first + k] = -d * speed[k] * x[_1, first + k]
    for k in range(_U(n_s)):
        y[_1, first + k] = d * speed[k] * x[_0, first + k]


@summing
def _gather(end: Any, middle: Any, y: Any, halves: float, n_x: int) -> float:
    """Add a term to where the series leads, and return its square."""
    size = 0.0
    for k in range(n_x):
        term = y[k]
        size += term * term
        end[k] += term
        middle[k] += halves * term
    return size


@inlined
def _w(n: Any, now: Any, of: Any, i: int, axes: int) -> complex:
    """Return a state of w, in the frame of the series, by those x."""
    at, by = field(n, "x_of"), field(n, "x_by")
    c = 2 * now.contact
    re = im = 0.0
    if at[c, i] >= 0:
        re, im = by[c, i] * of[0, 0, at[c, i]], by[c, i] * of[0, 1, at[c, i]]
    if axes == 2:
        im = by[c + 1, i] * of[1, 1, at[c + 1, i]] if at[c + 1, i] >= 0 else 0.0
    return complex(re, im)


@compiled
def middle_state(n: Any, now: Any, i: int) -> complex:
    """Return state i of w in the middle of a piece."""
    w = _w(n, now, field(now, "x_middle"), i, _axes(n, now))
    back: complex = w * (now.back * _upright(n, now).conjugate())
    return back


@compiled
def end_states(n: Any, now: Any) -> None:
    """Write all states of w at the end of a piece."""
    w, end, axes = field(now, "w"), field(now, "x_end"), _axes(n, now)
    back = now.back * now.back
    to = back * _upright(n, now).conjugate()
    for i in range(n.n_states):
        w[i] = _w(n, now, end, i, axes) * to
    now.upright *= back.conjugate()


@compiled
def enter_sparse(n: Any, now: Any) -> None:
    """Project w onto what the circuit in force can hold; ``upright`` is that of the instant."""
    w, room, axes, to = field(now, "w"), field(now, "columns"), _axes(n, now), _upright(n, now)
    begin, column = field(n, "enter_begin"), field(n, "enter_column")
    value, states = field(n, "enter_value"), n.n_states
    for axis in range(axes):
        c = 2 * now.contact + axis
        on_the_way = field(n, "n_sums")[c, 3]
        for i in range(states):
            x = w[i] * to
            room[axis, 0, i], room[axis, 1, i] = x.real, x.imag
        x = room[axis]
        _sum(begin[c], column[c], value[c], 0, on_the_way, x, 1.0, x, states)
        _sum(begin[c], column[c], value[c], on_the_way, states, x, 1.0, x, states + on_the_way)
    first = states + field(n, "n_sums")[2 * now.contact, 3]
    last = states + field(n, "n_sums")[2 * now.contact + axes - 1, 3]
    for i in range(states):
        w[i] = complex(room[0, 0, first + i], room[axes - 1, 1, last + i]) * to.conjugate()
    if now.row > 0:
        w[N_OWN * (now.row - 1) + I_F] = 0j


@compiled
def find_nodes(n: Any, now: Any) -> None:
    """Find the voltages of all nodes, from w and the sources as they are."""
    w, at, columns = field(now, "w"), field(n, "state_at"), field(now, "columns")
    unit, emf, to = field(now, "unit"), field(now, "emf"), _upright(n, now)
    begin, column, value = field(n, "sum_begin"), field(n, "sum_column"), field(n, "sum_value")
    for axis in range(_axes(n, now)):
        c, x = 2 * now.contact + axis, columns[axis]
        n_x, n_u = field(n, "n_sums")[c, 0], field(n, "n_sums")[c, 1]
        for k in range(n_x):
            y = w[at[c, k]] * to
            x[0, k], x[1, k] = y.real, y.imag
        for k in range(now.n_s):
            g = k - n.n_converters
            E = now.V_g * now.sequence[g] if 0 <= g < 2 else emf[k]
            y = E * unit[k] * to
            x[0, n_x + k], x[1, n_x + k] = y.real, y.imag
        _sum(begin[c], column[c], value[c], 0, n_u, x, 1.0, x, n_x + now.n_s)


@compiled
def voltage_at(n: Any, now: Any, place: int) -> complex:
    """Return that of a node, see ``node_column`` in `gfm_plant.layout`, after ``find_nodes``."""
    columns, axes = field(now, "columns"), _axes(n, now)
    parts = complex(0.0, 0.0)
    for axis in range(axes):
        c = 2 * now.contact + axis
        at, g = field(n, "node_column")[c, place], field(n, "n_sums")[c, 0] + n.n_converters
        if at >= 0:
            x = complex(columns[axis, 0, at], columns[axis, 1, at])
            if at == g:  # both sequences of the grid
                x += complex(columns[axis, 0, at + 1], columns[axis, 1, at + 1])
            parts = x if axis == 0 else complex(parts.real, x.imag)
        elif axis == 1:
            parts = complex(parts.real, 0.0)
    voltage: complex = parts * _upright(n, now).conjugate()
    return voltage


@compiled
def turned(x: float) -> complex:
    """Return e^(jx); by its series where they are exact to rounding."""
    if abs(x) < 0.03:
        x2 = x * x
        return complex(
            1 - x2 * (1 / 2 - x2 * (1 / 24 - x2 * (1 / 720 - x2 * (1 / 40320)))),
            x * (1 - x2 * (1 / 6 - x2 * (1 / 120 - x2 * (1 / 5040 - x2 * (1 / 362880))))),
        )
    return complex(math.cos(x), math.sin(x))
