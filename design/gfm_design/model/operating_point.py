"""The operating point of a converter under a law: the equilibrium of their own equations.

Unknowns are the plant's states, the DC current, E_u and the law's states; omega_u is the grid's.
The equations are the plant's Eq. (1)-(8) (``gfm_plant.model.f``, not a copy of it), the law's
x = A x + B (r, y) and u = u_0 + C x + D (r, y) at its sampling time, with y as the sensors report
it. A regulated DC source holds v_dc = 1, and row 1 of the law does not act. Neither does it with a
PV array straight across the link, whose current by v_dc is then the equation of the DC side: a law
that answers to v_dc decides on v_dc and takes the power that the array gives there, and of one that
does not v_dc is where the array gives what the law asks for, beyond the point of maximum power.
"""

import cmath
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import cast

import numpy as np
import scipy  # loads its sparse matrices when they are first used: of large networks
from numpy.typing import NDArray

from gfm_plant import Network, NoEquilibrium, plant_equilibrium
from gfm_plant.circuit import GROUND
from gfm_plant.model import DELTA, N_X, V_DC, compiled_f, g
from gfm_plant.names import SENSED
from gfm_plant.pv_array import array_current, most_power, open_circuit_voltage
from gfm_plant.records import ACROSS, BEHIND, Record
from gfm_plant.wiring import Wiring
from gfm_runtime import LawError
from gfm_runtime.error_maps import ERROR_MAPS, map_errors
from gfm_runtime.inner import GridFollowingStage
from gfm_runtime.signals import NU, NY
from gfm_runtime.tustin import DiscreteLaw

Vector = NDArray[np.float64]

_ROUNDS = 40
_ROUNDING = 1e-12  # p.u.; a residual that is smaller is none
_MOST_BY_SQUARES = 500  # unknowns; the time of least squares grows with their cube
_LEAST_P = 1e-9  # p.u. of power; less is rounding
_NUDGE = 1e-7  # of differences; the error map is compiled for real numbers only
_LOSES = 30  # rounds in which a command is found by what the bridge loses of it

Drop = Callable[[complex, complex], complex]
"""What a bridge loses of a voltage e, p.u., by the current of L_f and e, in any common frame."""


def no_drop(i: complex, e: complex) -> complex:
    """An ideal bridge's."""
    return 0j


@dataclass(frozen=True)
class OperatingPoint:
    """The common equilibrium of plant and law, all in p.u."""

    #: the plant's state, shape (8,), order as in ``gfm_plant.model``, in the frame of the law: its
    #: E_u lies on the d axis
    x: Vector
    #: the law's output, shape (3,); i_u is the current of the DC source, also of one that does
    #: not follow the law
    u: Vector
    y: Vector  #: the outputs as the sensors report them, shape (5,)
    x_law: Vector  #: the law's state, shape (n,)
    #: the voltage e_d + j e_q in that frame that the bridge is commanded; E_u without a stage
    e: complex

    @property
    def commands(self) -> Vector:
        """(i_u, omega_u, e_d, e_q), shape (4,), p.u.: what the bridge gets."""
        return np.array([self.u[0], self.u[1], self.e.real, self.e.imag])


def operating_point(
    par: Record,
    law: DiscreteLaw,
    ref: Vector,
    omega_g: float = 1.0,
    V_g: float = 1.0,
    drop: Drop = no_drop,
) -> OperatingPoint:
    """Solve for the operating point by Newton's method.

    Args:
        par: the plant's parameters, from ``gfm_plant.make_plant``.
        law: the law at its sampling time.
        ref: references (V_dcref, P_ref, omega_g, Q_ref, V_ref), shape (5,), p.u.
        omega_g, V_g: the grid, p.u.
        drop: what the bridge loses of the voltage that it is commanded, p.u., by i and e.

    Raises:
        NoEquilibrium: the law has no steady state there (a frequency that its droop cannot reach
            within the line's capacity, or no steady state at all).
    """
    side = _ConverterEquilibrium(par, law, np.asarray(ref), drop)
    z = _newton(lambda z: side.residual(z, V_g, omega_g), side.first(V_g, omega_g))
    if z is None:
        raise NoEquilibrium(side.no_steady_state(f"omega_g = {omega_g:g} p.u., V_g = {V_g:g} p.u."))
    return side.found(z, omega_g)


def operating_points(
    plant: Network, laws: Sequence[DiscreteLaw], refs: Sequence[Vector]
) -> tuple[list[OperatingPoint], list[tuple[Vector, float]], dict[str, complex]]:
    """Solve for the common operating point of several converters, each under its law.

    Unknowns are those of each converter, the voltages of the nodes, and those of components, such
    as the angle of a machine; of each island also the frequency. The currents that meet at a node
    add up to nothing, and each machine gives what its governor asks for. An island is what closed
    lines connect, but not to the grid, with a converter or a machine in it; a part of the network
    without any is dead.

    Args:
        plant: as it is to start.
        laws, refs: of each converter, as for ``operating_point``.

    Returns:
        That of each converter, its angle against the grid or, in an island, its first node; of each
        component with a source its unknowns and its speed, p.u.; and the voltages of the nodes, as
        `Network.start` takes them.

    Raises:
        NoEquilibrium: there is none, or Newton's method does not find it.
    """
    network = _NetworkEquilibrium(plant, laws, refs)
    z = network.solved()
    return *network.found(z), network.voltages(z)


def node_voltages(
    plant: Network, laws: Sequence[DiscreteLaw], refs: Sequence[Vector]
) -> dict[str, complex]:
    """The voltages of the nodes at that operating point, p.u., each against the grid's or, in an
    island, that of its first node. Arguments and errors as of ``operating_points``."""
    network = _NetworkEquilibrium(plant, laws, refs)
    return network.voltages(network.solved())


class _NetworkEquilibrium:
    """The unknowns z of a network in its steady state, and what must vanish.

    z has the unknowns of each converter, the two parts of each node's voltage, the unknowns of each
    component with a source, and the speed of each island.
    """

    def __init__(self, plant: Network, laws: Sequence[DiscreteLaw], refs: Sequence[Vector]) -> None:
        self.wiring = wiring = plant.wiring
        self.laws, self.refs = laws, refs
        self.V_g, self.omega_g = complex(plant.now[0]["V_g"]), float(plant.now[0]["omega_g"])
        self.sides = [
            _ConverterEquilibrium(plant.par[k : k + 1], law, np.asarray(ref))
            for k, (law, ref) in enumerate(zip(laws, refs, strict=True))
        ]
        self.fixed = wiring.grid if wiring.closed else None
        self.nodes = wiring.nodes
        self.free = [node for node in self.nodes if node != self.fixed]
        feeding = {unit.node for unit in wiring.units}
        feeding |= {node for _, one in wiring.fed if one.is_voltage for node in one.nodes}
        groups = wiring.islands()
        self.islands = [g for g in groups if self.fixed not in g and feeding & {*g}]
        self._check_forming()
        self.island_of = {node: k for k, nodes in enumerate(self.islands) for node in nodes}
        self.alive = {*self.island_of, *(n for g in groups if self.fixed in g for n in g)}
        self.sizes = [side.size for side in self.sides]
        acting = [c for name, c in wiring.fed if c.is_voltage or name not in wiring.opened]
        #: how many rows are before those of the nodes
        self.wanted = sum(self.sizes) + sum(one.unknowns for one in acting)
        self.sizes += [2 * len(self.free), *(one.unknowns for _, one in wiring.fed)]

    def _check_forming(self) -> None:
        """Raise NoEquilibrium: in an island all converters follow a voltage that nothing forms."""
        sources = {node for _, one in self.wiring.fed if one.is_voltage for node in one.nodes}
        for nodes in self.islands:
            there = [
                (unit.name, law.law)
                for unit, law in zip(self.wiring.units, self.laws, strict=True)
                if unit.node in nodes
            ]
            follow = all(isinstance(law.inner, GridFollowingStage) for _, law in there)
            if follow and not sources & {*nodes}:
                who = ", ".join(f"{name} ({law.name})" for name, law in there)
                raise NoEquilibrium(
                    f"{who}: nothing forms the voltage of {', '.join(nodes)}; a law that follows"
                    " the grid needs the grid, a machine or a grid-forming converter there"
                )

    def _split(self, z: Vector) -> tuple[list[Vector], dict[str, complex], dict[str, float]]:
        """The unknowns of each converter and component, and each node's voltage and speed."""
        *own, omegas = np.split(z, np.cumsum(self.sizes))
        pairs = own.pop(len(self.sides)).reshape(-1, 2)
        volts = {node: complex(*pair) for node, pair in zip(self.free, pairs, strict=True)}
        if self.fixed is not None:
            volts[self.fixed] = self.V_g
        at = self.island_of
        speeds = {n: float(omegas[at[n]]) if n in at else self.omega_g for n in self.nodes}
        speeds |= {unit.terminal: speeds[unit.node] for unit in self.wiring.units}
        return own, volts, speeds

    def residual(self, z: Vector) -> Vector:
        """What must vanish: the slopes of each converter, what components want, and the currents
        that meet at each node; the voltage of each island's first node has no imaginary part."""
        wiring, (own, volts, speeds) = self.wiring, self._split(z)
        missing = dict.fromkeys(self.nodes, 0j)  # current that comes to each node
        rows = []
        for side, unit, mine in zip(self.sides, wiring.units, own, strict=False):
            v, omega = volts[unit.node], speeds[unit.node]
            rows.append(side.residual(mine, abs(v), omega, cmath.phase(v)))
            i_o = complex(mine[4], mine[5]) * cmath.exp(1j * mine[DELTA])
            missing[unit.node] += i_o / float(side.par[0]["current"])
            volts[unit.terminal] = complex(mine[2], mine[3]) * cmath.exp(1j * mine[DELTA])
            missing[unit.terminal] = 0j  # of a core, which draws nothing in steady state
        for branch in wiring.branches:
            if branch.name not in wiring.opened:
                ends = branch.taken()
                i = sum(sign * volts.get(node, 0j) for node, sign in ends)
                i /= complex(branch.R, speeds[branch.start] * branch.L)
                for node, sign in ends:
                    if node != GROUND:
                        missing[node] -= sign * i
        for shunt in wiring.shunts:
            if shunt.name not in wiring.opened:
                missing[shunt.node] -= volts[shunt.node] / shunt.R
        for capacitor in wiring.capacitors:
            omega = speeds[capacitor.node]
            missing[capacitor.node] -= 1j * omega * capacitor.C * volts[capacitor.node]
        fed = zip(wiring.fed, own[len(self.sides) :], strict=True)
        for (name, one), mine in sorted(fed, key=lambda item: item[0][1].is_voltage):
            if one.is_voltage or name not in wiring.opened:
                at, omega = [volts[node] for node in one.nodes], speeds[one.nodes[0]]
                seen = np.array(at) if len(at) > 1 else at[0]
                i, wanted = one.steady(seen, omega, wiring.omega_b, mine)
                for node, current in zip(one.nodes, np.atleast_1d(i).tolist(), strict=True):
                    missing[node] += current
                rows.append(np.array(wanted))
        met = [part for node in self.free for part in (missing[node].real, missing[node].imag)]
        return np.concatenate([*rows, met, [volts[nodes[0]].imag for nodes in self.islands]])

    def _reach(self) -> list[tuple[set[int], set[int]]]:
        """The rows of ``residual`` that each unknown acts on: those whose slopes are to be
        measured, and all, with those of ``_slopes``. A speed may act on all."""
        wiring = self.wiring
        fed = sorted(enumerate(wiring.fed), key=lambda item: item[1][1].is_voltage)
        lengths = [side.size for side in self.sides]
        lengths += [
            one.unknowns for _, (name, one) in fed if one.is_voltage or name not in wiring.opened
        ]
        starts = np.cumsum([0, *lengths])
        blocks = [{*range(a, b)} for a, b in pairwise(starts)]
        at = {node: {k, k + 1} for node, k in self._places(self.wanted).items()}
        reached = {node: set(rows) for node, rows in at.items()}  # by the voltage of each node
        for k, nodes in enumerate(self.islands):
            reached[nodes[0]].add(self.wanted + 2 * len(self.free) + k)
        own = [set(block) for block in blocks[: len(wiring.units)]]
        terminals = {unit.terminal: k for k, unit in enumerate(wiring.units)}
        for k, unit in enumerate(wiring.units):
            reached.get(unit.node, set()).update(blocks[k])
        mine: dict[int, set[int]] = {}
        left = iter(blocks[len(own) :])
        for k, (name, component) in fed:
            rows = next(left) if component.is_voltage or name not in wiring.opened else set()
            mine[k] = rows.union(*(at.get(node, set()) for node in component.nodes))
            for node in component.nodes:
                if node in terminals:
                    own[terminals[node]] |= rows
                reached.get(node, set()).update(rows)
        beyond = {node: set(rows) for node, rows in reached.items()}
        for branch in wiring.branches:
            for one, other in ((branch.start, branch.end), (branch.end, branch.start)):
                if one in beyond:
                    beyond[one] |= at.get(other, set())
        reach = list[tuple[set[int], set[int]]]()
        for unit, side, rows in zip(wiring.units, self.sides, own, strict=True):
            reach += [(rows, rows | at.get(unit.node, set()))] * side.size
        reach += [(reached[node], beyond[node]) for node in self.free for _ in range(2)]
        for k, (_, component) in enumerate(wiring.fed):
            reach += [(mine[k], mine[k])] * component.unknowns
        everything = {*range(self.wanted + 2 * len(self.free) + len(self.islands))}
        return reach + [(everything, everything)] * len(self.islands)

    def _places(self, first: int) -> dict[str, int]:
        """The first of the two rows, or unknowns, of each node, where those of nodes begin."""
        return {node: first + 2 * k for k, node in enumerate(self.free)}

    def _slopes(self, z: Vector) -> Iterator[tuple[int, int, float]]:
        """The slopes that are known: by row and unknown, those of the current that meets at a node
        by the voltage of another one, and by the current and the angle of a converter."""
        wiring, (own, _, speeds) = self.wiring, self._split(z)
        rows = self._places(self.wanted)
        unknowns, first = self._places(sum(side.size for side in self.sides)), 0
        for side, unit, mine in zip(self.sides, wiring.units, own, strict=False):
            if (row := rows.get(unit.node)) is not None:
                turn = cmath.exp(1j * mine[DELTA]) / float(side.par[0]["current"])
                for k, slope in (
                    (4, turn), (5, 1j * turn), (DELTA, 1j * complex(mine[4], mine[5]) * turn),
                ):  # fmt: skip
                    yield row, first + k, slope.real
                    yield row + 1, first + k, slope.imag
            first += side.size
        for branch in wiring.branches:
            if branch.name not in wiring.opened:
                y = 1.0 / complex(branch.R, speeds[branch.start] * branch.L)
                for node, sign in branch.taken():
                    for other, sign_of_other in branch.taken():
                        if node != other and node in rows and other in unknowns:
                            slope, k = -sign * sign_of_other * y, unknowns[other]
                            yield rows[node], k, slope.real
                            yield rows[node], k + 1, -slope.imag
                            yield rows[node] + 1, k, slope.imag
                            yield rows[node] + 1, k + 1, slope.real

    def solved(self) -> Vector:
        """The unknowns. Raises NoEquilibrium: there is none, or the search does not find it."""
        z = _newton(self.residual, self.first(), self._reach(), self._slopes)
        if z is None:
            each = zip(self.wiring.units, self.laws, strict=True)
            names = ", ".join(f"{unit.name} ({law.law.name})" for unit, law in each)
            raise NoEquilibrium(f"{names}: have no common steady state")
        return z

    def first(self) -> Vector:
        """Where the search begins."""
        first = _first_voltages(self.wiring, self.refs)
        each = zip(self.wiring.units, self.sides, strict=True)
        starts = [side.first(first[unit.node], 1.0) for unit, side in each]
        volts = [[first[node] if node in self.alive else 0.0, 0.0] for node in self.free]
        others = np.zeros(sum(self.sizes[len(starts) + 1 :]))
        return np.concatenate([*starts, np.ravel(volts), others, np.ones(len(self.islands))])

    def voltages(self, z: Vector) -> dict[str, complex]:
        """Of the nodes, p.u."""
        return self._split(z)[1]

    def found(self, z: Vector) -> tuple[list[OperatingPoint], list[tuple[Vector, float]]]:
        """The operating points, and the unknowns and the speed of each component with a source."""
        own, _, speeds = self._split(z)
        each = zip(self.sides, self.wiring.units, own, strict=False)
        points = [side.found(mine, speeds[unit.node]) for side, unit, mine in each]
        parts = zip(own[len(points) :], self.wiring.fed, strict=True)
        return points, [(mine, speeds[one.nodes[0]]) for mine, (_, one) in parts]


def _first_voltages(wiring: Wiring, refs: Sequence[Vector]) -> dict[str, float]:
    """Where the search for the voltage of each node begins, p.u.: at the nominal one, but where
    only converters far below it feed, as at a black start, at theirs."""
    found = dict.fromkeys(wiring.nodes, 1.0)
    stiff = {node for _, one in wiring.fed if one.is_voltage for node in one.nodes}
    stiff |= {wiring.grid} if wiring.grid is not None and wiring.closed else set()
    for nodes in wiring.islands():
        own = [ref[4] for unit, ref in zip(wiring.units, refs, strict=True) if unit.node in nodes]
        if own and not stiff & {*nodes} and max(own) < 0.5:
            found.update(dict.fromkeys(nodes, max(own)))
    return found


def check_dc_side(par: Record, law: DiscreteLaw) -> None:
    """Raise NoEquilibrium: a law's stage integrates v_dc beside a DC source that holds it too."""
    inner, r = law.law.inner, par[0]
    if isinstance(inner, GridFollowingStage) and inner.k_dci > 0.0:
        held = 0 in law.rows if r["i_u_gain"] != 0.0 else r["array"] != ACROSS
        if held:
            raise NoEquilibrium(
                f"{law.law.name}: inner.k_dci = {inner.k_dci:g}: the DC source holds v_dc too;"
                ' it is for one that does not, as plant.dc_source.mode = "array"'
            )


class _ConverterEquilibrium:
    """One converter under its law: unknowns, what must vanish, and what is found.

    The unknowns are the plant's state (8,), the DC current, E_u, and the law's states.
    """

    def __init__(self, par: Record, law: DiscreteLaw, ref: Vector, drop: Drop = no_drop) -> None:
        self.par, self.law, self.ref, self.drop = par, law, ref, drop
        self.controlled, self.across = par[0]["i_u_gain"] != 0.0, par[0]["array"] == ACROSS
        check_dc_side(par, law)
        # row 1's states are left out of a plant whose DC source ignores it
        self.kept = np.array(
            [i for i, row in enumerate(law.rows) if self.controlled or row != 0], dtype=int
        )
        self.size = N_X + 2 + len(self.kept)
        self._steady = np.delete(np.arange(N_X), DELTA)  # delta is steady by omega_u = omega_g
        self._measured = np.array(SENSED)
        self._gain, self._offset = (
            par[0][name][: len(SENSED)].copy() for name in ("gain", "offset")
        )
        n = law.order
        #: u - u_0 and the next state by the state, the references, and what the errors are of
        self._gains = np.zeros((NU + n, n + 3 * NY))
        self._gains[:NU] = np.hstack([law.C, law.D_u0, law.D_r, law.D_y])
        self._gains[NU:, :n], self._gains[NU:, n + NY :] = law.A, np.hstack([law.B_r, law.B_y])
        self._inner, self._map = law.law.inner, ERROR_MAPS[law.law.error_map]
        self._impedance = np.zeros(2)
        self._impedance[: len(law.law.error_parameters)] = law.law.error_parameters

    def first(self, V_g: float, omega_g: float) -> Vector:
        """Where to begin: at the references, with the law's states at zero.

        Raises:
            NoEquilibrium: the line cannot carry P_ref.
        """
        x, u = plant_equilibrium(self.par, self.ref[1], self.ref[4], V_g, omega_g)
        if self.across:  # on the side of the curve where v_dc falls as more power is drawn
            r = self.par[0]
            x[V_DC] = max(1.0, open_circuit_voltage(r, r["irradiance"]))
        return np.concatenate([x, [u[0], u[2]], np.zeros(len(self.kept))])

    def residual(self, z: Vector, V_g: float, omega_g: float, theta: float = 0.0) -> Vector:
        """What must vanish, at a voltage V_g of the line's far end that is ahead by theta, rad."""
        law, inner, ref = self.law, self._inner, self.ref
        if inner is not None and inner.f_pll > 0.0:
            ref = np.array([*ref[:2], omega_g, *ref[3:]])  # the law sees what its PLL measures
        x, u, y, x_law = self._unpack(z, omega_g)
        x[DELTA] -= theta
        u_law, x_next = self._law(x_law, ref, y)
        dx = compiled_f(x, u, np.array([omega_g, V_g]), self.par)
        if self.across:
            r = self.par[0]
            dc = array_current.py_func(r, r["irradiance"], x[V_DC]) - u[0]
        else:
            dc = u_law[0] - u[0] if self.controlled else x[V_DC] - 1.0
        e = self._command(x, u)
        if isinstance(inner, GridFollowingStage):
            i, v = complex(x[0], x[1]), complex(x[2], x[3])
            lack = inner.wanted(ref, y[0], abs(v), omega_g)
            lack -= inner.reference(i, v, e, omega_g) * abs(v) / v
            rest = [y[0] - ref[0] if inner.k_dci > 0.0 else lack.real, lack.imag]
        else:
            E = _internal(law, x, u, e, limited=False)
            rest = [u_law[1] - omega_g, u_law[2] - abs(E)]
        change = (x_next - x_law)[self.kept] / law.T_s
        return np.concatenate([dx[self._steady], [dc, *rest], change])

    def found(self, z: Vector, omega_g: float) -> OperatingPoint:
        """The operating point at the unknowns z. Raises NoEquilibrium: the DC source would need
        another power there than the PV array behind it can give."""
        x, u, y, x_law = self._unpack(z, omega_g)
        if (r := self.par[0])["array"] == BEHIND:
            most, P = most_power.py_func(r, r["irradiance"])[0], u[0] * x[V_DC]
            if not -_LEAST_P <= P <= most + _LEAST_P:
                raise NoEquilibrium(
                    f"{self.law.law.name} rests with {P:.4g} p.u. of the DC source; the PV array"
                    f" behind it gives 0 to {most:.4g} p.u."
                )
        x, u, e = _in_frame_of_law(self.law, x, u, self._command(x, u))
        return OperatingPoint(x, u, y, x_law, e)

    def _unpack(self, z: Vector, omega_g: float) -> tuple[Vector, Vector, Vector, Vector]:
        """The plant's state, its inputs, what the sensors report, and the law's state."""
        x, u = z[:N_X].copy(), np.array([z[N_X], omega_g, z[N_X + 1]])
        y = g(x, u)
        y[self._measured] = self._gain * y[self._measured] + self._offset
        x_law = np.zeros(self.law.order)
        x_law[self.kept] = z[N_X + 2 :]
        return x, u, y, x_law

    def _command(self, x: Vector, u: Vector) -> complex:
        """What the bridge is commanded to give the voltage u[2] on the d axis."""
        i, wanted = complex(x[0], x[1]), complex(u[2])
        e = wanted
        for _ in range(_LOSES):
            before, e = e, wanted + self.drop(i, e)
            if abs(e - before) < _ROUNDING:
                break
        return e

    def _law(self, x: Vector, ref: Vector, y: Vector) -> tuple[Vector, Vector]:
        """The law's u (3,) and next state at held inputs; column 3 sees the plant's omega_u."""
        law, r, measured = self.law, ref.copy(), y.copy()
        map_errors(self._map, self._impedance, r, measured)
        made = self._gains @ np.concatenate([x, ref, r, measured])
        return law.u_0 + made[:NU], made[NU:]

    def no_steady_state(self, grid: str) -> str:
        """The words for: there is no operating point on that grid."""
        cause, r = "", self.par[0]
        if self.across:
            P, v = most_power.py_func(r, r["irradiance"])
            cause = f"; the PV array gives at most {P:.4g} p.u., at v_dc = {v:.4g} p.u."
        if self.controlled and not (self.law.C[0].any() or self.law.D_y[0].any()):
            cause = (
                "; nothing holds v_dc: row 1 answers to no measurement; give it phi.11, or the "
                'plant dc_source.mode = "regulated"'
            )
        return (
            f"{self.law.law.name} has no steady state at P_ref = {self.ref[1]:g} p.u., V_ref = "
            f"{self.ref[4]:g} p.u., {grid}{cause}"
        )


def _no_slopes(z: Vector) -> Iterator[tuple[int, int, float]]:
    return iter(())


def _newton(
    residual: Callable[[Vector], Vector],
    z: Vector,
    reach: Sequence[tuple[set[int], set[int]]] = (),
    known: Callable[[Vector], Iterator[tuple[int, int, float]]] = _no_slopes,
) -> Vector | None:
    """A zero of ``residual`` near z, or None.

    Slopes are measured anew only when a step was not much shorter than the one before it.

    Args:
        residual, z: what must vanish, and where the search begins.
        reach: of each unknown the rows whose slopes are to be measured, and all that it acts on;
            none: each acts on all.
        known: the other slopes at z, by row and unknown.
    """
    rows, columns, of = _measured(reach, len(z))
    nudges = np.zeros((1 + of.max(initial=0), len(z)))
    nudges[of, columns] = _NUDGE
    before, largest = 0.0, math.inf
    step_of: Callable[[Vector], Vector] = np.negative  # none yet: the first round makes it
    for _ in range(_ROUNDS):
        now = residual(z)
        if np.abs(now).max() < _ROUNDING:  # near a dead network steps do not get shorter
            return z
        if not largest < 0.1 * before:
            slopes = (np.array([residual(z + nudge) for nudge in nudges]) - now) / _NUDGE
            more = np.array([*known(z)]).reshape(-1, 3).T
            there = np.concatenate([(rows, columns), more[:2].astype(int)], axis=1)
            values = np.concatenate([slopes[of, rows], more[2]])
            step_of = _steps(there[0], there[1], values, (len(now), len(z)))
        step = step_of(now)
        before, largest = largest, float(np.abs(step).max())
        z = z - step * min(1.0, 0.5 / largest if largest > 0 else 1.0)
        if not np.isfinite(z).all():
            return None
        if largest < 1e-10:
            return z if np.abs(residual(z)).max() <= 1e-5 else None
    return None


def _measured(
    reach: Sequence[tuple[set[int], set[int]]], unknowns: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Of each slope that is measured its row and its unknown, and the group of that; no unknown of
    a group acts on a row that is measured for another one of it."""
    if not reach:
        rows, columns = np.indices((unknowns, unknowns)).reshape(2, -1)
        return rows, columns, columns
    groups: list[tuple[list[int], set[int], set[int]]] = []
    for column, (measured, moved) in enumerate(reach):
        for group, all_measured, all_moved in groups:
            if not (measured & all_moved or moved & all_measured):
                group.append(column)
                all_measured |= measured
                all_moved |= moved
                break
        else:
            groups.append(([column], set(measured), set(moved)))
    places = [(j, c, k) for k, (group, *_) in enumerate(groups) for c in group for j in reach[c][0]]
    rows, columns, of = np.array(places, int).reshape(-1, 3).T
    return rows, columns, of


def _steps(
    rows: NDArray[np.int64], columns: NDArray[np.int64], values: Vector, shape: tuple[int, int]
) -> Callable[[Vector], Vector]:
    """The step of Newton's method by what must vanish, for slopes by row and unknown: of least
    squares, but for a large network whose rows are independent."""
    if shape[0] == shape[1] > _MOST_BY_SQUARES:
        try:
            sparse = scipy.sparse.csc_matrix((values, (rows, columns)), shape)
            return cast(Callable[[Vector], Vector], scipy.sparse.linalg.splu(sparse).solve)
        except RuntimeError:  # a part without a voltage
            pass
    jacobian = np.zeros(shape)
    np.add.at(jacobian, (rows, columns), values)
    inverse = np.linalg.pinv(jacobian, rcond=1e-12)
    return lambda right: np.asarray(inverse @ right)


def _internal(law: DiscreteLaw, x: Vector, u: Vector, e: complex, limited: bool = True) -> complex:
    """The law's E for a bridge at a steady command e: with an inner stage another voltage, behind
    it."""
    inner = law.law.inner
    if inner is None:
        return e
    if not limited:
        inner = inner.model_copy(update={"I_max": math.inf})
    i, v, i_o = (complex(x[k], x[k + 1]) for k in (0, 2, 4))
    try:
        return inner.internal_voltage(i, v, i_o, e, float(u[1]))
    except LawError as problem:
        raise NoEquilibrium(str(problem)) from None


def _in_frame_of_law(
    law: DiscreteLaw, x: Vector, u: Vector, e: complex
) -> tuple[Vector, Vector, complex]:
    """The state, the law's output and the bridge's command, turned so that E lies on the d axis."""
    E = _internal(law, x, u, e)
    turn = E.conjugate() / abs(E)
    turned = x.copy()
    for k in (0, 2, 4):
        w = complex(x[k], x[k + 1]) * turn
        turned[k : k + 2] = w.real, w.imag
    turned[DELTA] += cmath.phase(E)
    return turned, np.array([u[0], u[1], abs(E)]), e * turn
