"""A linear circuit of R-L branches and capacitors between voltage sources, and its modes.

All voltages and currents are complex space vectors in one common frame that rotates at omega_b.
There w' = A w + B s, with the currents of the branches and the voltages of the
capacitors as w and the voltages of the sources as s. In energy coordinates (a current times
sqrt(L), a voltage times sqrt(C)) the lossless part of A is skew-Hermitian, so its modes are nearly
orthogonal even where eigenvalues repeat, as those of identical converters in parallel do.

A node that has neither a capacitor nor a source forces the sum of its branch currents to zero. The
circuit then lives in the subspace in which these sums vanish, and the projection onto it by
stored energy is what a switching does physically: it keeps the flux of every loop.

An unbalanced fault connects each space vector with its conjugate. With the real axis on the phase
that differs from the two others, the real and the imaginary parts of all space vectors in the
frame that stands still belong to two real circuits, which have nothing to do with each other.
``join_axes`` makes one set of modes of both.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy  # loads its parts when they are first used: a controller's side uses none
from numpy.typing import NDArray

GROUND = "ground"

WORST_CONDITION = 1e8
"""Largest condition number of the modes: beyond it half of the digits would be lost."""

_DEAD = 1e-15  # p.u.; an admittance at each node, so that a dead part has a solution, zero


@dataclass(frozen=True)
class Branch:
    """R and L in series from node ``start`` to node ``end``, p.u.; L > 0.

    ``earthed`` is that of `Transformer`, "" if it is none. One that is not ``switched`` has no
    breaker and feeds nothing. ``ratio`` is that of an ideal transformer at its start: the voltage
    of the start over that behind it.
    """

    name: str
    start: str
    end: str
    L: float
    R: float
    earthed: str = ""
    switched: bool = True
    ratio: float = 1.0

    def taken(self) -> tuple[tuple[str, float], ...]:
        """Its nodes, and what a current of 1 from start to end takes away from each. By the same
        factors the voltages of the nodes drive the current."""
        return (self.start, 1.0 / self.ratio), (self.end, -1.0)


@dataclass(frozen=True)
class Capacitor:
    """C between a node and ground, p.u.; C > 0."""

    name: str
    node: str
    C: float


@dataclass(frozen=True)
class Shunt:
    """R from a node to ground, p.u.; R > 0 at a node with a capacitor, elsewhere R >= 0."""

    name: str
    node: str
    R: float


@dataclass(frozen=True)
class VoltageSource:
    """An ideal voltage at a node, against ground."""

    name: str
    node: str


@dataclass(frozen=True)
class CurrentSource:
    """A current from a node with a capacitor to ground, p.u.; one that is not ``switched`` has no
    breaker."""

    name: str
    node: str
    switched: bool = True


Element = Branch | Capacitor | Shunt | CurrentSource


@dataclass(frozen=True)
class Circuit:
    """The parts of a circuit; at most one shunt a node, none at a source."""

    branches: tuple[Branch, ...]
    capacitors: tuple[Capacitor, ...]
    sources: tuple[VoltageSource, ...]
    shunts: tuple[Shunt, ...] = ()
    sinks: tuple[CurrentSource, ...] = ()

    @property
    def names(self) -> list[str]:
        """Those of its sources, and then of its sinks."""
        return [one.name for one in self.sources] + [one.name for one in self.sinks]


@dataclass(frozen=True)
class Modes:
    """What ``find_modes`` returns, for w of n_w states, n modes and n_s sources."""

    rates: NDArray[np.complex128]  # eigenvalues, (n,), 1/s
    # w of the modes, (n_w, n); a state that the circuit does not have is zero
    states: NDArray[np.complex128]
    modes: NDArray[np.complex128]  # the modes of w, (n, n_w); it projects by stored energy
    # rate of the modes per source voltage, and per current of the sinks, (n, n_s), 1/s
    drive: NDArray[np.complex128]
    # factor, (n,), on ``modes`` and ``drive`` for the mirror images of w and of the sources,
    # conj(x) e^(-2 j omega_b t); zero in a balanced circuit, which has no use for them
    mirror: NDArray[np.complex128]


@dataclass(frozen=True)
class Rates:
    """What ``find_rates`` returns: w' = by_w w + by_s s in the frame that stands still."""

    # by_w, by_s: (n_w, n_w) and (n_w, n_s), 1/s; rows of states that the circuit does not have are
    # zero
    by_w: NDArray[np.float64]
    by_s: NDArray[np.float64]
    fastest: float  # the norm of ``by_w`` in energy coordinates, 1/s
    free: NDArray[np.float64]  # (n_w, n): a basis of the w that the nodes allow


@dataclass(frozen=True)
class _Reduced:
    """The circuit in energy coordinates q = K' (root w): q' = omega_b K' (M / root / root) K q +
    omega_b K' (B / root) s."""

    # of the states, branches before capacitors; M, B: of the stored quantities; root: of their L
    # and C; K: columns that are an orthonormal basis of what the nodes allow
    names: list[str]
    M: NDArray[np.float64]
    B: NDArray[np.float64]
    root: NDArray[np.float64]
    K: NDArray[np.float64]


@dataclass(frozen=True)
class Assembled:
    """The equations of a circuit before the currents at its nodes add up: see `_Reduced`."""

    names: list[str]
    M: NDArray[np.float64]
    B: NDArray[np.float64]
    root: NDArray[np.float64]
    # of each node without a source or a capacitor what each state takes away from it
    meets: dict[str, NDArray[np.float64]]


@lru_cache(maxsize=256)
def find_modes(circuit: Circuit, omega_b: float, order: tuple[str, ...]) -> Modes:
    """Return the modes of a circuit; those of the last circuits are kept, so that an event of a
    scenario that has been tried before its run costs no eigenvalues in real time.

    Args:
        circuit: the currents of its sinks follow the sources in ``Modes.drive``.
        omega_b: rad/s, also the speed of the common frame.
        order: the names of the states as w has them; those of other circuits may be among them.

    Raises:
        ValueError: an L or C is not positive, a node hangs on one branch alone, two sources or
            capacitors share a node, a sink is at a node without a capacitor, or the modes are too
            close to each other to be told apart.
    """
    one = _reduce(circuit)
    M, B, root, K = one.M, one.B, one.root, one.K
    A = omega_b * K.T @ (M / root[:, None] / root) @ K - 1j * omega_b * np.eye(K.shape[1])
    rates, X = np.linalg.eig(A)
    if not np.linalg.cond(X) < WORST_CONDITION:
        raise ValueError("the circuit's modes cannot be told apart: change one element a little")
    at = [order.index(name) for name in one.names]
    states = np.zeros((len(order), len(rates)), complex)
    modes = np.zeros((len(rates), len(order)), complex)
    states[at] = (K @ X) / root[:, None]
    modes[:, at] = np.linalg.solve(X, K.T.astype(complex)) * root
    drive = np.zeros((len(rates), B.shape[1]), complex)
    drive[:] = omega_b * np.linalg.solve(X, K.T @ (B / root[:, None]))
    mirror = np.zeros(len(rates), complex)
    for array in (rates, states, modes, drive, mirror):
        array.flags.writeable = False
    return Modes(rates, states, modes, drive, mirror)


def rest(
    circuit: Circuit, order: Sequence[str], volts: Mapping[str, complex], turns: Mapping[str, float]
) -> NDArray[np.complex128]:
    """w at rest, in the common frame at t = 0: by the sparse equations of branches and nodes.

    Args:
        circuit, order: as for ``find_modes``.
        volts, turns: of each source and sink its value and its speed, p.u.
    """
    fixed, charged, through = check_parts(circuit)
    branches = circuit.branches
    nodes = {node: None for branch in branches for node, _ in branch.taken()}
    place = {node: k for k, node in enumerate(n for n in nodes if n != GROUND and n not in fixed)}
    places = {name: k for k, name in enumerate(order)}
    n_b, n = len(branches), len(branches) + len(place)
    w = np.zeros(len(order), complex)
    for omega in {turns[name] for name in circuit.names}:
        those = {name: volts[name] if turns[name] == omega else 0j for name in circuit.names}
        entries, right = list[tuple[int, int, complex]](), np.zeros(n, complex)
        for j, b in enumerate(branches):
            entries.append((j, j, -complex(b.R, omega * b.L)))
            for node, sign in b.taken():
                if node in fixed:
                    right[j] -= sign * those[circuit.sources[fixed[node]].name]
                elif node != GROUND:
                    entries += [(j, n_b + place[node], sign), (n_b + place[node], j, sign)]
        admittance = {node: 1j * omega * circuit.capacitors[k].C for node, k in charged.items()}
        for node, k in place.items():
            Y, R = admittance.get(node, _DEAD), through.get(node)
            if R == 0.0:  # a metallic fault
                entries = [one for one in entries if one[0] != n_b + k] + [(n_b + k, n_b + k, 1.0)]
            else:
                entries.append((n_b + k, n_b + k, Y + (1 / R if R else 0.0)))
        for sink in circuit.sinks:
            right[n_b + place[sink.node]] -= those[sink.name]
        rows, columns, values = zip(*entries, strict=True)
        shape = (n, n)
        matrix = scipy.sparse.csc_matrix((values, (rows, columns)), shape, dtype=complex)
        found = scipy.sparse.linalg.splu(matrix).solve(right)
        for j, b in enumerate(branches):
            w[places[b.name]] += found[j]
        for node, k in charged.items():
            w[places[circuit.capacitors[k].name]] += found[n_b + place[node]]
    return w


def find_rates(circuit: Circuit, omega_b: float, order: Sequence[str]) -> Rates:
    """Return the equations of a circuit as they are, for whom solves them by a series; arguments
    and errors as for ``find_modes``."""
    one = _reduce(circuit)
    P = one.K @ one.K.T
    A = omega_b * P @ (one.M / one.root[:, None] / one.root) @ P
    fastest = float(np.linalg.norm(A, 2))
    A[np.abs(A) < 1e-13 * fastest] = 0.0  # rounding of P
    drive = P @ (one.B / one.root[:, None])
    drive[np.abs(drive) < 1e-13 * np.abs(drive).max(initial=0.0)] = 0.0
    at = [order.index(name) for name in one.names]
    by_w = np.zeros((len(order), len(order)))
    by_w[np.ix_(at, at)] = A / one.root[:, None] * one.root
    by_s = np.zeros((len(order), drive.shape[1]))
    by_s[at] = omega_b * drive / one.root[:, None]
    free = np.zeros((len(order), one.K.shape[1]))
    free[at] = one.K / one.root[:, None]
    return Rates(by_w, by_s, fastest, free)


def _reduce(circuit: Circuit) -> _Reduced:
    one = assemble(circuit)
    rows = list(one.meets.values())
    K = scipy.linalg.null_space(np.array(rows) / one.root) if rows else np.eye(len(one.root))
    return _Reduced(one.names, one.M, one.B, one.root, K)


def assemble(circuit: Circuit, apart: str = "") -> Assembled:
    """Return the equations of a circuit; errors as for ``find_modes``.

    Args:
        circuit: the circuit.
        apart: a node at which something else ends too: its shunt is left out.
    """
    branches, sources, sinks = circuit.branches, circuit.sources, circuit.sinks
    fixed, charged, through = check_parts(circuit, apart)
    stored = [b.L for b in branches] + [c.C for c in circuit.capacitors]
    names = [b.name for b in branches] + [c.name for c in circuit.capacitors]
    n_b, n_c = len(branches), len(circuit.capacitors)
    n_s = len(sources) + len(sinks)
    M = np.zeros((n_b + n_c, n_b + n_c))  # of the stored quantities: L i' = M w + B s, C v' = M w
    B = np.zeros((n_b + n_c, n_s))
    meets: dict[str, NDArray[np.float64]] = {}
    for j, branch in enumerate(branches):
        M[j, j] = -branch.R
        for node, sign in branch.taken():
            if node in fixed:
                B[j, fixed[node]] = sign
            elif node in charged:
                M[j, n_b + charged[node]] = sign
                M[n_b + charged[node], j] = -sign
            elif node != GROUND:
                meets.setdefault(node, np.zeros(n_b + n_c))[j] = sign
    for j, sink in enumerate(sinks, len(sources)):
        B[n_b + charged[sink.node], j] = -1.0
    for node, k in charged.items():
        if node in through:
            M[n_b + k, n_b + k] -= 1 / through[node]
    for node, row in list(meets.items()):
        if node != apart and node in through:  # its voltage is R times the current that arrives
            M -= through[node] * np.outer(row, row)
            del meets[node]

    return Assembled(names, M, B, np.sqrt(stored), meets)


def check_parts(
    circuit: Circuit, apart: str = ""
) -> tuple[dict[str, int], dict[str, int], dict[str, float]]:
    """The places of the sources and of the capacitors at their nodes, and R of the shunts; errors
    and arguments as for ``assemble``."""
    for part in circuit.branches:
        if not part.L > 0:
            raise ValueError(f"{part.name} = {part.L}: must be > 0")
    for bank in circuit.capacitors:
        if not bank.C > 0:
            raise ValueError(f"{bank.name} = {bank.C}: must be > 0")
    fixed = _places("source", circuit.sources)
    charged = _places("capacitor", circuit.capacitors)
    if both := set(fixed) & set(charged):
        raise ValueError(f"node {min(both)}: a source and a capacitor in parallel")
    through = {shunt.node: shunt.R for shunt in circuit.shunts}
    for sink in circuit.sinks:
        if sink.node not in charged:
            raise ValueError(
                f"node {sink.node}: {sink.name} draws a current, so the node needs a bank of"
                " network.capacitors"
            )
    for node in charged:
        if not through.get(node, 1.0) > 0:
            raise ValueError(f"node {node}: a shunt of R = {through[node]} on a capacitor")
    met: dict[str, list[str]] = {}
    for branch in circuit.branches:
        for node, _ in branch.taken():
            met.setdefault(node, []).append(branch.name)
    for node, names in met.items():
        if len(names) < 2 and node not in {GROUND, apart, *fixed, *charged, *through}:
            raise ValueError(f"node {node}: only {names[0]} ends there")
    return fixed, charged, through


def join_axes(alpha: Modes, beta: Modes, angle: float) -> Modes:
    """Return the modes of a circuit that is not the same in all directions.

    In the frame that stands still a space vector is W = w e^(j omega_b t), and the parts of
    W e^(-j angle) = W_alpha + j W_beta belong to one circuit each. Their modes are real-linear in
    W, and so linear in w and its mirror image together: W_alpha = (W' + conj W') / 2 and
    W_beta = (W' - conj W') / 2j with W' = W e^(-j angle).

    Args:
        alpha, beta: the modes of the two circuits, with the same states and sources.
        angle: of the axis of alpha, rad.
    """
    turn = np.exp(1j * angle)
    half, mirrored = (0.5 / turn, -0.5j / turn), (turn**2, -(turn**2))
    both = alpha, beta
    return Modes(
        np.concatenate([one.rates for one in both]),
        np.hstack([alpha.states * turn, beta.states * 1j * turn]),
        np.vstack([one.modes * part for one, part in zip(both, half, strict=True)]),
        np.vstack([one.drive * part for one, part in zip(both, half, strict=True)]),
        np.concatenate(
            [np.full(len(m.rates), part) for m, part in zip(both, mirrored, strict=True)]
        ),
    )


def find_voltage(
    node: str, circuit: Circuit, order: Sequence[str]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the voltage of a node as factors of w, (n_w,), and of the sources, (n_s,).

    That of a node where branches alone meet is the one under which their currents go on adding up
    to nothing: with D for which branches meet where, D L^-1 D' v = D L^-1 (R i - what the other
    ends give).

    Args:
        circuit, order: as for ``find_modes``.
    """
    branches = circuit.branches
    charged = {part.node: order.index(part.name) for part in circuit.capacitors}
    fixed = _places("source", circuit.sources)
    through = {shunt.node: shunt.R for shunt in circuit.shunts}
    n_w, n_s = len(order), len(circuit.sources)
    ends = [end for branch in branches for end in (branch.start, branch.end)]
    known = {GROUND, *charged, *fixed, *through}
    free = [one for one in dict.fromkeys(ends) if one not in known]
    rows: dict[str, NDArray[np.float64]] = {GROUND: np.zeros(n_w + n_s)}
    for one, place in charged.items():
        rows[one] = np.eye(n_w + n_s)[place]
    for one, place in fixed.items():
        rows[one] = np.eye(n_w + n_s)[n_w + place]
    for one in through:
        if one not in rows:
            rows[one] = np.zeros(n_w + n_s)
            for branch in branches:
                for end, sign in branch.taken():
                    if end == one:
                        rows[one][order.index(branch.name)] = -sign * through[one]
    if node in rows:
        return rows[node][:n_w], rows[node][n_w:]
    D = np.zeros((len(free), len(branches)))
    right = np.zeros((len(branches), n_w + n_s))
    for j, branch in enumerate(branches):
        right[j, order.index(branch.name)] = branch.R
        for end, sign in branch.taken():
            if end in rows:
                right[j] -= sign * rows[end]
            else:
                D[free.index(end), j] = sign
    DL = D / [branch.L for branch in branches]
    found = np.linalg.lstsq(DL @ D.T, DL @ right, rcond=None)[0][free.index(node)]
    return found[:n_w], found[n_w:]


def without_ends(branches: list[Branch], held: set[str]) -> list[Branch]:
    """Leave out what an open breaker has left hanging at one end, where no current can flow."""
    while True:
        met = [node for branch in branches for node in (branch.start, branch.end)]
        kept = [b for b in branches if all(n in held or met.count(n) > 1 for n in (b.start, b.end))]
        if len(kept) == len(branches):
            return kept
        branches = kept


def _places(kind: str, parts: Sequence[VoltageSource | Capacitor]) -> dict[str, int]:
    """Index of the part at each node."""
    found: dict[str, int] = {}
    for k, part in enumerate(parts):
        if part.node in found:
            two = f"{parts[found[part.node]].name} and {part.name}"
            raise ValueError(f"node {part.node}: {two}, one {kind} only")
        found[part.node] = k
    return found
