"""What a component of a network declares: the rest of the plant, the linear model, the diagram and
the documentation read it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from gfm_plant.circuit import GROUND, Branch, Capacitor, CurrentSource, Element
from gfm_plant.parameters import Options
from gfm_plant.solution import state
from gfm_runtime.compiled import compiled

Matrix = NDArray[np.float64]


#: what a run records of a terminal, after its name and a dot: the power by the voltage of its node,
#: and its current in the common frame; of the fault the currents of its phases
FLOW, OF_FAULT = ("P", "Q", "i_re", "i_im"), ("i_a", "i_b", "i_c")
#: after those: the speed of what turns, or the frequency of what follows a voltage
SPEED_COLUMN = "omega"
FAULT = "fault"


@dataclass(frozen=True)
class Terminal:
    """Where a component meets a node; of ``FAULT`` the node is that of any fault, ""."""

    name: str  # of the component; ".end" follows at the end of a line
    node: str
    parts: tuple[tuple[str, float], ...] = ()  # elements, and factors of their currents
    turns: str = ""  # the source of the component whose speed is recorded, if it has one
    more: tuple[str, ...] = ()  # columns after these that the component writes itself

    @property
    def columns(self) -> tuple[str, ...]:
        """Its columns in the recording."""
        each = (*FLOW, *([SPEED_COLUMN] if self.turns else [])) if self.node else OF_FAULT
        return tuple(f"{self.name}.{what}" for what in (*each, *self.more))


def converter_terminal(name: str, node: str) -> Terminal:
    """That of a converter: what its line, whose name is ``f"{name}.i_o"``, brings to its node."""
    return Terminal(name, node, ((f"{name}.i_o", 1.0),))


class Component(Options):
    """Base of all components; the options of one are its fields, in p.u. of the first converter."""

    #: of its part of the documentation
    title: ClassVar[str]
    #: of the diagram, see ``gfm_hil.results.diagram``
    symbol: ClassVar[str] = "box"
    #: tables of a network in which it is named x, for the documentation
    example: ClassVar[Mapping[str, Any]] = {}
    #: states beside those of the circuit: name, unit, meaning
    more_states: ClassVar[Sequence[tuple[str, str, str]]] = ()
    #: of the recording, besides those that every run has of its converters
    columns: ClassVar[Sequence[str]] = ()
    #: how many there can be, besides what is said of the circuit
    how_many: ClassVar[str] = "any number"
    #: whether it counts the power that it feeds into its node, in place of what it takes from there
    feeds: ClassVar[bool] = False

    def elements(self, name: str) -> Sequence[Element]:
        """What it puts into the circuit; the first one has its name."""
        return ()

    def terminals(self, name: str) -> Sequence[Terminal]:
        """Where a run may record it: at its node, or at its start and its end, where power counts
        from start to end. Capacitors, those of a line's charging too, are left out."""
        found: dict[str, list[tuple[str, float]]] = {}
        for one in self.elements(name):
            if isinstance(one, Capacitor):
                continue
            for node, factor in one.taken() if isinstance(one, Branch) else ((one.node, 1.0),):
                if node not in (GROUND, emf(name)):
                    found.setdefault(node, []).append((one.name, factor))
        terminals = []
        for at_end, (node, ends) in enumerate(found.items()):
            sign = -1.0 if self.feeds or at_end else 1.0
            parts = tuple((part, sign * factor) for part, factor in ends)
            terminals.append(Terminal(f"{name}.end" if at_end else name, node, parts))
        return terminals

    def label(self) -> str:
        """Its parameters, for the diagram."""
        return ""


@dataclass(frozen=True)
class LinearPart:
    """Small deviations of a component with a source, around its rest.

    It has m states. Currents and voltages are two numbers each, the real and the imaginary part of
    a space vector in the frame that turns with the component's island; with two sources, those of
    both and then the imaginary ones.
    """

    A: Matrix  # the states by themselves, (m, m), 1/s
    by_seen: Matrix  # the states by the current or voltage that it sees, (m, 2), 1/s
    source: Matrix  # its source by the states, (2, m)
    turn: Matrix  # what a turn of all space vectors by 1 rad does to the states, (m,)
    # its source by what it sees, (2, 2)
    direct: Matrix = field(default_factory=lambda: np.zeros((2, 2)))


class Dynamic(Component):
    """A component with a record in the compiled plant, which its hooks move on.

    A hook is a compiled function (n, now, one, c, part) of the elements of ``net`` and ``now``, its
    record, the circuit in force, and which cut of the period a piece belongs to.
    """

    record: ClassVar[np.dtype[np.void]]
    #: at_rest, once at the start; keep, at an instant, and go_back to it, as often as it takes;
    #: begin of a piece; drive, where sources add to the forcing of the modes; middle and end of the
    #: piece; tick, after each tick; flow, where it is recorded: a current of its own goes to
    #: ``flow_i``, a speed to ``flow_omega``
    hooks: ClassVar[Mapping[str, Callable[..., None]]]

    def pack(self, record: Any, where: str, T_s: float, omega_b: float) -> None:
        """Write the parameters to an element of the record.

        Args:
            where: its table, for messages.
            T_s: s.
            omega_b: rad/s.

        Raises:
            ValueError: it is too fast for T_s.
        """

    def lag(self) -> float | None:
        """The time constant of a first-order lag, s, whose weights are ``lag_weights`` at the place
        ``lag`` of the record; None if it has none."""
        return None


class Fed(Dynamic):
    """A component with a source of its own: a voltage or a current; between two nodes two currents.

    Its record has ``source``, the place of that among the sources, and ``sees``, the place in w of
    the state that it sees; that of a voltage has ``E``, its value, p.u., over its unit phasor. A
    record with ``omega`` and ``leads`` may set the frequency of a network without a grid.
    """

    #: a voltage behind a branch, whose node is ``emf(name)``, or a current from its node to ground
    is_voltage: ClassVar[bool]
    #: of its steady state, besides currents and voltages of the circuit
    unknowns: ClassVar[int] = 0
    #: whether it has a speed, which its hook ``flow`` gives
    turns: ClassVar[bool] = False

    def terminals(self, name: str) -> Sequence[Terminal]:
        first, *others = super().terminals(name)
        return [replace(first, turns=self.sources(name)[0] if self.turns else ""), *others]

    @property
    def nodes(self) -> tuple[str, ...]:
        """Where its sources are: its node, or two; then what is said below of one is an array."""
        return (self.node,)  # type: ignore[attr-defined]

    def sources(self, name: str) -> tuple[str, ...]:
        """Their names, whose places follow each other."""
        return (emf(name) if self.is_voltage else name,)

    def check_pieces(self, name: str, shortest: float, omega_b: float) -> None:
        """Raise ValueError if it cannot have pieces of time as short as this, s."""

    def sees(self, name: str, banks: Mapping[str, str]) -> str | tuple[str, ...]:
        """The state of w that it sees.

        Args:
            name: its own.
            banks: by node the name of a capacitor's voltage there.

        Raises:
            ValueError: its node has none, and it needs one.
        """
        raise NotImplementedError

    def steady(self, v: Any, omega: float, omega_b: float, z: Matrix) -> tuple[Any, list[float]]:
        """At rest, the current that it brings to its node, and what must vanish besides.

        Args:
            v: voltage of its node, p.u.
            omega: speed of its island, p.u.
            omega_b: rad/s.
            z: its unknowns, (unknowns,).
        """
        raise NotImplementedError

    def settle(self, record: Any, v: Any, omega: float, omega_b: float, z: Matrix) -> Any:
        """Write the state at rest to its record; returns its source, in the common frame.

        Args:
            v, omega, omega_b, z: as for ``steady``.
        """
        raise NotImplementedError

    def linear(
        self, record: Any, seen: Any, source: Any, slip: float, omega_b: float
    ) -> LinearPart:
        """Small deviations around the rest that its record has.

        Args:
            seen, source: the current or voltage that it sees, and its source, in the common frame.
            slip: of its island against the common frame, rad/s.
        """
        raise NotImplementedError


DRAWN = [
    ("source", "i8"), ("sees", "i8"),
    ("v_begin", "c16"), ("v_middle", "c16"),  # the voltage of its node along a piece
]  # fmt: skip
"""Fields of the record of a current source."""


@compiled
def see_middle(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    """Keep the voltage in the middle of a piece, for the hook at its end."""
    one.v_middle = state(n, now, c, one.sees)


class Drawing(Fed):
    """A component that draws a current from a node whose voltage a capacitor holds."""

    is_voltage: ClassVar = False
    node: str
    #: what a node without a capacitor lacks, after its name and that of the component
    lacks: ClassVar[str]

    def elements(self, name: str) -> Sequence[Element]:
        return (CurrentSource(name, self.node),)

    def sees(self, name: str, banks: Mapping[str, str]) -> str:
        if self.node not in banks:
            raise ValueError(f"node {self.node}: {self.lacks.format(name)}")
        return banks[self.node]


def emf(name: str) -> str:
    """The node, and the source, of the voltage of a component."""
    return f"{name}.emf"
