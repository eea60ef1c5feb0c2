"""How converters, lines, loads and the grid are connected, and the circuits that this gives.

A wiring never changes: an event makes another one. Elements are in p.u. of the network.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, wraps
from types import MappingProxyType
from typing import Concatenate, ParamSpec, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from gfm_plant.circuit import (
    GROUND,
    Branch,
    Capacitor,
    Circuit,
    CurrentSource,
    Modes,
    Rates,
    Shunt,
    VoltageSource,
    find_modes,
    find_rates,
    find_voltage,
    join_axes,
    rest,
    without_ends,
)
from gfm_plant.components.grid_following import GridFollowing
from gfm_plant.components.part import Fed, Terminal, emf
from gfm_plant.contacts import zero_circuit
from gfm_plant.names import FAULTED_PHASES

GRID_SOURCE = "grid"
CONTACT = "contact"  # the branch through which a zero sequence lets a fault, or the grid, conduct
ALPHA, BETA = 0, 1
"""The axes of an unbalanced fault: that of the phase which differs from the others, and across."""

P = ParamSpec("P")
R = TypeVar("R")


@dataclass(frozen=True)
class ConverterCircuit:
    """A converter as the circuit sees it: bridge, filter, and the line to its node."""

    name: str
    node: str  # where its line ends
    # L_f, R_f, C_f, L_g, R_g: elements of Eq. (1)-(6), p.u. of the network
    L_f: float
    R_f: float
    C_f: float
    L_g: float
    R_g: float
    earthed: str = ""  # of the line, as of a `Branch`
    at_end: bool = False  # whether the connection point is there and not at the filter capacitor

    @property
    def terminal(self) -> str:
        """The node of the filter capacitor."""
        return self.terminal_of(self.name)

    @staticmethod
    def terminal_of(name: str) -> str:
        """That of the converter of this name."""
        return f"{name}.terminal"

    @property
    def connection(self) -> str:
        """The node of the connection point."""
        return self.node if self.at_end else self.terminal

    @property
    def bridge(self) -> str:
        """The node, and the source, of the bridge."""
        return f"{self.name}.bridge"

    @property
    def states(self) -> tuple[str, str, str]:
        """Names of its currents and its voltage, in the order of w."""
        return f"{self.name}.i_f", f"{self.name}.v", self.line

    @property
    def line(self) -> str:
        """The name of its line."""
        return f"{self.name}.i_o"


@dataclass(frozen=True, kw_only=True)
class Contact:
    """Which phases conduct where they do not always do: those of a fault to ground, or the poles of
    a breaker between its two sides."""

    kind: str = "3ph"  # a key of `FAULTED_PHASES`
    phases: str = "abc"  # one of that kind
    clearing: str = "zero"  # of `CLEARINGS`
    # of a fault from each phase to ground, of kind LL from one phase to the other; p.u. of the
    # network
    R: float = 0.0

    @property
    def balanced(self) -> bool:
        """Whether it is the same in all three phases."""
        return self.kind == "3ph"

    @property
    def angle(self) -> float:
        """The axis of the phase that differs, rad."""
        return 2 * math.pi / 3 * FAULTED_PHASES[self.kind].index(self.phases)

    def opened(self, phase: str, zero_sequence: bool) -> Self | None:
        """What is left where the current of a phase has been interrupted; None: nothing.

        Args:
            zero_sequence: whether it has a path. Without one, one phase carries nothing.
        """
        left = self.phases.replace(phase, "")
        if self.kind == "LL" or not left or (len(left) == 1 and not zero_sequence):
            return None
        kind = "LG" if len(left) == 1 else "LLG" if zero_sequence else "LL"
        return replace(self, kind=kind, phases="ca" if left == "ac" else left)

    def phase_current(self, phase: str) -> tuple[float, float]:
        """The current of a phase as factors of those on the two axes.

        A zero sequence comes with them: i_0 = i_alpha / 2 for LG, -i_alpha for LLG.
        """
        if phase not in self.phases:
            return 0.0, 0.0
        behind = 2 * math.pi / 3 * "abc".index(phase) - self.angle
        zero = {"LG": 0.5, "LLG": -1.0}.get(self.kind, 0.0)
        return math.cos(behind) + zero, math.sin(behind)

    def seen(self, axis: int, Z_0: complex | None) -> complex | None:
        """The impedance that it puts into the circuit of an axis, p.u.; None: nothing flows there.

        It follows from Clarke's transform of the currents and voltages, with v_0 = -Z_0 i_0. LG,
        phase a: v_alpha + v_0 = R i_a, i_b = i_c = 0. LL, b to c: i_a = 0, i_b = -i_c,
        v_b - v_c = R i_b. LLG, b and c: i_a = 0, v_b = R i_b, v_c = R i_c.

        Args:
            Z_0: impedance of the zero sequence's path; None: it has none, and no current.
        """
        match self.kind, axis:
            case "LG", 0:
                return None if Z_0 is None else 1.5 * self.R + 0.5 * Z_0
            case "LLG", 0:
                return None if Z_0 is None else 3 * self.R + 2 * Z_0
            case "LL", 1:
                return complex(self.R / 2)
            case ("3ph", _) | ("LLG", 1):
                return complex(self.R)
        return None


@dataclass(frozen=True, kw_only=True)
class FaultPlace(Contact):
    """A fault: where phases are shorted, which, and through what."""

    node: str  # the node, or the one at which the faulted branch starts
    branch: str | None  # name of the branch with the fault inside, or None: at the node itself
    position: float  # on that branch, in (0, 1)
    # R + jX of the zero sequence's path, p.u. of the network; None: that of the lines to the grid,
    # see `Wiring.zero_sequence`
    Z_0: complex | None = None


@dataclass(frozen=True, kw_only=True)
class OpeningBreaker(Contact):
    """The poles of an open breaker that still conduct, each until its current passes zero."""

    name: str  # of its branch, or GRID_SOURCE


@dataclass(frozen=True)
class Check:
    """The synchro-check of an open breaker."""

    name: str  # of the breaker; "" for that of the grid
    sides: tuple[str, str]  # the nodes at its two ends, or GRID_SOURCE for the grid itself


def _once(method: Callable[Concatenate[Wiring, P], R]) -> Callable[Concatenate[Wiring, P], R]:
    """A method that works out once what it is asked again and again: an event has many circuits
    alike, and the loop waits for it."""

    @wraps(method)
    def call(self: Wiring, /, *args: P.args, **more: P.kwargs) -> R:
        known = self.__dict__.setdefault("_known", {})
        key = method.__name__, args, *more.items()
        if key not in known:
            known[key] = method(self, *args, **more)
        found: R = known[key]
        return found

    return call


@dataclass(frozen=True)
class Wiring:
    """The connections of a plant."""

    omega_b: float  # rad/s
    units: tuple[ConverterCircuit, ...]  # the converters
    # lines between nodes, and loads with an inductor, which end at `circuit.GROUND`
    branches: tuple[Branch, ...] = ()
    shunts: tuple[Shunt, ...] = ()  # loads that are resistors
    capacitors: tuple[Capacitor, ...] = ()  # banks of them
    # by their names the components with sources, voltages before currents
    fed: tuple[tuple[str, Fed], ...] = ()
    grid: str | None = None  # node of the grid, None: there is none
    closed: bool = True  # whether the grid's breaker is closed
    opened: frozenset[str] = frozenset()  # names of branches whose breakers are open
    fault: FaultPlace | None = None  # where one is, or may be again, or None
    # the breakers, open by ``closed`` or ``opened``, whose poles may still conduct
    opening: tuple[OpeningBreaker, ...] = ()
    # indices of converters whose bridges are out of every circuit
    blocked: frozenset[int] = frozenset()
    check: Check | None = None  # the synchro-check that waits to close a breaker, or None
    recorded: tuple[Terminal, ...] = ()  # where the run records currents and powers
    led: bool = False  # whether another part of the plant sets the frequency, see `parted`
    supervisors: tuple[str, ...] = ()  # names of the plant controllers

    @cached_property
    def order(self) -> tuple[str, ...]:
        """Names of the states as w has them: three a converter, the branches, the banks' voltages,
        and what a fault adds: the current beyond it within a branch, and its own through the
        inductance of the zero sequence's path, which a fault of three phases has as they open; the
        same of the grid's breaker; and the zero sequences of several contacts, see `contacts`."""
        own = tuple(name for unit in self.units for name in unit.states)
        beyond: tuple[str, ...] = () if self.split is None else ("beyond",)
        grounded = any(one is not None and one.kind in ("LG", "LLG") for one in self.contacts)
        if grounded and (self.fault or self.opening[0].name == GRID_SOURCE):
            beyond += (CONTACT,)
        if self.joint:
            beyond += tuple(branch.name for branch in zero_circuit(self.with_poles()).branches)
        others = [part.name for part in (*self.branches, *self.fed_branches)]
        others += [bank.name for bank in self.capacitors]
        return (*own, *others, *beyond)

    @property
    def nodes(self) -> tuple[str, ...]:
        """The nodes between the parts, each once."""
        ends = [unit.node for unit in self.units]
        ends += [node for branch in self.branches for node in (branch.start, branch.end)]
        ends += [node for _, one in self.fed if one.is_voltage for node in one.nodes]
        ends += [shunt.node for shunt in self.shunts] + [c.node for c in self.capacitors]
        ends += [sink.node for sink in self.sinks]
        within = {GROUND, *(unit.terminal for unit in self.units)}  # which a core may be at
        return tuple(dict.fromkeys(node for node in ends if node not in within))

    @property
    def neighbours(self) -> tuple[str, ...]:
        """The names of the neighbours that follow the grid."""
        return tuple(name for name, one in self.fed if isinstance(one, GridFollowing))

    @property
    def recorded_nodes(self) -> tuple[str, ...]:
        """The nodes of ``recorded``, each once."""
        return tuple(dict.fromkeys(one.node for one in self.recorded if one.node))

    def path_to(self, node: str) -> tuple[str, list[tuple[Branch, bool]]]:
        """A capacitor's voltage, and the branches from there to a node, each with whether they lead
        from its start to its end; over an opening breaker only where nothing else leads there.
        Nothing does: "" and none."""
        banks = {bank.node: bank.name for bank in self.capacitors}
        known = banks | {unit.terminal: unit.states[1] for unit in self.units}
        found: dict[str, tuple[str, list[tuple[Branch, bool]]]]
        found = {at: (state, []) for at, state in known.items()}
        opening = {part for _, part in self.poles}
        whole = [*self.with_poles().whole((*self.units_lines, *self.branches))]
        for those in ([one for one in whole if one.name not in opening], whole):
            before = -1
            while before < len(found):
                before = len(found)
                for one in those:
                    for a, b in ((one.start, one.end), (one.end, one.start)):
                        if a in found and b not in found and GROUND not in (a, b):
                            state, path = found[a]
                            found[b] = state, [*path, (one, a == one.start)]
        return found.get(node, ("", []))

    @property
    def joint(self) -> bool:
        """Whether several contacts may each conduct in other phases, see `contacts`."""
        return len(self.poles) + (self.fault is not None) > 1

    @cached_property
    def poles(self) -> tuple[tuple[str, str], ...]:
        """The breakers that open, by their names and the branches that they interrupt: a line with
        a fault inside is one on each side of it."""
        names = [one.name for one in self.opening]
        each = ((n, part) for n in names for part in (n, *(["beyond"] * (n == self.split))))
        return tuple(each)

    def with_poles(self) -> Wiring:
        """The wiring before its breakers began to open."""
        names = {one.name for one in self.opening}
        closed = self.closed or GRID_SOURCE in names
        return replace(self, opened=self.opened - names, closed=closed, opening=())

    def through_pole(self, name: str, part: str) -> dict[str, float]:
        """What each state brings to the current through one of ``poles``, as a factor."""
        return self.to_grid() if name == GRID_SOURCE else {part: 1.0}

    @property
    def fault_node(self) -> str:
        """The node of the fault; "" if there is none."""
        if self.fault is None:
            return ""
        return "beyond" if self.split else self.fault.node

    @property
    def split(self) -> str | None:
        """The branch that has a place for a fault inside."""
        return None if self.fault is None else self.fault.branch

    @cached_property
    def units_lines(self) -> tuple[Branch, ...]:
        """The lines from the converters to their nodes."""
        return tuple(
            Branch(u.line, u.terminal, u.node, u.L_g, u.R_g, u.earthed) for u in self.units
        )

    @cached_property
    def fed_branches(self) -> tuple[Branch, ...]:
        """From the voltages of components to their nodes."""
        each = (part for name, one in self.fed for part in one.elements(name))
        return tuple(part for part in each if isinstance(part, Branch))

    @cached_property
    def sinks(self) -> tuple[CurrentSource, ...]:
        """The currents of components."""
        each = (part for name, one in self.fed for part in one.elements(name))
        return tuple(part for part in each if isinstance(part, CurrentSource))

    @cached_property
    def fed_shunts(self) -> tuple[Shunt, ...]:
        """What the components with currents put beside them."""
        each = (part for name, one in self.fed for part in one.elements(name))
        return tuple(part for part in each if isinstance(part, Shunt))

    def sources(self) -> dict[str, int]:
        """The place of each source in the compiled plant; that of the grid is followed by its
        negative sequence."""
        names = [unit.bridge for unit in self.units] + [GRID_SOURCE, ""]
        names += [source for name, one in self.fed for source in one.sources(name)]
        return {name: place for place, name in enumerate(names) if name}

    @property
    def places(self) -> int:
        """How many places of sources there are."""
        return len(self.units) + 2 + sum(len(one.nodes) for _, one in self.fed)

    def named_lines(self) -> dict[str, Branch]:
        """Lines and transformers by the name that people use: a converter's line has that of the
        converter."""
        own = {unit.name: line for unit, line in zip(self.units, self.units_lines, strict=True)}
        return own | {b.name: b for b in self.branches if b.end != GROUND}

    @property
    def has_load(self) -> bool:
        """Whether anything is left to feed without the grid."""
        return bool(self.shunts or self.sinks) or any(
            branch.end == GROUND and branch.switched for branch in self.branches
        )

    def to_grid(self) -> dict[str, float]:
        """What each state brings to the grid, as a factor of its current."""
        found: dict[str, float] = {}
        if self.grid is None or not self.closed:
            return found
        for branch in self.whole((*self.units_lines, *self.branches, *self.fed_branches)):
            for node, sign in branch.taken():
                if node == self.grid:
                    found[branch.name] = -sign
        return found

    def islands(self) -> list[tuple[str, ...]]:
        """The nodes in groups that closed lines connect, each in the order of ``nodes``."""
        groups = {node: [node] for node in self.nodes}
        lines = [b for b in self.branches if b.end != GROUND and b.name not in self.opened]
        for ends in [*((b.start, b.end) for b in lines), *self.by_waves]:
            less, more = sorted((groups[node] for node in ends), key=len)
            if less is not more:
                more += less
                groups.update(dict.fromkeys(less, more))
        place = {node: k for k, node in enumerate(groups)}
        each = {id(group): group for group in groups.values()}
        return [tuple(sorted(group, key=place.__getitem__)) for group in each.values()]

    @property
    def by_waves(self) -> list[tuple[str, ...]]:
        """The nodes at the ends of each component between two nodes."""
        return [one.nodes for _, one in self.fed if len(one.nodes) > 1]

    def breakers(self) -> dict[str, tuple[str, str, str]]:
        """By the name that people use: the branch or shunt that a breaker opens, and the nodes at
        its two ends."""
        found = {n: (b.name, b.start, b.end) for n, b in self.named_lines().items()}
        lines = (*self.branches, *self.fed_branches)
        found |= {b.name: (b.name, b.start, b.end) for b in lines if b.switched}
        to_ground: tuple[Shunt | CurrentSource, ...] = (
            *self.shunts, *(sink for sink in self.sinks if sink.switched)
        )  # fmt: skip
        return found | {part.name: (part.name, part.node, GROUND) for part in to_ground}

    @cached_property
    def contacts(self) -> tuple[Contact | None, ...]:
        """None, the fault or the opening breaker, and what may be left of it while its phases open
        one by one."""
        found: list[Contact | None] = [None]
        alone = None if self.joint else next(iter(self.opening), None)
        waiting: list[Contact | None] = [self.fault or alone]
        zero_sequence = waiting != [None] and self.zero_sequence is not None
        while waiting:
            one = waiting.pop(0)
            if one in found or one is None:
                continue
            found.append(one)
            if one.clearing == "zero":
                waiting += [one.opened(phase, zero_sequence) for phase in one.phases]
        return tuple(found)

    @_once
    def contact_current(self, contact: Contact) -> NDArray[np.complex128]:
        """The currents of phases a, b, c through a fault or a breaker, (3, n_w): each is the real
        part of what this gives with w, in the frame that stands still."""
        to_axis = np.zeros((2, len(self.order)))
        for axis in (ALPHA, BETA):
            seen = contact.seen(axis, self.zero_sequence)
            if seen is not None:
                for name, factor in self._through(contact, axis, seen).items():
                    to_axis[axis, self.order.index(name)] += factor
        factors = [contact.phase_current(phase) for phase in "abc"]
        turn = np.exp(-1j * contact.angle)
        return np.array([turn * (a * to_axis[ALPHA] - 1j * b * to_axis[BETA]) for a, b in factors])

    def _through(self, contact: Contact, axis: int, seen: complex) -> dict[str, float]:
        """What each state brings to the current through a contact on an axis, as a factor."""
        if isinstance(contact, OpeningBreaker) and contact.name != GRID_SOURCE:
            return {contact.name: 1.0}
        if seen.imag > 0:
            return {CONTACT: 1.0}
        circuit, _ = self.circuit(frozenset(), contact, axis)
        place, share = str(self.grid), -1.0  # towards the network
        if isinstance(contact, FaultPlace):
            place = self.fault_node
            bank = next((one.name for one in circuit.capacitors if one.node == place), None)
            if bank is not None:
                return {bank: 1 / seen.real}
            R = next((one.R for one in circuit.shunts if one.node == place), None)
            if R is None:  # no line is left that leads there
                return {}
            share = R / seen.real if seen.real > 0 else 1.0
        return {
            branch.name: -sign * share
            for branch in circuit.branches
            for node, sign in branch.taken()
            if node == place
        }

    @_once
    def modes(self, blocked: frozenset[int], contact: Contact | None) -> tuple[Modes, list[str]]:
        """The modes of a circuit, and the names of its sources and sinks in their order.

        Args:
            blocked: indices of the converters whose bridges block.
            contact: one of ``contacts``.

        Raises:
            ValueError: as ``find_modes``.
        """
        circuit, _ = self.circuit(blocked, contact, ALPHA)
        alpha = find_modes(circuit, self.omega_b, self.order)
        if contact is None or contact.balanced:
            return alpha, circuit.names
        beta = find_modes(self.circuit(blocked, contact, BETA)[0], self.omega_b, self.order)
        return join_axes(alpha, beta, contact.angle), circuit.names

    def resting_by_modes(
        self, volts: Mapping[str, complex], turns: Mapping[str, float]
    ) -> NDArray[np.complex128]:
        """w at rest, in the common frame at t = 0.

        Args:
            volts, turns: of each source and sink its value, p.u., and its speed, p.u.
        """
        modes, sources = self.modes(self.blocked, None)
        z = np.zeros(len(modes.rates), complex)
        for omega in {turns[name] for name in sources}:
            speed = self.omega_b * (omega - 1.0)
            those = [volts[name] if turns[name] == omega else 0.0 for name in sources]
            z += modes.drive @ those / (1j * speed - modes.rates)
        return np.asarray(modes.states @ z)

    def resting(
        self, volts: Mapping[str, complex], turns: Mapping[str, float]
    ) -> NDArray[np.complex128]:
        """``resting_by_modes``, by the sparse equations of branches and nodes."""
        circuit, _ = self.circuit(self.blocked, None, ALPHA)
        return rest(circuit, self.order, volts, turns)

    def rates(
        self, blocked: frozenset[int], contact: Contact | None
    ) -> tuple[list[Rates], float, list[str]]:
        """The equations of a circuit on the axis alpha and on the axis beta, the angle of alpha,
        rad, and the names of the sources and sinks; arguments and errors as for ``modes``."""
        circuits = [self.circuit(blocked, contact, axis)[0] for axis in (ALPHA, BETA)]
        found = [find_rates(one, self.omega_b, self.order) for one in circuits]
        angle = 0.0 if contact is None or contact.balanced else contact.angle
        return found, angle, circuits[0].names

    @cached_property
    def zero_sequence(self) -> complex | None:
        """The impedance between the place of the fault and ground for a zero sequence at nominal
        frequency, or that of the loop through an opening breaker, p.u.; None: there is no path.

        It is the fault's own ``Z_0``, or that of the closed lines between the fault and the earthed
        star points of the grid and of transformers; lines have the same impedance for all
        sequences. Converters, machines and loads have three wires: behind the delta winding of a
        transformer a zero sequence finds no path.
        """
        if self.fault is None and self.opening:
            name = self.opening[0].name
            if name == GRID_SOURCE:
                return self._zero_sequence_between(str(self.grid), GROUND)
            lines = {one.name: one for one in self.branches if not one.earthed}
            line = lines.get(name)
            if line is None or line.end == GROUND:
                return None
            at_ground = {self.grid} if self.closed else set()
            start, end = (GROUND if n in at_ground else n for n in (line.start, line.end))
            around = self._zero_sequence_between(start, end)
            return None if around is None else complex(line.R, line.L) + around
        if self.fault is None or self.fault.Z_0 is not None:
            return None if self.fault is None else self.fault.Z_0
        return self._zero_sequence_between(self.fault_node, GROUND)

    def _zero_sequence_between(self, one: str, other: str) -> complex | None:
        """The impedance of closed lines and star points between two nodes."""
        found = [
            (dict(zip(ends, (sign for _, sign in part.taken()), strict=True)), part)
            for part, ends in self.zero_branches()
        ]
        reached = {other}
        while more := {end for at, _ in found if {*at} & reached for end in at} - reached:
            reached |= more
        if one not in reached:
            return None
        nodes = sorted(reached - {other})
        Y = np.zeros((len(nodes), len(nodes)), complex)
        for signs, part in found:
            if {*signs} <= reached:
                at = [nodes.index(end) for end in signs if end != other]
                sign = np.array([signs[nodes[k]] for k in at])
                Y[np.ix_(at, at)] += np.outer(sign, sign) / complex(part.R, part.L)
        return complex(np.linalg.inv(Y)[nodes.index(one), nodes.index(one)])

    def zero_branches(self) -> Iterator[tuple[Branch, tuple[str, str]]]:
        """The closed lines and windings that carry a zero sequence, and between which nodes."""
        for branch in self.whole((*self.units_lines, *self.branches)):
            if branch.end == GROUND or branch.earthed == "none":
                continue
            ends = {"end": {branch.start}, "start": {branch.end}}.get(
                branch.earthed, {self.grid} if self.closed else set()
            )  # which of its ends are at ground
            a, b = (GROUND if end in ends else end for end in (branch.start, branch.end))
            yield branch, (a, b)

    @_once
    def voltage(
        self, node: str, blocked: frozenset[int], contact: Contact | None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], complex]:
        """The voltage of a node as factors of w and of the sources, (2, n_w) and (2, n_s): of
        themselves, and of their mirror images times the number that comes third. The latter are
        zero in a balanced circuit; see ``join_axes``.

        Args:
            blocked, contact: as for ``modes``.
        """
        alpha = self._voltage(node, blocked, contact, ALPHA)
        if contact is None or contact.balanced:
            by_w, by_s = (np.array([one, np.zeros_like(one)]) for one in alpha)
            return by_w, by_s, 1.0
        beta = self._voltage(node, blocked, contact, BETA)
        by_w, by_s = (np.array([a + b, a - b]) / 2 for a, b in zip(alpha, beta, strict=True))
        return by_w, by_s, np.exp(2j * contact.angle)

    def _voltage(
        self, node: str, blocked: frozenset[int], contact: Contact | None, axis: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The voltage of a node on an axis as factors of w and of the sources, see
        ``find_voltage``; of a node where no current can flow, that of what it hangs on."""
        circuit, hanging = self.circuit(blocked, contact, axis)
        if here := self.hangs_on(node, circuit, hanging):
            return find_voltage(here, circuit, self.order)
        return np.zeros(len(self.order)), np.zeros(len(circuit.sources))

    @staticmethod
    def hangs_on(node: str, circuit: Circuit, hanging: Sequence[Branch]) -> str:
        """The node of a circuit that has the voltage of a node: itself, or what it hangs on where
        no current can flow; "" if there is none."""
        there = {end for branch in circuit.branches for end in (branch.start, branch.end)}
        there |= {one.node for one in circuit.capacitors} | {one.node for one in circuit.sources}
        seen, reached = {node}, [node]
        while reached:
            here = reached.pop(0)
            if here in there or here == GROUND:
                return here
            for branch in hanging:
                if here in (branch.start, branch.end):
                    other = branch.end if branch.start == here else branch.start
                    reached += [other] if other not in seen else []
                    seen.add(other)
        return ""

    @_once
    def circuit(
        self, blocked: frozenset[int], contact: Contact | None, axis: int, place: str = GROUND
    ) -> tuple[Circuit, list[Branch]]:
        """A circuit, and the branches that an open breaker has left hanging; of an
        unbalanced one those of an axis. At ``place`` no branch hangs."""
        filters, sources = [], []
        shunts = [shunt for shunt in self.shunts if shunt.name not in self.opened]
        through, poles, grid = [], {}, self.grid if self.closed else None
        seen = None if contact is None else contact.seen(axis, self.zero_sequence)
        if isinstance(contact, FaultPlace) and seen is not None:
            node = self.fault_node
            if seen.imag > 0:
                through.append(Branch(CONTACT, node, GROUND, seen.imag, seen.real))
            else:
                shunts.append(Shunt("fault", node, seen.real))
        elif isinstance(contact, OpeningBreaker) and contact.name == GRID_SOURCE:
            grid = self.grid if seen == 0 else GRID_SOURCE
            if seen:
                through.append(Branch(CONTACT, GRID_SOURCE, str(self.grid), seen.imag, seen.real))
        elif isinstance(contact, OpeningBreaker) and seen is not None:
            poles = {contact.name: seen}
        shunts = _in_parallel([*shunts, *self.fed_shunts])
        for k, unit in enumerate(self.units):
            if k not in blocked:
                i_f = unit.states[0]
                filters.append(Branch(i_f, unit.bridge, unit.terminal, unit.L_f, unit.R_f))
                sources.append(VoltageSource(unit.bridge, unit.bridge))
        branches = [
            *self.whole(self.units_lines, poles),
            *filters,
            *self.whole((*self.branches, *self.fed_branches), poles),
            *through,
        ]
        sources += [VoltageSource(emf(name), emf(name)) for name, one in self.fed if one.is_voltage]
        capacitors = [Capacitor(unit.states[1], unit.terminal, unit.C_f) for unit in self.units]
        capacitors += self.capacitors
        if grid is not None:
            sources.append(VoltageSource(GRID_SOURCE, grid))
        whole, held = branches, {GROUND, place} | {source.node for source in sources}
        held |= {one.node for one in capacitors} | {one.node for one in shunts}
        if self.closed and not self.opened:  # no line may hang, but a converter on an open bus may
            held |= {node for line in self.branches for node in (line.start, line.end)}
        branches = without_ends(branches, held)
        met = {node for branch in branches for node in (branch.start, branch.end)}
        met |= {shunt.node for shunt in self.fed_shunts}
        shunts = [s for s in shunts if s.node in met]
        sinks = tuple(sink for sink in self.sinks if sink.name not in self.opened)
        circuit = Circuit(tuple(branches), tuple(capacitors), tuple(sources), tuple(shunts), sinks)
        kept = {branch.name for branch in branches}
        return circuit, [branch for branch in whole if branch.name not in kept]

    def whole(
        self, branches: Sequence[Branch], poles: Mapping[str, complex] = MappingProxyType({})
    ) -> Iterator[Branch]:
        """Those that are closed; a split one as two; and one whose poles still conduct, with the
        impedance that they see."""
        for branch in branches:
            if branch.name in poles:
                Z = poles[branch.name]
                yield replace(branch, L=branch.L + Z.imag, R=branch.R + Z.real)
            if branch.name in self.opened:
                continue
            if self.fault is None or branch.name != self.split:
                yield branch
                continue
            at = self.fault.position
            yield replace(branch, end="beyond", L=at * branch.L, R=at * branch.R)
            yield Branch("beyond", "beyond", branch.end, (1 - at) * branch.L, (1 - at) * branch.R)


def _in_parallel(shunts: Iterable[Shunt]) -> list[Shunt]:
    """One shunt a node in place of all that are there; a metallic fault, R = 0, wins."""
    found: dict[str, Shunt] = {}
    for one in shunts:
        if (there := found.get(one.node)) is not None:
            R = there.R * one.R / (there.R + one.R) if one.R > 0 else 0.0
            one = Shunt(one.name, one.node, R)
        found[one.node] = one
    return list(found.values())
