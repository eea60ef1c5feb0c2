"""What a switched bridge does between two ticks: its gates, and the phases at every edge.

A period is gone through in short pieces, each of which ends at an edge, at the end of a dead time
or at the next of equal steps, so that the gates stay within a piece unless a peak-current limit
blocks them. Who watches keeps a copy of the plant and takes it back afterwards: the run goes on
with the bits that it has without.
"""

from __future__ import annotations

import math
from typing import Any

from numpy.typing import NDArray

from gfm_plant.layout import field
from gfm_plant.model import V_DC
from gfm_plant.period import advance
from gfm_plant.phases import along, frame_turn
from gfm_plant.records import I_F, I_O, PlantRecords, V
from gfm_plant.solution import circuit, mirror_sources, own
from gfm_runtime.compiled import cached, compiled

N_SEEN = 12  # columns of ``watch_period``
_LOADED = 1e-9  # s after the beginning of a unit, when its edges are known
_APART = 1e-12  # s; pieces are not shorter
_BEFORE = 1e-13  # s before an edge its piece ends: rounding must not take it beyond


@cached
def watch_period(
    plant: PlantRecords, steps: int, seen: NDArray[Any], gates: NDArray[Any]
) -> int:  # fmt: skip
    """Go on by one sampling period of a plant of one converter, with a switched bridge, from the
    tick's sample on.

    Args:
        plant: not one whose fault is just being cleared, phase by phase.
        steps: equal ones in which the period is seen at least.
        seen: (rows, 12): s since the tick; v_dc and the midpoint's displacement, p.u. of V_dcref;
            the phases of the current of L_f, of the voltage of C_f and of the line's current, p.u.
            of a phase's nominal peak value. Each row is the beginning of a piece, the last one the
            end of the period.
        gates: (rows, 3): the gates of the legs in each piece, see `gfm_plant.bridge`.

    Returns:
        How many pieces, one less than the rows; no more than there is room for.
    """
    n, now, s = plant.net[0], plant.now[0], plant.st[0]
    if field(n, "unbalanced")[circuit(n, now)]:
        mirror_sources(n, now, s.tick)
    row, at = 0, 0.0
    for unit in range(n.n_units):
        first = unit * n.unit_s
        last = n.T_s if unit == n.n_units - 1 else first + n.unit_s
        _see(plant, seen, row, first)
        at = first + _LOADED
        advance(plant, first, at)
        while at < last and row < len(seen) - 1:
            until = _next(plant, steps, first, at, last)
            advance(plant, at, until)
            for x in range(3):
                gates[row, x] = s.gate[x]
            row, at = row + 1, until
            _see(plant, seen, row, at)
    for x in range(3):
        gates[row, x] = s.gate[x]
    return row


@compiled
def _next(plant: PlantRecords, steps: int, first: float, at: float, last: float) -> float:
    """Return when the piece that begins at an instant of a unit ends, s since the tick."""
    n, r, s = plant.net[0], plant.par[0], plant.st[0]
    step = n.T_s / steps
    until = min(last, step * (math.floor((at + _APART) / step) + 1.0))
    for x in range(3):
        for edge in range(2):
            for more in range(3):  # a leg of three levels may have two dead times in a row
                turns = first + s.edges[x, edge] + more * r.dead - _BEFORE
                if at + _APART < turns < until:
                    until = turns
        turns = first + s.on_at[x] - _BEFORE
        if at + _APART < turns < until:
            until = turns
    return until if last - until > _APART else last


@compiled
def _see(plant: PlantRecords, seen: NDArray[Any], row: int, at: float) -> None:
    r, s, w = plant.par[0], plant.st[0], field(plant.now[0], "w")
    turn = frame_turn(plant, at)
    i, v, i_o = w[own(0) + I_F] * turn, w[own(0) + V] * turn, w[own(0) + I_O] * turn
    seen[row, 0], seen[row, 1], seen[row, 2] = at, s.x[V_DC], s.mid
    for x in range(3):
        seen[row, 3 + x] = r.current * along(x, i)
        seen[row, 6 + x] = along(x, v)
        seen[row, 9 + x] = r.current * along(x, i_o)
