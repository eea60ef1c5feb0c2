"""The closed loop of a network: all its converters, each under its law, around their common
operating point.

The circuit is the one that the plant solves: ``gfm_plant.wiring`` gives its modes, and here each of
them is two states, its real and its imaginary part. What a converter adds, its DC link, DC source
and sensors, is that of ``linearise_plant``, since these see the currents and voltages in the
converter's own frame, whatever the network is. Machines, a finite grid and loads of constant power
have the states that the plant gives them.

A turn of a whole island changes nothing in it. Its angles are therefore those against a reference:
the grid, else the island's first converter, else its first machine. The angle of the reference
itself acts on nothing and is no state of the loop.

Each converter has its view of the network: a ``ClosedLoop`` whose plant is the network with all
other converters under their laws. Its margins and its gamma are those of the network.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import eig

from gfm_design.model.closed_loop import (
    GONE,
    INPUTS,
    ClosedLoop,
    LinearLoop,
    Matrix,
    Response,
    response,
)
from gfm_design.model.inner import LinearStage, linearise_stage
from gfm_design.model.linear import (
    LinearLaw,
    LinearPlant,
    Mode,
    delay_lines,
    linearise_law,
    linearise_plant,
    sampled_plant,
)
from gfm_design.model.operating_point import OperatingPoint, operating_points
from gfm_design.norms.performance import StateSpace
from gfm_plant import Network
from gfm_plant.components.finite_grid import FiniteGrid
from gfm_plant.components.part import Fed, LinearPart
from gfm_plant.components.swing import SWING_PARAMETERS, swing_matrix
from gfm_plant.model import V_DC
from gfm_plant.records import N_OWN
from gfm_plant.wiring import GRID_SOURCE
from gfm_runtime.signals import NU, NU_INNER, NY, NY_INNER
from gfm_runtime.tustin import OMEGA_COLUMN, OMEGA_ROW, DiscreteLaw

Complex = NDArray[np.complex128]

GRID, LINES = "the grid", "lines and loads"
"""The parts of a network that take part in modes besides converters, machines and loads of constant
power."""

_SAME = 1e-6  # poles closer than this times (1 1/s + |s|) are equal: those of identical converters
_D = INPUTS[NY:]


@dataclass(frozen=True)
class NetworkMode(Mode):
    """A mode of a network."""

    #: of each part, largest first; they add up to 1. That of a part is |sum of l_i r_i| over the
    #: states i of the part, with the mode's left and right eigenvectors l and r, divided by the sum
    #: over all parts (Pérez-Arriaga, Verghese and Schweppe, 1982). It does not depend on the
    #: coordinates that describe the part.
    participation: Mapping[str, float] = field(default_factory=dict)
    #: its shape: how far, and with which phase, the angle and so the speed of each converter and
    #: machine swings, by its name, of the largest one; empty if other modes have the same pole
    shape: Mapping[str, complex] = field(default_factory=dict)

    def plain(self) -> dict[str, Any]:
        """As ``Mode.plain``, with participation and shape, the latter as [size, degrees]."""
        shape = {name: [abs(z), float(np.degrees(np.angle(z)))] for name, z in self.shape.items()}
        return super().plain() | {"participation": dict(self.participation), "shape": shape}


@dataclass(frozen=True)
class LinearConverter:
    """A converter of the network."""

    name: str  #: its own
    title: str  #: its name and that of its law
    #: law, stage: around the operating point
    law: LinearLaw
    stage: LinearStage | None
    op: OperatingPoint  #: the operating point
    ref: Matrix  #: the references, shape (5,), p.u.
    #: u, y: its places among the commands and the measurements of all
    u: slice
    y: slice

    @cached_property
    def controller(self) -> LinearLaw:
        """The law, and the inner stage if any, from the measurements to the commands."""
        return self.law if self.stage is None else self.stage.around(self.law)

    @property
    def reads(self) -> list[tuple[int, int]]:
        """Places of its omega_u among all commands and measurements, if a PLL reads it."""
        pll = self.stage is not None and self.stage.has_pll
        return [(self.u.start + OMEGA_ROW, self.y.start + OMEGA_COLUMN)] if pll else []


@dataclass(frozen=True)
class LinearNetwork:
    """The network without its controllers: continuous, in deviations from its operating point."""

    #: with the commands and the measurements of all converters one after the other; C_true is (5 N,
    #: n). Its last states are the angles of the islands' references.
    plant: LinearPlant
    #: what a turn of each island by 1 rad does to the other states, (n - r, r) for r islands
    turn: Matrix
    #: the names of the parts, and of each state of ``own`` the place of its part there, (n,)
    parts: tuple[str, ...]
    owner: NDArray[np.intp]
    #: own, from_own: the states, with absolute angles here, as those that belong to one part each:
    #: currents and voltages of the circuit in place of its modes; and back, both (n, n)
    own: Matrix
    from_own: Matrix
    #: by the name of each part that turns, where its angle is among the states
    angles: dict[str, int]
    #: by each node with a capacitor what a current into it does to the states, (n, 2), and its
    #: voltage by these, (2, n), both in the frame of its island
    nodes: dict[str, tuple[Matrix, Matrix]]

    @property
    def references(self) -> slice:
        """Where the angles of the references are among the states."""
        return slice(len(self.turn), sum(self.turn.shape))


class NetworkLoop(LinearLoop):
    """All converters of a network under their laws, sampled, around their operating point.

    Args:
        network: without its controllers.
        members: its converters.
        T_s: sampling time, s.
        u_delay: of each command, from the tick that samples y to the moment when it acts, s.
    """

    _what = "network"
    T_s: float

    def __init__(
        self,
        network: LinearNetwork,
        members: Sequence[LinearConverter],
        T_s: float,
        u_delay: Matrix,
    ) -> None:
        self.network, self.members, self.T_s = network, tuple(members), T_s
        self.u_delay, self.y_delay = u_delay, np.zeros(len(network.plant.C))

    @classmethod
    def of(
        cls,
        plant: Network,
        laws: Sequence[DiscreteLaw],
        references: Sequence[Sequence[float] | Matrix],
    ) -> Self:
        """The loop of a network as it is when a run starts.

        Args:
            plant: fresh from ``gfm_plant.make_network``; it stays as it is.
            laws: of each converter.
            references: of each, (V_dcref, P_ref, omega_g, Q_ref, V_ref), p.u.

        Raises:
            NoEquilibrium: there is no operating point, or a limit of an inner stage acts there.
        """
        refs = [np.asarray(ref, float) for ref in references]
        points, components, voltages = operating_points(plant, laws, refs)
        steady = plant.copy()
        x, u = (np.array([getattr(op, name) for op in points]) for name in ("x", "commands"))
        steady.start(x, u, components, voltages)
        T_s = float(plant.net[0]["T_s"])
        members, delays, at_u, at_y = list[LinearConverter](), list[float](), 0, 0
        each = zip(plant.wiring.units, plant.par, laws, refs, points, strict=True)
        for unit, r, law, ref, op in each:
            inner = law.law.inner
            stage = linearise_stage(inner, T_s, float(r["omega_b"]), op) if inner else None
            linear = linearise_law(law.law, law, op, ref, bool(r["i_u_gain"] != 0.0))
            n_u, n_y = (NU, NY) if stage is None else (NU_INNER, NY_INNER)
            places = slice(at_u, at_u + n_u), slice(at_y, at_y + n_y)
            title = f"{unit.name} ({law.law.name})"
            members.append(LinearConverter(unit.name, title, linear, stage, op, ref, *places))
            delays += [float(r["delay"] + r["fraction"]) * T_s] * n_u
            at_u, at_y = at_u + n_u, at_y + n_y
        return cls(_Writing(steady, members).written(), members, T_s, np.array(delays))

    def __repr__(self) -> str:
        titles = ", ".join(member.title for member in self.members)
        return f"<{type(self).__name__} {titles}, T_s = {self.T_s:g} s, A {self.A.shape}>"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the converters."""
        return tuple(member.name for member in self.members)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs, the references of each converter as A.P_ref and the grid's."""
        return (*(f"{m.name}.{ref}" for m in self.members for ref in INPUTS[:NY]), *_D)

    def converter(self, name: str) -> ClosedLoop:
        """The loop of one converter, whose plant is the network with all others under their laws.

        Raises:
            ValueError: no such converter.
        """
        if name not in self.names:
            raise ValueError(f"{name!r} is no converter of the network; use one of {self.names}")
        place = self.names.index(name)
        one, whole = self.members[place], self._steady(self.network.plant)
        around = Surroundings(self, place)
        delays = self.u_delay[one.u], self.y_delay[one.y]
        plant = around.seen(whole)
        return ClosedLoop(plant, one.law, self.T_s, *delays, stage=one.stage, around=around)

    # matrices

    def held(self, u_delay: Matrix, y_delay: Matrix) -> LinearPlant:
        """The network from tick to tick with its delay lines, without controllers; the angles of
        the references are still among the states.

        Args:
            u_delay, y_delay: of each command and each measurement, s.
        """
        reads = [pair for member in self.members for pair in member.reads]
        return sampled_plant(self.network.plant, self.T_s, u_delay, y_delay, reads)

    @cached_property
    def _held(self) -> LinearPlant:
        return self.held(self.u_delay, self.y_delay)

    @cached_property
    def A(self) -> Matrix:
        """The loop's matrix, shape (n, n)."""
        return _closed(self._steady(self._held), self.members)

    @cached_property
    def state_space(self) -> StateSpace:
        """(A, B, C, D) from ``inputs`` to y = (v_dc, p, omega_u, q, V) of each converter, one after
        the other, before the sensors."""
        p, A = self._steady(self._held), self.A
        n, N = len(p.A), len(self.members)
        B, C = np.zeros((len(A), NY * N + len(_D))), np.zeros((NY * N, len(A)))
        D = np.zeros((NY * N, B.shape[1]))
        B[:n, NY * N :], C[:, :n] = p.B_d, p.C_true
        for k, (m, own) in enumerate(zip(self.members, _states(n, self.members), strict=True)):
            c, refs, speed = m.controller, slice(NY * k, NY * (k + 1)), NY * k + OMEGA_COLUMN
            B[:n, refs], B[own, refs] = p.B[:, m.u] @ c.D_r, c.B_r
            C[speed, :n], C[speed, own] = c.D[OMEGA_ROW] @ p.C[m.y], c.C[OMEGA_ROW]
            D[speed, refs] = c.D_r[OMEGA_ROW]
        return A, B, C, D

    def _steady(self, plant: LinearPlant) -> LinearPlant:
        """The plant without the angles of the references, on which nothing depends."""
        kept = np.delete(np.arange(len(plant.A)), self.network.references)
        A, B, B_d = plant.A[np.ix_(kept, kept)], plant.B[kept], plant.B_d[kept]
        return LinearPlant(A, B, B_d, plant.C[:, kept], plant.C_true[:, kept])

    # results

    def modes(self) -> list[NetworkMode]:
        """The modes and the parts that take part in each, the largest sigma first.

        The eigenvectors of equal poles are not determined: all of them get
        the participation of their common eigenspace.
        """
        values, left, right = eig(self.A, left=True, right=True)
        there = np.abs(values) > GONE
        values, left, right = values[there], left[:, there], right[:, there]
        s = np.log(values) / self.T_s
        found, done = list[NetworkMode](), s.imag < 0.0
        for k in range(len(s)):
            if done[k]:
                continue
            equal = np.abs(s - s[k]) <= _SAME * (1.0 + abs(s[k]))
            r, rows = right[:, equal], left[:, equal].conj().T
            states = self._absolute(values[k], r)
            shares = self._participation(np.linalg.solve(rows @ r, rows), r, states)
            shape = _shape(states, self.network.angles) if equal.sum() == 1 else {}
            modes = [Mode.of(one) for one in s[equal & ~done]]
            found += [NetworkMode(m.sigma, m.frequency_hz, shares, shape) for m in modes]
            done |= equal
        return sorted(found, key=lambda mode: -mode.sigma)

    def _absolute(self, z: complex, right: Complex) -> Complex:
        """The states of the network, with absolute angles, in columns of right eigenvectors of
        z."""
        turning = self.network.references
        drift = np.delete(self._drift, turning, axis=1)
        by_turn = drift @ right / (z - 1.0) if abs(z - 1.0) > 1e-12 else 0.0 * (drift @ right)
        own = right[: turning.start] + self.network.turn @ by_turn
        return np.concatenate([own, by_turn])

    def _participation(self, left: Complex, right: Complex, states: Complex) -> dict[str, float]:
        """The share of each part, from rows of left and columns of right eigenvectors, and the
        states of the latter with absolute angles."""
        network, n = self.network, self.network.references.start
        rows = np.hstack([left[:, :n], -left[:, :n] @ network.turn])
        shares = np.zeros(len(network.parts), complex)
        each = (rows @ network.from_own) * (network.own @ states).T
        np.add.at(shares, network.owner, each.sum(0))
        np.add.at(shares, self._owners, (left[:, n:] * right[n:].T).sum(0))
        sizes = np.abs(shares) / np.abs(shares).sum()
        order = np.argsort(-sizes, kind="stable")
        return {network.parts[k]: float(sizes[k]) for k in order}

    @cached_property
    def _drift(self) -> Matrix:
        """The rows of the closed loop that give the references' angles at the next tick."""
        return _closed(self._held, self.members)[self.network.references]

    @cached_property
    def _owners(self) -> list[int]:
        """The place of the converter that each state behind those of ``network`` belongs to."""
        lines = delay_lines(self.network.plant, self.T_s, self.u_delay, self.y_delay)
        of_u = [m.name for m in self.members for _ in range(m.u.start, m.u.stop)]
        of_y = [m.name for m in self.members for _ in range(m.y.start, m.y.stop)]
        each = zip([*of_u, *of_y], lines, strict=True)
        owners = [name for name, line in each for _ in range(line.start, line.stop)]
        owners += [m.name for m in self.members for _ in m.reads]
        owners += [m.name for m in self.members for _ in m.controller.A]
        places = {name: k for k, name in enumerate(self.network.parts)}
        return [places[name] for name in owners]

    def step_response(self, of: str, seconds: float = 1.0) -> tuple[Matrix, dict[str, Matrix]]:
        """(t, y of each converter by its name) after a unit step of one of ``inputs``.

        t (K,) is every tick, s; y (K, 5) = (v_dc, p, omega_u, q, V) are deviations in p.u. of the
        converter, before its sensors, and exact.

        Raises:
            ValueError: no such input.
        """
        t, y = self._step(of, self.inputs, seconds, self.T_s)
        each = np.split(y, len(self.members), axis=1)
        return t, dict(zip(self.names, each, strict=True))

    def frequency_response(self, omega: ArrayLike) -> Response:
        """From ``inputs`` to y of all converters at omega [rad/s] (K,), shape (K, 5 N, 5 N + 2)."""
        return response(self.state_space, self._at(omega))


@dataclass(frozen=True)
class Surroundings:
    """The network around one converter, all others under their laws."""

    loop: NetworkLoop
    place: int

    @property
    def name(self) -> str:
        """That of the converter, and of its law."""
        return self.loop.members[self.place].title

    @property
    def op(self) -> OperatingPoint:
        return self.loop.members[self.place].op

    @property
    def ref(self) -> Matrix:
        return self.loop.members[self.place].ref

    def held(self, u_delay: Matrix, y_delay: Matrix) -> LinearPlant:
        """The network from tick to tick as the converter meets it; its delays as for a loop."""
        loop, one = self.loop, self.loop.members[self.place]
        p = loop._steady(loop.held(*self._of_all(u_delay, y_delay)))
        A = _closed(p, [m for m in loop.members if m is not one])
        more = ((0, len(A) - len(p.A)), (0, 0))
        B, B_d = np.pad(p.B, more), np.pad(p.B_d, more)
        C, C_true = (np.pad(m, more[::-1]) for m in (p.C, p.C_true))
        return self.seen(LinearPlant(A, B, B_d, C, C_true))

    def lines(self, u_delay: Matrix, y_delay: Matrix) -> list[slice]:
        """Where the delay line of each u, then of each y, of the converter is there."""
        loop, one = self.loop, self.loop.members[self.place]
        gone = len(loop.network.plant.A) - len(loop.network.turn)
        lines = delay_lines(loop.network.plant, loop.T_s, *self._of_all(u_delay, y_delay))
        own = lines[one.u] + lines[len(loop.u_delay) :][one.y]
        return [slice(line.start - gone, line.stop - gone) for line in own]

    def _of_all(self, u_delay: Matrix, y_delay: Matrix) -> tuple[Matrix, Matrix]:
        """The delays of all converters, of this one as given."""
        loop, one = self.loop, self.loop.members[self.place]
        u, y = loop.u_delay.copy(), loop.y_delay.copy()
        u[one.u], y[one.y] = u_delay, y_delay
        return u, y

    def seen(self, p: LinearPlant) -> LinearPlant:
        """A plant of all with the commands and measurements of this converter alone."""
        one, own = self.loop.members[self.place], slice(NY * self.place, NY * (self.place + 1))
        return LinearPlant(p.A, p.B[:, one.u], p.B_d, p.C[one.y], p.C_true[own])


def _shape(states: Complex, angles: Mapping[str, int]) -> dict[str, complex]:
    """How the angles swing in one mode, of the largest one."""
    each = {name: complex(states[at, 0]) for name, at in angles.items()}
    largest = max(each.values(), key=abs)
    return {name: z / largest for name, z in each.items()} if largest else {}


def _states(n: int, members: Sequence[LinearConverter]) -> list[slice]:
    """Where the states of each controller are, behind n of the plant."""
    ends = n + np.cumsum([0, *(len(m.controller.A) for m in members)])
    return [slice(int(a), int(b)) for a, b in pairwise(ends)]


def _closed(p: LinearPlant, members: Sequence[LinearConverter]) -> Matrix:
    """The matrix of a sampled plant with the loops of some converters closed."""
    n, places = len(p.A), _states(len(p.A), members)
    A = np.zeros((places[-1].stop,) * 2) if places else np.zeros((n, n))
    A[:n, :n] = p.A
    for m, own in zip(members, places, strict=True):
        c, B, C = m.controller, p.B[:, m.u], p.C[m.y]
        A[:n, :n] += B @ c.D @ C
        A[:n, own], A[own, :n], A[own, own] = B @ c.C, c.B @ C, c.A
    return A


class _Writing:
    """The matrices of a network in steady state, as ``Network.start`` leaves it, being written.

    The states are the modes of the circuit, their real parts and then their imaginary parts; of
    each converter its angle and what ``linearise_plant`` has from v_dc on; of each machine angle,
    speed and power of the turbines; of a finite grid the same, of an ideal one the angle; of each
    load of constant power the two parts of the voltage that it has measured. Each island is seen
    from a frame that turns at its steady speed.
    """

    def __init__(self, plant: Network, members: Sequence[LinearConverter]) -> None:
        wiring, now, N = plant.wiring, plant.now[0], len(members)
        self.plant, self.members, self.omega_b = plant, members, wiring.omega_b
        self.modes, self.sources = wiring.modes(wiring.blocked, None)
        self.w = now["w"][: len(wiring.order)]
        fed = [item for item in plant.fed() if item[1].is_voltage or item[0] not in wiring.opened]
        # the rotor of a motor turns at another speed than its island
        turning = [item for item in fed if "leads" in item[2].dtype.names]
        at_node = {m.name: unit.node for m, unit in zip(members, wiring.units, strict=True)}
        at_node |= {name: one.nodes[0] for name, one, _ in turning}
        speeds = [float(m.op.u[OMEGA_ROW]) for m in members]
        speeds += [float(record["omega"]) for *_, record in turning]
        if wiring.grid is not None and wiring.closed:
            at_node[GRID] = wiring.grid
            speeds.append(float(now["omega_g"]))
        #: of each part that turns: its island; its angle is its first state
        self.islands = wiring.islands()
        self.island = {name: self._island(node) for name, node in at_node.items()}
        self.speed = np.ones(len(self.islands))  # p.u.; that of a dead one does not matter
        self.speed[list(self.island.values())] = speeds
        #: of each component with a source
        self.fed = {name: self._linear(one, record) for name, one, record in fed}
        self.at_w = {name: np.atleast_1d(record["sees"]) for name, _, record in fed}
        self.fed_sources = {name: one.sources(name) for name, one, _ in fed}
        self.fed_island = {name: self._island(one.nodes[0]) for name, one, _ in fed}
        sizes = {m.name: 1 + len(self._alone(k).A) - V_DC for k, m in enumerate(members)}
        sizes[GRID] = 3 if len(plant.of(FiniteGrid)) else 1
        sizes |= {name: len(part.A) for name, part in self.fed.items()}
        owners = dict.fromkeys([*at_node, *self.fed])  # currents behind what turns
        ends = 2 * len(self.modes.rates) + np.cumsum([0, *(sizes[name] for name in owners)])
        self.z = slice(0, int(ends[0]))
        self.at = {
            n: slice(int(a), int(b)) for n, (a, b) in zip(owners, pairwise(ends), strict=True)
        }
        of_w = {name: (u.name, u.node) for u in wiring.units for name in u.states}
        of_w |= {branch.name: (LINES, branch.start) for branch in wiring.branches}
        of_w |= {bank.name: (LINES, bank.node) for bank in wiring.capacitors}
        of_w |= {branch.name: (branch.name, branch.end) for branch in wiring.fed_branches}
        self.owner_of_w = [of_w[name][0] for name in wiring.order]
        self.island_of_w = np.array([self._island(of_w[name][1]) for name in wiring.order])
        self.n = int(ends[-1])
        self.A, self.B_d = np.zeros((self.n, self.n)), np.zeros((self.n, len(_D)))
        self.B = np.zeros((self.n, members[-1].u.stop))
        self.C, self.C_true = np.zeros((members[-1].y.stop, self.n)), np.zeros((NY * N, self.n))

    def _island(self, node: str) -> int:
        there = {unit.terminal: unit.node for unit in self.plant.wiring.units}.get(node, node)
        return next(k for k, nodes in enumerate(self.islands) if there in nodes)

    def _linear(self, one: Fed, record: Any) -> LinearPart:
        """A component with a source around its steady state."""
        slip = self.omega_b * (self.speed[self._island(one.nodes[0])] - 1.0)
        source = complex(self.plant.now[0]["unit"][record["source"]])
        source *= complex(record["E"]) if one.is_voltage else 0.0
        seen = self.w[record["sees"]].tolist()
        return one.linear(record, seen, source, slip, self.omega_b)

    def _alone(self, k: int) -> LinearPlant:
        """Converter k on a line to a grid: its DC link, DC source and sensors are those here."""
        op, inner = self.members[k].op, self.members[k].stage is not None
        return linearise_plant(self.plant.par[k : k + 1], op, float(op.u[OMEGA_ROW]), inner=inner)

    def written(self) -> LinearNetwork:
        net, now = self.plant.net[0], self.plant.now[0]
        slip = self.omega_b * (self.speed[self.island_of_w] - 1.0)
        turns = self.modes.modes @ (1j * slip[:, None] * self.modes.states)
        self.A[self.z, self.z] = _real(np.diag(self.modes.rates) - turns)
        for k, member in enumerate(self.members):
            self._converter(k, member)
        if GRID in self.at:
            V_g, to_grid = float(now["V_g"]), net["to_grid"][: len(self.w)]
            unit = complex(now["unit"][len(self.members)])
            self.B_d[self.z, 1] = _parts(self._source(GRID_SOURCE, GRID, V_g, unit))
            angle, finite = self.at[GRID].start, self.plant.of(FiniteGrid)
            if len(finite):
                own, per_power = swing_matrix(*(float(finite[0][x]) for x in SWING_PARAMETERS))
                power = V_g * unit.conjugate() * (to_grid @ self.w)
                by_z = V_g * unit.conjugate() * (to_grid @ self.modes.states)
                self.A[angle, angle + 1] = self.omega_b
                self.A[angle + 1, self.z] = per_power * _rows(by_z)[0]
                self.A[angle + 1, angle] = per_power * power.imag
                self.A[angle + 1 : angle + 3, angle + 1 : angle + 3] = own
                self.B_d[angle + 1, 1] = per_power * power.real / V_g
            else:
                self.B_d[angle, 0] = self.omega_b
        for name, part in self.fed.items():
            at, seen = self.at[name], _real(self.modes.states[self.at_w[name]])
            drive = self.modes.drive[:, [self.sources.index(s) for s in self.fed_sources[name]]]
            self.A[at, at], self.A[at, self.z] = part.A, part.by_seen @ seen
            self.A[self.z, at] = _real(drive) @ part.source
            self.A[self.z, self.z] += _real(drive) @ part.direct @ seen
        return self._against_references()

    def _source(self, source: str, part: str, e: complex, unit: complex) -> Complex:
        """Write what the angle of a source of voltage e in its own frame, which is at ``unit``,
        does to the circuit; returns what a voltage along its d axis does to the modes."""
        by_e = self.modes.drive[:, self.sources.index(source)] * unit
        self.A[self.z, self.at[part].start] = _parts(1j * e * by_e)
        return np.asarray(by_e)

    def _converter(self, k: int, member: LinearConverter) -> None:
        alone, r, own = self._alone(k), self.plant.par[k], self.at[member.name]
        unit = complex(self.plant.now[0]["unit"][k])
        by_e = self._source(self.plant.wiring.units[k].bridge, member.name, member.op.e, unit)
        for j, axis in enumerate((1.0, 1j)[: len(range(member.u.start + 2, member.u.stop))]):
            self.B[self.z, member.u.start + 2 + j] = _parts(axis * by_e)
        self.B[own.start, member.u.start + OMEGA_ROW] = self.omega_b
        # the states that the converter alone has, by those here
        seen = np.zeros((len(alone.A), self.n))
        back = unit.conjugate()
        for j, scale in enumerate((r["current"], 1.0, r["current"])):
            rows = slice(2 * j, 2 * j + 2)
            seen[rows, self.z] = _rows(scale * back * self.modes.states[N_OWN * k + j])
            seen[rows, own.start] = _parts(-1j * np.array([complex(*member.op.x[rows])]))
        behind = slice(own.start + 1, own.stop)  # the angle
        seen[V_DC:, behind] = np.eye(len(alone.A) - V_DC)
        self.A[behind] = alone.A[V_DC:] @ seen
        self.B[behind, member.u] = alone.B[V_DC:]
        self.C[member.y], self.C_true[NY * k : NY * (k + 1)] = alone.C @ seen, alone.C_true @ seen

    def _against_references(self) -> LinearNetwork:
        """Angles against those of the islands' references, which come last."""
        references, turns = list[int](), list[Matrix]()
        for k in range(len(self.islands)):
            those = [name for name, island in self.island.items() if island == k]
            if not those:
                continue  # nothing turns in a dead part
            reference = GRID if GRID in those else those[0]
            references.append(self.at[reference].start)
            r = np.zeros(self.n)
            r[[self.at[name].start for name in those]] = 1.0
            r[self.z] = _parts(1j * self.modes.modes @ (self.w * (self.island_of_w == k)))
            for name, part in self.fed.items():
                if self.fed_island[name] == k:
                    r[self.at[name]] = part.turn
            turns.append(r)
        kept = np.delete(np.arange(self.n), references)
        order, turn = np.concatenate([kept, references]), np.array(turns).T[kept]
        A, B, B_d = (m[order] for m in (self.A, self.B, self.B_d))
        A, last = A[:, order], slice(len(kept), self.n)
        for m in (A, B, B_d):
            m[: len(kept)] -= turn @ m[last]
        C, C_true = self.C[:, order], self.C_true[:, order]
        for m in (A, C, C_true):
            m[:, last] = 0.0  # but for rounding
        names = [*self.at, LINES]
        if GRID in names and not len(self.plant.of(FiniteGrid)):
            names.remove(GRID)  # an ideal grid takes part in nothing
        at = order.tolist()
        angles = {name: at.index(self.at[name].start) for name in self.island if name in names}
        plant = LinearPlant(A, B, B_d, C, C_true)
        owned = self._own(names, order)
        nodes = {}
        for bank in self.plant.wiring.capacitors:
            k, z = self.plant.wiring.order.index(bank.name), self.modes.modes
            by_i, v = np.zeros((self.n, 2)), np.zeros((2, self.n))
            by_i[self.z, 0] = _parts(self.omega_b / bank.C * z[:, k])
            by_i[self.z, 1] = _parts(1j * self.omega_b / bank.C * z[:, k])
            v[:, self.z] = _rows(self.modes.states[k])
            v = v[:, order]
            v[:, last] += v[:, : len(kept)] @ turn
            nodes[bank.node] = by_i[order], v
        return LinearNetwork(plant, turn, tuple(names), *owned, angles, nodes)

    def _own(
        self, names: Sequence[str], order: NDArray[np.intp]
    ) -> tuple[NDArray[np.intp], Matrix, Matrix]:
        """Of which part each state is that belongs to one; these by all in their ``order``; and
        all by these. An ideal grid is none of the parts: its angle is left out."""
        n_z, n_w = self.z.stop, 2 * len(self.owner_of_w)
        owners = [*self.owner_of_w, *self.owner_of_w]
        owners += [name for name, at in self.at.items() for _ in range(at.start, at.stop)]
        own, back = np.zeros((len(owners), self.n)), np.zeros((self.n, len(owners)))
        own[:n_w, :n_z], back[:n_z, :n_w] = _real(self.modes.states), _real(self.modes.modes)
        own[n_w:, n_z:] = back[n_z:, n_w:] = np.eye(self.n - n_z)
        kept = np.array([k for k, owner in enumerate(owners) if owner in names])
        places = np.array([names.index(owners[k]) for k in kept])
        return places, own[np.ix_(kept, order)], back[np.ix_(order, kept)]


def _parts(v: Complex) -> Matrix:
    """Real parts, then imaginary parts."""
    return np.concatenate([v.real, v.imag])


def _rows(v: Complex) -> Matrix:
    """Real and imaginary part of v @ z as rows over the parts of z."""
    return np.array([np.concatenate([v.real, -v.imag]), np.concatenate([v.imag, v.real])])


def _real(M: Complex) -> Matrix:
    """A complex matrix as one over the parts."""
    return np.block([[M.real, -M.imag], [M.imag, M.real]])
