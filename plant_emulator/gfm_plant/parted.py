"""A plant in parts: lines of travelling waves cut a network, and each part is a plant of its own.

What arrives at an end of such a line has left the ends a delay of at least T_s earlier. So within a
tick no part asks anything of another: each has its own circuit, by its modes or by its series, and
takes over the others' waves, and the frequency that a machine sets, between two ticks. All parts
cut the period into the same pieces, as one circuit would, and nothing depends on who computes them.
The records of the converters are those of the whole plant.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import typeof
from numpy.typing import NDArray

from gfm_plant.circuit import GROUND
from gfm_plant.components import DYNAMIC
from gfm_plant.components.bergeron_line import BergeronLine
from gfm_plant.components.finite_grid import FiniteGrid
from gfm_plant.components.part import FAULT
from gfm_plant.layout import Record
from gfm_plant.network import Network, leader
from gfm_plant.records import PlantRecords
from gfm_plant.wiring import GRID_SOURCE, Wiring

_GRID = ("closed", "omega_g", "omega_g_slope", "omega_g_to", "V_g", "V_g_to", "stands_tick")
_NET = ("updates", "batteries", "conversions")


@dataclass(frozen=True)
class Place:
    """Where a part is in the plant."""

    index: int
    nodes: frozenset[str]
    first: int  # of its converters
    end: int  # before which these end

    def of(self, wiring: Wiring) -> Wiring:
        """What a wiring of the whole plant has here."""
        here = self.nodes
        fed = tuple(self._ends_of(wiring))
        branches = tuple(b for b in wiring.branches if {b.start, b.end} & here)
        units = wiring.units[self.first : self.end]
        shunts = tuple(one for one in wiring.shunts if one.node in here)
        known = {b.name for b in branches} | {one.name for one in shunts} | {n for n, _ in fed}
        known |= {unit.line for unit in units}
        has_grid = wiring.grid in here
        known |= {GRID_SOURCE} if has_grid else set()
        fault = wiring.fault if wiring.fault and wiring.fault.node in here else None
        watches = fault is not None or (wiring.fault is None and self.index == 0)
        leads, check = leader(wiring), wiring.check
        return replace(
            wiring,
            units=units,
            branches=branches,
            shunts=shunts,
            capacitors=tuple(one for one in wiring.capacitors if one.node in here),
            fed=fed,
            grid=wiring.grid if has_grid else None,
            closed=wiring.closed or not has_grid,
            led=(wiring.grid is not None or leads is not None)
            and not has_grid
            and leads not in known,
            opened=wiring.opened & known,
            fault=fault,
            opening=tuple(one for one in wiring.opening if one.name in known),
            blocked=frozenset(k - self.first for k in wiring.blocked if self.has(k)),
            check=check if check and check.sides[0] in here else None,
            recorded=tuple(
                one for one in wiring.recorded if (one.node in here if one.node else watches)
            ),
        )

    def has(self, k: int) -> bool:
        """Whether converter k of the plant is here."""
        return self.first <= k < self.end

    def _ends_of(self, wiring: Wiring) -> Iterator[tuple[str, Any]]:
        for name, one in wiring.fed:
            at = [k for k, node in enumerate(one.nodes) if node in self.nodes]
            if at:
                if isinstance(one, BergeronLine) and len(at) == 1:
                    one = one.only(at[0])
                yield name, one


def find_places(wiring: Wiring) -> list[Place]:
    """The parts of a network, in the order of their converters: what lines connect, open ones too.

    Each part has converters that follow each other; what has none belongs to a neighbour.
    """
    if not wiring.by_waves:
        return [Place(0, frozenset(), 0, len(wiring.units))]
    group = dict[str, set[str]]()

    def join(*nodes: str) -> None:
        both = {*nodes}.union(*(group.get(node, ()) for node in nodes)) - {GROUND}
        group.update(dict.fromkeys(both, both))

    for unit in wiring.units:
        join(unit.terminal, unit.node)
    for branch in (*wiring.branches, *wiring.fed_branches):
        join(branch.start, branch.end)
    for node in wiring.nodes:
        join(node)
    members = [unit.terminal for unit in wiring.units]
    merged = True
    while merged:
        merged = False
        for nodes in wiring.by_waves:  # to where a converter is
            a, b = (group[node] for node in nodes)
            if a is not b and not all(one & {*members} for one in (a, b)):
                join(*nodes)
                merged = True
        for k, last in enumerate(members):  # those between two converters of one part
            between = [j for j in range(k) if group[members[j]] is group[last]]
            for j in range(min(between, default=k), k):
                if group[members[j]] is not group[last]:
                    join(members[j], last)
                    merged = True
    found = list[Place]()
    for k, member in enumerate(members):
        nodes_here = frozenset(group[member])
        if found and found[-1].nodes == nodes_here:
            found[-1] = replace(found[-1], end=k + 1)
        else:
            found.append(Place(len(found), nodes_here, k, k + 1))
    return found


@dataclass
class Parted(Network):
    """A plant in parts. Its own records have the converters, the start, and how many parts there
    are; the circuit is that of the parts."""

    places: tuple[Place, ...] = ()
    own: tuple[Network, ...] = ()

    @property
    def pieces(self) -> tuple[Network, ...]:
        return self.own

    @property
    def nows(self) -> list[Record]:
        return [self.now, *(part.now for part in self.own)]

    def _addresses(self, records: PlantRecords) -> NDArray[np.int64]:
        rows = np.zeros((len(self.own), 4), np.int64)
        for row, place, part in zip(rows, self.places, self.own, strict=True):
            if typeof(part.records) != typeof(records):
                raise TypeError("the records of a part are of another type than the plant's")
            row[:3] = part.net["part_at"][0, 0, 0], place.first, place.end
            part.net["look"] = self.net["look"]  # a fault that is recorded may come there
        return self._led(rows)

    def _led(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        led = [part.wiring.led for part in self.own]
        rows[:, 3] = [led.index(False) if one and False in led else -1 for one in led]
        return rows

    @property
    def memory(self) -> tuple[Record, ...]:
        own = ((part.net, part.now, *part.parts) for part in self.own)
        return (*self._own_memory, *(record for those in own for record in those))

    def locate(self, k: int) -> tuple[Network, int]:
        place = next(place for place in self.places if place.has(k))
        return self.own[place.index], k - place.first

    def of(self, kind: type[Any]) -> Record:
        """As of a plant in one: of a kind that is in one part at most, those that are moved on."""
        if kind is FiniteGrid:
            return max((part.of(kind) for part in self.own), key=len)
        return super().of(kind)

    def copy(self) -> Parted:
        whole, own = super().copy(), []
        for place, part in zip(self.places, self.own, strict=True):
            copied = part.copy()
            copied.par, copied.st = (x[place.first : place.end] for x in (whole.par, whole.st))
            own.append(copied)
        memory = whole.par, whole.st, whole.net, whole.now, whole.parts
        return Parted(*memory, self.wiring, self.places, tuple(own))

    def restore(self, kept: Network) -> None:
        super().restore(kept)
        for part, old in zip(self.own, kept.pieces, strict=True):
            part.wiring, part.at_least, part.fastest = old.wiring, old.at_least, old.fastest

    def conducting(self) -> dict[str, tuple[str, int]]:
        found = dict[str, tuple[str, int]]()
        for part in self.own:
            for name, phases in part.conducting().items():
                if phases[0] or name not in found:
                    found[name] = phases
        return found

    def rewire(self, wiring: Wiring) -> None:
        self._change(wiring, running=True)
        if wiring.grid is None and leader(wiring) is None:
            for now in self.nows:
                now["omega_g_slope"] = 0.0
        self._led(self.net["part_at"][0])

    def connect(self, wiring: Wiring) -> None:
        self._change(wiring, running=False)

    def _change(self, wiring: Wiring, running: bool) -> None:
        """Take another wiring, and after that the pieces of the period that all parts need. Raises
        ValueError: as ``connect``; the plant is then unchanged."""
        kept = self.copy()
        try:
            self._see(wiring)
            for place, part in zip(self.places, self.own, strict=True):
                there = place.of(wiring)
                if there != part.wiring or not running:
                    (part.rewire if running else part.connect)(there)
            fastest = max(part.fastest for part in self.own)
            for part in self.own:
                part.at_least = fastest
                if part.pieces_at(fastest):
                    (part.rewire if running else part.connect)(part.wiring)
        except ValueError:
            self.restore(kept)
            raise
        self.wiring = wiring

    def _begin(self, x: NDArray[np.float64], told: NDArray[np.float64]) -> None:
        """Start the parts where the whole is at rest."""
        assert self.records  # a copy that is made from here on has the addresses of the parts
        order, places, now = self.wiring.order, self.wiring.sources(), self.now[0]
        w = dict(zip(order, now["w"], strict=False))
        records = {name: record for name, _, record in self.fed()}
        for place, part in zip(self.places, self.own, strict=True):
            its = part.now[0]
            for name in (*_GRID, "sequence"):
                its[name] = now[name]
            its["w"][: len(part.wiring.order)] = [w[name] for name in part.wiring.order]
            for name, k in part.wiring.sources().items():
                for field in ("unit", "emf"):
                    its[field][k] = now[field][places[name]]
            g = len(part.par)
            its["unit"][g : g + 2] = now["unit"][len(self.par) : len(self.par) + 2]
            for name, _, record in part.fed():
                for at in {*record.dtype.names} - _OWN:
                    record[at] = records[name][at]
            if len(part.of(FiniteGrid)):
                part.of(FiniteGrid)[:] = super().of(FiniteGrid)
            part._begin(x[place.first : place.end], told[place.first : place.end])

    def join(self) -> None:
        """Tell the parts where the other ends of their lines are, and their recorded terminals."""
        kind, ends = DYNAMIC.index(BergeronLine), dict[str, list[tuple[int, int, Any]]]()
        columns = [name for one in self.wiring.recorded for name in one.columns]
        for place, part in zip(self.places, self.own, strict=True):
            waves = [n for n, one in part.wiring.fed if isinstance(one, BergeronLine)]
            for j, name in enumerate(waves):
                ends.setdefault(name, []).append((place.index, j, part.parts[kind][j]))
            there = [one for one in self.wiring.recorded if one.node in place.nodes or not one.node]
            names = [name for one in there for name in one.columns]
            part.net["flow_to"][0, : len(names)] = [columns.index(name) for name in names]
            for name in _NET:
                part.net[name] = self.net[name]
        for those in ends.values():
            if len(those) == 2:
                for (_, _, record), (p, j, _) in zip(those, those[::-1], strict=True):
                    record["other"] = p, j


_OWN = {"source", "sees", "lag", "first", "last", "other", "leads"}
"""Of a component's record, what differs in a part."""


def with_faults(wiring: Wiring, whole: Wiring) -> Wiring:
    """The wiring of a part with the room that a recorded fault there needs."""
    faults = [one for one in whole.recorded if one.name == FAULT]
    return replace(wiring, recorded=(*(r for r in wiring.recorded if r.name != FAULT), *faults))
