"""What the compiled code of a plant calls by an address in its records, and which plants need it.

These functions are large and have several callers, or most plants do without them.
"""

from collections.abc import Callable, Collection
from typing import Any

from numba import typeof, types

from gfm_plant.bridge import advance_bridges
from gfm_plant.clearing import advance_clearing
from gfm_plant.components import components_act
from gfm_plant.emulator import look_at_connection, whole_period
from gfm_plant.flows import look_at_flows
from gfm_plant.joint import make_joint
from gfm_plant.moving import advance_moving
from gfm_plant.names import WAYS
from gfm_plant.period import advance_alone, advance_with_components
from gfm_plant.records import PlantRecords
from gfm_plant.sensors import read_sensors
from gfm_plant.sparse import series_half
from gfm_plant.synchro_check import watch
from gfm_plant.wiring import Wiring
from gfm_runtime.by_address import address_of


def find_ways(
    records: PlantRecords, wiring: Wiring, names: Collection[str] = WAYS, all_events: bool = False
) -> None:
    """Compile, or load, what a plant calls by address, and write the addresses to its records.

    Args:
        records: of the plant.
        wiring: how its parts are connected.
        names: of the addresses that are asked for.
        all_events: also what it calls only while the phases of a fault or a breaker open, or while
            a breaker waits for its synchro-check.
    """
    net, (plant, circuit) = records.net[0], _kinds(records)
    contact = all_events or wiring.joint or len(wiring.contacts) > 1
    each: dict[str, tuple[Any, tuple[Any, ...], Callable[..., None]]] = {
        "step": (True, plant, _step),
        "advance": (True, plant, _way_between(net)),
        "components": (net["n_dynamic"], plant, _components),
        "series": (net["sparse"], circuit, _series),
        "sample": (True, plant, _sample),
        "connection": (net["connections"], plant, _connection),
        "look": (wiring.recorded, plant, _look),
        "clear": (contact, plant, _clear),
        "join": (contact, circuit, _join),
        "watch": (all_events or wiring.check is not None, plant, _watch),
    }
    for name in names:
        needed, kinds, way = each[name]
        if needed:
            net[name] = address_of(kinds, way)


def _kinds(records: PlantRecords) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Return the types of a plant's records and of its circuit's, see ``address_of``. numba takes
    milliseconds to find them, and every run asks for them, so they are kept."""
    par, st, net, now, parts = records
    key = tuple((one.dtype, one.flags.c_contiguous) for one in (par, st, net, now, *parts))
    if key not in _known:
        circuit = tuple(typeof(record).dtype for record in (net, now))
        _known[key] = (types.CPointer(typeof(records)),), circuit
    return _known[key]


_known: dict[tuple[Any, ...], tuple[tuple[Any, ...], tuple[Any, ...]]] = {}


def _way_between(net: Any) -> Callable[..., None]:
    """Averaged, or from edge to edge; without components that have states of their own, or with."""
    ways = (_switched, _moving) if net["n_units"] else (_alone, _with_components)
    return ways[int(net["n_dynamic"] > 0)]


def _step(plant: Any, a: float, b: float) -> None:
    whole_period(plant[0])


def _alone(plant: Any, begin: float, end: float) -> None:
    advance_alone(plant[0], begin, end)


def _with_components(plant: Any, begin: float, end: float) -> None:
    advance_with_components(plant[0], begin, end)


def _switched(plant: Any, begin: float, end: float) -> None:
    advance_bridges(plant[0], begin, end)


def _moving(plant: Any, begin: float, end: float) -> None:
    advance_moving(plant[0], begin, end)


def _components(plant: Any, act: float, c: float) -> None:
    components_act(plant[0], int(act), int(c))


def _series(n: Any, now: Any, half: float, which: float) -> None:
    series_half(n, now, half, int(which))


def _sample(plant: Any, k: float, size: float) -> None:
    read_sensors(plant[0], int(k), int(size))


def _connection(plant: Any, k: float, b: float) -> None:
    look_at_connection(plant[0], int(k))


def _look(plant: Any, a: float, b: float) -> None:
    look_at_flows(plant[0])


def _clear(plant: Any, a: float, b: float) -> None:
    advance_clearing(plant[0])


def _join(n: Any, now: Any, a: float, b: float) -> None:
    make_joint(n, now)


def _watch(plant: Any, a: float, b: float) -> None:
    watch(plant[0])
