"""The parts of a plant, for the compiled loops, and what they tell each other between two ticks.

See `parted`. A plant that is not cut has one part, itself. ``plant`` is the whole one.
"""

from typing import Any

from numba import types

from gfm_plant.components import DYNAMIC
from gfm_plant.components.bergeron_line import BergeronLine, take_waves
from gfm_plant.emulator import plant_step
from gfm_plant.layout import field, intrinsic
from gfm_plant.records import PlantRecords
from gfm_runtime.compiled import compiled, inlined

_WAVES = DYNAMIC.index(BergeronLine)


@intrinsic
def _records_at(typingctx: Any, address: Any, like: Any) -> Any:
    """Return the `PlantRecords` at an address; ``like``: others, which are of the same type."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = context.get_value_type(like)
        return builder.load(builder.inttoptr(arguments[0], kind.as_pointer()))

    return like(types.int64, like), make


@inlined
def part(plant: PlantRecords, p: int) -> PlantRecords:
    """Return part p of the plant."""
    found: PlantRecords = _records_at(field(plant.net[0], "part_at")[p, 0], plant)
    return found


@inlined
def parts_of(plant: PlantRecords) -> int:
    """Return how many parts the plant has."""
    return len(field(plant.net[0], "part_at"))


@inlined
def converters_of(plant: PlantRecords, p: int) -> tuple[int, int]:
    """Return which converter is the first one of part p, and before which it ends."""
    at = field(plant.net[0], "part_at")
    return at[p, 1], at[p, 2]


@inlined
def part_with(plant: PlantRecords, k: int) -> int:
    """Return which part has converter k."""
    at, p = field(plant.net[0], "part_at"), 0
    while k >= at[p, 2]:
        p += 1
    return p


@compiled
def listen(plant: PlantRecords, p: int) -> None:
    """Have part p take over what the others sent it in the last tick. No part may be moved on
    meanwhile."""
    one = part(plant, p)
    lines = one.parts[_WAVES]
    for j in range(len(lines)):
        if lines[j].last - lines[j].first < 2:
            other = part(plant, lines[j].other[0]).parts[_WAVES]
            take_waves(lines[j], other[lines[j].other[1]])
    leads = field(plant.net[0], "part_at")[p, 3]
    if leads >= 0:
        now, theirs = one.now[0], part(plant, leads).now[0]
        now.omega_g, now.omega_g_to = theirs.omega_g, theirs.omega_g_to
        now.omega_g_slope = theirs.omega_g_slope


@compiled
def listen_all(plant: PlantRecords) -> None:
    """``listen`` of all parts."""
    parts = parts_of(plant)
    if parts > 1:
        for p in range(parts):
            listen(plant, p)


@compiled
def step_parts(plant: PlantRecords) -> None:
    """`plant_step` of all parts."""
    for p in range(parts_of(plant)):
        plant_step(part(plant, p))
