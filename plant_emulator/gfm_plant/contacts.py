"""The circuit while several contacts are not the same in all phases: a fault, and poles of breakers
that open meanwhile.

One contact has axes on which its circuit falls apart in two, see `circuit`. Several have different
axes, and share a zero sequence. So all three sequences are one real linear system, in energy
coordinates q as in `circuit`: alpha and beta of every state, and sqrt(2) times the zero sequence of
each line that has one, which makes (alpha, beta, that) orthogonal to the three phases.

All contacts are closed in it. A pole that opens takes away the direction in which its current
would flow, a *bar*: q then stays orthogonal to it, as the currents of a node stay where they add up
to nothing. `joint.make_joint` does so in the loop, for any set of poles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numba.np.linalg import ensure_lapack
from numpy.typing import NDArray

from gfm_plant.circuit import GROUND, Assembled, Branch, Circuit, assemble, without_ends

if TYPE_CHECKING:
    from gfm_plant.wiring import FaultPlace, Wiring

_Array = NDArray[np.float64]

PHASES = np.array(
    [[math.cos(a), math.sin(a), math.sqrt(0.5)] for a in (0.0, 2 * math.pi / 3, 4 * math.pi / 3)]
) * math.sqrt(2 / 3)
"""The phases by (alpha, beta, sqrt(2) times zero), over sqrt(3/2): orthonormal rows."""

_OWN = "own"  # the node of a fault whose zero sequence has a path of its own
OWN_PATH = "own.0"
_SMALL = 1e-9


@dataclass(frozen=True)
class Joint:
    """The system q' = flow q + by_s s, for n_q coordinates, n_w states and n_s sources."""

    # to_w, from_w: w and its parts on both axes by q and back, (2, n_w, n_q)
    to_w: _Array
    from_w: _Array
    from_s: _Array  # what the sources do, (2, n_s, n_q), 1/s
    # (8, n_q, n_q), 1/s, by the phases of the fault that conduct: 1 for a, 2 for b, 4 for c
    flow: _Array
    # (8, 3, n_q), zero where there is none; fault_carries: the currents of its phases, (8, 3, n_q)
    fault_bars: _Array
    fault_carries: _Array
    pole_bars: _Array  # the currents of the poles, (n_poles, 3, n_q); an open one is a bar
    sources: list[str]  # names of sources and sinks in their order

    @cached_property
    def fastest(self) -> float:
        """Of its modes, 1/s."""
        return max(float(np.abs(np.linalg.eigvals(flow).imag).max()) for flow in self.flow)


def zero_circuit(wiring: Wiring) -> Circuit:
    """The lines and windings through which a zero sequence flows, and the fault's own path."""
    found, held = list[Branch](), {GROUND}
    for one, (start, end) in wiring.zero_branches():
        found.append(replace(one, name=f"{one.name}.0", start=start, end=end))
    if (fault := wiring.fault) is not None and (Z_0 := fault.Z_0) is not None:
        held.add(_OWN)
        found += [Branch(OWN_PATH, GROUND, _OWN, Z_0.imag, Z_0.real)] if Z_0.imag > 0 else []
    else:
        held.add(wiring.fault_node)
    return Circuit(tuple(without_ends(found, held)), (), ())


@lru_cache(maxsize=32)
def join(wiring: Wiring) -> Joint:
    """Return the system of a wiring whose contacts are all closed. Raises ValueError: as
    `circuit.find_modes`."""
    ensure_lapack()  # now, as the loop that calls `joint.make_joint` has no time for it
    fault, place = wiring.fault, "" if wiring.fault is None else wiring.fault_node
    closed = wiring.with_poles()
    circuit, _ = closed.circuit(wiring.blocked, None, 0, place or GROUND)
    at_zero = place if fault is None or fault.Z_0 is None else _OWN
    axis, zero = assemble(circuit, place), assemble(zero_circuit(closed), at_zero)
    n, order = len(axis.names), wiring.order
    root = np.concatenate([axis.root, axis.root, zero.root])
    of_axis, of_zero = _meet(axis, place), _meet(zero, at_zero)
    meets = scipy.linalg.block_diag(of_axis, of_axis, of_zero) / root
    K = scipy.linalg.null_space(meets) if len(meets) else np.eye(len(root))
    wide = np.array([scipy.linalg.block_diag(axis.M, axis.M, zero.M)] * 8)
    bars, carries = np.zeros((8, 3, len(root))), np.zeros((8, 3, len(root)))
    for phases in range(8):
        if fault is not None:
            more, none, carries[phases] = _at_fault(
                fault, phases, circuit, (axis, place), (zero, at_zero)
            )
            wide[phases] += more
            bars[phases, : len(none)] = none
    flow = wiring.omega_b * K.T @ (wide / root[:, None] / root) @ K
    states = np.zeros((2, len(order), len(root)))
    for j, name in enumerate(axis.names):
        states[0, order.index(name), j] = states[1, order.index(name), n + j] = 1.0
    for j, name in enumerate(zero.names):
        states[0, order.index(name), 2 * n + j] = 1.0
    poles = np.zeros((len(wiring.poles), 3, len(root)))
    for which, (name, part) in enumerate(wiring.poles):
        for state, factor in closed.through_pole(name, part).items():
            for x, known in enumerate((axis.names, axis.names, zero.names)):
                one = state if x < 2 else f"{state}.0"
                if one in known:
                    poles[which, :, x * n + known.index(one)] += factor * PHASES[:, x]
    B = np.zeros((2, axis.B.shape[1], len(root)))
    B[0, :, :n] = B[1, :, n : 2 * n] = axis.B.T
    return Joint(
        to_w=states / root @ K,
        from_w=states * root @ K,
        from_s=wiring.omega_b * (B / root) @ K,
        flow=flow,
        fault_bars=bars / root @ K,
        fault_carries=carries / root @ K,
        pole_bars=poles / root @ K,
        sources=circuit.names,
    )


def _meet(part: Assembled, apart: str) -> _Array:
    """The sums that vanish at nodes, but for one that is apart."""
    rows = [row for node, row in part.meets.items() if node != apart]
    return np.array(rows).reshape(len(rows), len(part.names))


def _at_fault(
    fault: FaultPlace,
    phases: int,
    circuit: Circuit,
    on_axis: tuple[Assembled, str],
    on_zero: tuple[Assembled, str],
) -> tuple[_Array, _Array, _Array]:
    """What a fault adds to the equations of the real states while some of its phases conduct, which
    sums of currents have no path, and the currents of its phases, all by these states.

    Unknown are the voltages u of the place, the currents i of its phases, and that of a path of the
    zero sequence without inductance. With j for what arrives: sum of i = j - u / R_shunt (at a
    capacitor u is known instead), u = R i in each phase, u_0 = -R_0 i_0. Where that has no
    solution, j has to be zero.
    """
    (axis, place), (zero, at_zero) = on_axis, on_zero
    n, n_0 = len(axis.names), len(zero.names)
    conducting = [p for p in range(3) if phases >> p & 1]
    T, sign = PHASES[conducting], np.eye(3)[conducting]
    if fault.kind == "LL":
        T = T[:1] - T[1:] if len(T) == 2 else T[:0]
        sign = sign[:1] - sign[1:] if len(sign) == 2 else sign[:0]
    leaves = np.zeros((3, 2 * n + n_0))
    leaves[0, :n] = leaves[1, n : 2 * n] = axis.meets.get(place, np.zeros(n))
    leaves[2, 2 * n :] = zero.meets.get(at_zero, np.zeros(n_0))
    m, massless = len(T), fault.Z_0 is not None and fault.Z_0.imag == 0
    scale = math.sqrt(1 + fault.R)
    A, right = np.zeros((3 + m + massless,) * 2), np.zeros((3 + m + massless, 2 * n + n_0))
    A[:3, 3 : 3 + m], A[3 : 3 + m, :3] = T.T / scale, T / scale
    A[3 : 3 + m, 3 : 3 + m] = -fault.R / scale**2 * np.eye(m)
    right[:3] = -leaves
    bank = next((axis.names.index(c.name) for c in circuit.capacitors if c.node == place), None)
    if bank is None:
        A[[0, 1], [0, 1]] = sum(1 / shunt.R for shunt in circuit.shunts if shunt.node == place)
    else:
        A[:2] = right[:2] = 0.0
        A[0, 0] = A[1, 1] = right[0, bank] = right[1, n + bank] = 1.0
    if massless:
        A[2, -1], A[-1, 2], A[-1, -1] = -1.0, 1.0, complex(fault.Z_0 or 0).real
    U, sizes, V = np.linalg.svd(A)
    some = sizes > _SMALL * max(1.0, sizes[0])
    found = V[some].T @ (U[:, some].T @ right / sizes[some, None])
    i = found[3 : 3 + m] / scale
    more = leaves.T @ found[:3]
    if bank is not None:
        more[[bank, n + bank]] -= (T.T @ i)[:2]
    _, lengths, none = np.linalg.svd(U[:, ~some].T @ right, full_matrices=False)
    return more, none[lengths > _SMALL], math.sqrt(1.5) * sign.T @ i
