"""Components with states of their own in a network in which a bridge is switched.

They go on in pieces, as in `gfm_plant.period`: a machine is a voltage that turns at the speed of
its rotor, a load or a converter with a control is a current that is held in each half of a piece. A
piece is a unit of the carrier, or what a sample, or a phase that opens, cuts off it. The series of
the network takes these sources from edge to edge as it takes the grid: the circuit stays exact, and
what the components do to it is of second order in the length of a piece, as with averaged bridges.
"""

from gfm_plant.bridge import advance_bridges
from gfm_plant.components import every_begin, every_drive, every_end, every_middle
from gfm_plant.layout import field
from gfm_plant.records import PlantRecords
from gfm_plant.solution import circuit, grid_source, lags_to
from gfm_runtime.compiled import compiled


@compiled
def advance_moving(plant: PlantRecords, begin: float, end: float) -> None:
    """Go on between two instants of the period, s after its beginning; inf: to its end."""
    n = plant.net[0]
    for unit in range(n.n_units):
        first = unit * n.unit_s
        last = n.T_s if unit == n.n_units - 1 else first + n.unit_s
        a, b = max(begin, first), min(end, last)
        if a < b:
            _piece(plant, a, b)


@compiled
def _piece(plant: PlantRecords, begin: float, end: float) -> None:
    """Go on by a piece, which is within a unit of the carrier."""
    n, now = plant.net[0], plant.now[0]
    c, g, half = circuit(n, now), grid_source(n), 0.5 * (end - begin)
    cut = 2 * n.n_parts
    if field(n, "half_h")[cut] != half:
        lags_to(n, now, cut, half)
    every_begin(plant, c, cut)
    every_drive(plant, c, cut)
    advance_bridges(plant, begin, begin + half)
    source, unit, halfway = field(now, "source"), field(now, "unit"), field(now, "halfway")
    halfway[g], halfway[g + 1] = unit[g], unit[g + 1]
    every_middle(plant, c, cut)
    for k in range(g + 2, now.n_s):
        source[k] = field(now, "source_next")[k]
    advance_bridges(plant, begin + half, end)
    every_end(plant, c, cut)
