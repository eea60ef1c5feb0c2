"""An averaged bridge in a network in which another one is switched.

Its voltage is a phasor that turns at the speed of its command, so that the series of the network
takes it as one more source. Nothing in the circuit sees its DC link before the next command is
limited by v_dc. So the link goes on behind the circuit: behind a `port` once a unit of the carrier,
else here from edge to edge of the switched bridges, as that of `gfm_plant.period` does from piece
to piece: the power that the bridge draws is a parabola through its values at the beginning, the
middle and the end.
"""

from typing import Any

from gfm_plant.dc_link import advance_dc_link
from gfm_plant.layout import field
from gfm_plant.model import V_DC
from gfm_plant.period import limit_voltage, take_command
from gfm_plant.phases import apply_counts
from gfm_plant.records import COMPARE, I_F, PlantRecords
from gfm_plant.solution import own
from gfm_plant.sparse import turned
from gfm_runtime.compiled import compiled, inlined


@compiled
def begin_average(plant: PlantRecords, k: int, c: int, unit: int) -> None:
    """Begin a unit of the carrier of the switched bridges: take the command that acts.

    Args:
        k: a converter with an averaged bridge, also below.
        c: the circuit in force, also below.
    """
    n, r, s = plant.net[0], plant.par[k], plant.st[k]
    take_command(plant, k, field(n, "unit_part")[unit])
    if s.trip == 0 and not s.u_now[COMPARE] < 0.0:
        apply_counts(plant, k, s.ahead, n.unit_s)
    limit_voltage(s, r.m_max * s.x[V_DC])
    set_average(plant, k, c)


@inlined
def set_average(plant: PlantRecords, k: int, c: int) -> None:
    """Set the source that the bridge is, in the frame of the series."""
    n, now, s = plant.net[0], plant.now[0], plant.st[k]
    frame = s.ahead * field(n, "axis")[c]
    field(now, "source")[k] = complex(s.E[0], s.E[1]) * frame
    field(now, "source_speed")[k] = n.omega_b * s.u_now[1]


@inlined
def drawn_along(plant: PlantRecords, k: int, h: float, terms: int, tau: float) -> None:
    """Set the power that the bridge draws at the beginning, the middle and the end of a part tau of
    an interval of h s; ``ends`` lead to its end."""
    now, r, s = plant.now[0], plant.par[k], plant.st[k]
    x, E = field(now, "terms"), field(now, "source")[k]
    half = turned(0.5 * tau * h * field(now, "source_speed")[k])
    at = own(k) + I_F
    i = x[terms, at]
    for j in range(terms - 1, -1, -1):
        z = x[j, at]
        i = complex(z.real + 0.5 * tau * i.real, z.imag + 0.5 * tau * i.imag)
    middle = E * half
    end = middle * half
    s.drawn[0] = r.current * (E.real * s.ends[0, 0] + E.imag * s.ends[0, 1])
    s.drawn[1] = r.current * (middle.real * i.real + middle.imag * i.imag)
    s.drawn[2] = r.current * (end.real * s.ends[1, 0] + end.imag * s.ends[1, 1])


@inlined
def advance_link(
    plant: PlantRecords, k: int, h: float, terms: int, tau: float
) -> tuple[float, float, float]:
    """Take the DC link on by a part tau of an interval of h s; returns v_dc at its beginning, in
    its middle and at its end."""
    r, s = plant.par[k], plant.st[k]
    drawn_along(plant, k, h, terms, tau)
    v_0 = s.x[V_DC]
    v_1, v_2 = advance_dc_link(r, s, 0.5 * tau * h)
    return v_0, v_1, v_2


@inlined
def average_rates(r: Any, s: Any) -> tuple[float, float]:
    """Return what the voltage at L_f and its current do to that current, 1/s; a bridge that blocks
    has none."""
    if s.trip != 0:
        return 0.0, 0.0
    per_L = r.omega_b / r.L_f
    return per_L / r.current, per_L * r.R_f
