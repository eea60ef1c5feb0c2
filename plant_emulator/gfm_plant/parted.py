"""A plant in parts: lines of travelling waves cut a network, and each part is a plant of its own.

What arrives at an end of such a line has left the other one a delay of at least T_s earlier. So
within a tick no part asks anything of another: each has its own circuit, by its modes or by its
series. After a tick both ends of a line wait for each other and take over what has left there, see
`bergeron_line`. So each part is moved on by a thread of its own, and nothing depends on which
processor core runs it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_plant.build import make_part
from gfm_plant.circuit import GROUND
from gfm_plant.components import DYNAMIC
from gfm_plant.components.bergeron_line import BergeronLine
from gfm_plant.components.finite_grid import FiniteGrid
from gfm_plant.components.part import FAULT
from gfm_plant.names import FIRST_LINE, THE_GRID
from gfm_plant.network import Network
from gfm_plant.wiring import Wiring

_OWN = {"source", "sees", "lag", "leads", "first", "last", "here", "other", "led", "spins"}
"""Of a component's record, what differs in a part."""
_WAVES = DYNAMIC.index(BergeronLine)


def find_places(wiring: Wiring) -> list[tuple[int, ...]]:
    """The converters of each part of a network: of those nodes that anything but waves connects,
    lines that are open too. What has no converter is in a part with what is behind its waves."""
    return [units for units, _ in _places(wiring)]


def _places(wiring: Wiring) -> list[tuple[tuple[int, ...], frozenset[str]]]:
    """The converters and the nodes of each part."""
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
    terminals = [unit.terminal for unit in wiring.units]
    before = -1
    while before != (before := len({id(nodes) for nodes in group.values()})):
        for ends in wiring.by_waves:
            if not all(group[node] & {*terminals} for node in ends):
                join(*ends)
    found = dict[frozenset[str], list[int]]()
    for k, terminal in enumerate(terminals):
        found.setdefault(frozenset(group[terminal]), []).append(k)
    return [(tuple(units), nodes) for nodes, units in found.items()]


def cut(
    whole: Network, x: NDArray[np.float64], u: NDArray[np.float64], faults: Collection[str] = ()
) -> list[tuple[Network, tuple[int, ...]]]:
    """Return the parts of a plant that is at its start, each a plant of its own, and which
    converters of the whole one they have.

    Args:
        x, u: as of ``Network.start``.
        faults: the nodes and lines at which a fault may come, whose currents one part records.

    Raises:
        ValueError: a bridge is switched, recorded faults are in several parts, or a part is not
            beside the one with the machine, or the finite grid, that sets its frequency.
    """
    if whole.net[0]["n_units"]:
        raise ValueError("network.converters: a switched bridge; parts have averaged ones alone")
    places, leads = _places(whole.wiring), _leader(whole)
    parts = [_part(whole, units, nodes, leads, {*faults}) for units, nodes in places]
    if sum(FAULT in {one.name for one in part.wiring.recorded} for part in parts) > 1:
        raise ValueError("network.record: the faults are in several parts; name other terminals")
    for part, (units, _) in zip(parts, places, strict=True):
        _take_state(part, whole, units)
        part.begin(x[[*units]], u[[*units]])
    _join(parts)
    for part in parts if leads is not None else ():
        if part.wiring.led and not part.parts[_WAVES]["led"].any():
            raise ValueError(
                f"{part.wiring.units[0].name}: no line of travelling waves leads from its part to"
                " the one that sets the frequency"
            )
    return [(part, units) for part, (units, _) in zip(parts, places, strict=True)]


def _leader(whole: Network) -> str | None:
    """Whose speed is that of the frame, if it is not that of an ideal grid."""
    if whole.wiring.grid is not None:
        return THE_GRID if len(whole.of(FiniteGrid)) else None
    leads = (name for name, _, one in whole.fed() if "leads" in one.dtype.names and one["leads"])
    return next(leads, None)


def _part(
    whole: Network, units: Sequence[int], nodes: frozenset[str], leads: str | None, faults: set[str]
) -> Network:
    """The plant of a part, with its circuits."""
    wiring, first = _wiring(whole.wiring, units, nodes), 0 in units
    elsewhere = (_names(whole.wiring) - _names(wiring)) | (set() if first else {FIRST_LINE})
    recorded = wiring.recorded
    if faults - elsewhere or (first and not faults):
        recorded += tuple(one for one in whole.wiring.recorded if one.name == FAULT)
    led = wiring.led or (leads is not None and leads in elsewhere)
    part = make_part(whole, [*units], replace(wiring, recorded=recorded, led=led))
    part.elsewhere = elsewhere
    part.connect(part.wiring)
    return part


def _wiring(wiring: Wiring, units: Sequence[int], nodes: frozenset[str]) -> Wiring:
    """What a wiring of the whole plant has at some of its nodes."""
    has_grid = wiring.grid in nodes
    return replace(
        wiring,
        units=tuple(wiring.units[k] for k in units),
        branches=tuple(b for b in wiring.branches if {b.start, b.end} & nodes),
        shunts=tuple(one for one in wiring.shunts if one.node in nodes),
        capacitors=tuple(one for one in wiring.capacitors if one.node in nodes),
        fed=tuple(_ends_in(wiring, nodes)),
        grid=wiring.grid if has_grid else None,
        closed=wiring.closed or not has_grid,
        recorded=tuple(one for one in wiring.recorded if one.node in nodes),
        led=wiring.grid is not None and not has_grid,
    )


def _ends_in(wiring: Wiring, nodes: frozenset[str]) -> Iterator[tuple[str, Any]]:
    for name, one in wiring.fed:
        at = [k for k, node in enumerate(one.nodes) if node in nodes]
        if isinstance(one, BergeronLine) and len(at) == 1:
            yield name, one.only(at[0])
        elif at:
            yield name, one


def _names(wiring: Wiring) -> frozenset[str]:
    """What events of a plant may name."""
    names = {*wiring.breakers(), *wiring.named_lines(), *wiring.nodes}
    names |= {name for name, _ in wiring.fed}
    return frozenset(names | ({THE_GRID} if wiring.grid is not None else set()))


def _take_state(part: Network, whole: Network, units: Sequence[int]) -> None:
    """Put a part where the whole plant is."""
    its, now, N = part.now[0], whole.now[0], len(whole.par)
    for name in (
        "closed", "omega_g", "omega_g_slope", "omega_g_to", "V_g", "V_g_to", "sequence",
        "frame_turn", "frame_tick",
    ):  # fmt: skip
        its[name] = now[name]
    w = dict(zip(whole.wiring.order, now["w"], strict=False))
    its["w"][: len(part.wiring.order)] = [w[name] for name in part.wiring.order]
    places, g = whole.wiring.sources(), len(units)
    for name, k in part.wiring.sources().items():
        its["unit"][k], its["emf"][k] = now["unit"][places[name]], now["emf"][places[name]]
    its["unit"][g : g + 2] = now["unit"][N : N + 2]
    records = {name: record for name, _, record in whole.fed()}
    for name, _, record in part.fed():
        for at in {*record.dtype.names} - _OWN:
            record[at] = records[name][at]


def _join(parts: Sequence[Network]) -> None:
    """Tell the ends of each line where the other one is."""
    ends = dict[str, list[tuple[Network, Any]]]()
    for part in parts:
        names = [name for name, one in part.wiring.fed if isinstance(one, BergeronLine)]
        for name, record in zip(names, part.parts[_WAVES], strict=True):
            ends.setdefault(name, []).append((part, record))
    for those in ends.values():
        if len(those) == 2:
            for (part, one), (neighbour, other) in (those, those[::-1]):
                one["here"], one["other"] = _address(one), _address(other)
                one["led"] = part.wiring.led and not neighbour.wiring.led


def _address(record: Any) -> int:
    return int(record.__array_interface__["data"][0])


def spin(part: Network, looks: int) -> None:
    """Set how often a thread looks at the other ends before it yields its processor core."""
    part.parts[_WAVES]["spins"] = looks


def leave(part: Network) -> None:
    """Let nobody wait for this part any more."""
    part.parts[_WAVES]["done"] = 1 << 62
