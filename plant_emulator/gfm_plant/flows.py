"""Currents and powers of a network's terminals, for the recording.

The functions are compiled and allocate nothing. Values are in p.u. of the first converter, but for
the currents of a fault's phases, which are in p.u. of its nominal peak value of a phase. The loops
reach them by an address in the plant's records: only who records a network compiles them.
"""

from typing import Any

from gfm_plant.clearing import contact_currents
from gfm_plant.components import every_flow
from gfm_plant.layout import field
from gfm_plant.records import PlantRecords
from gfm_plant.solution import grid_source, node_voltage
from gfm_runtime.by_address import call_at
from gfm_runtime.compiled import compiled, inlined


@compiled
def look_at_flows(plant: PlantRecords) -> None:
    """Write what is recorded of the terminals at this tick to ``flow_row``, in the order of
    `Wiring.recorded`: of each P, Q and its current, real and imaginary part, and the
    speed of what turns; of a fault the currents of its phases."""
    n, now, tick = plant.net[0], plant.now[0], plant.st[0].tick
    w, unit, source = field(now, "w"), field(now, "unit"), field(now, "flow_i")
    v, held, g = field(now, "flow_v"), field(n, "flow_held"), grid_source(n)
    for k in range(len(v)):
        v[k] = node_voltage(n, now, n.flow_first + k, tick)
        if held[k]:
            v[k] = now.V_g * (now.sequence[0] * unit[g] + now.sequence[1] * unit[g + 1])
    every_flow(plant, 0, 0)
    node, begin, at = field(n, "flow_node"), field(n, "flow_begin"), field(n, "flow_from")
    by, G, out, j = field(n, "flow_by"), field(n, "flow_G"), field(now, "flow_row"), 0
    turns, omega = field(n, "flow_turns"), field(now, "flow_omega")
    more = field(n, "flow_more")
    for k in range(len(node)):
        voltage = v[node[k]]
        i = complex(G[k] * voltage.real, G[k] * voltage.imag)
        for m in range(begin[k], begin[k + 1]):
            s = at[m] - n.n_states
            one = w[at[m]] if s < 0 else source[s]
            i += complex(by[m] * one.real, by[m] * one.imag)
        power = voltage * i.conjugate()
        out[j], out[j + 1], out[j + 2], out[j + 3] = power.real, power.imag, i.real, i.imag
        j += 4
        if turns[k] >= 0:
            out[j] = omega[turns[k]]
            j += 1
        j += more[k]
    if n.flow_fault != 0:
        out[j] = out[j + 1] = out[j + 2] = 0.0
        if n.flow_fault > 1 and (now.contact != 0 or now.joint != 0):
            out[j], out[j + 1], out[j + 2] = contact_currents(plant, 0.0, 0)


@inlined
def plant_flows(plant: PlantRecords, out: Any) -> None:
    """Write what is recorded of the network at this tick to out, (columns,); nothing if that has no
    room."""
    if len(out) > 0:
        call_at(plant.net[0].look, plant.net[0].records, 0.0, 0.0)
        row = field(plant.now[0], "flow_row")
        for j in range(len(out)):
            out[j] = row[j]
