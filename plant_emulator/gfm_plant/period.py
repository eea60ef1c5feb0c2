"""One sampling period: its stretches between the instants at which a command begins to act, and the
pieces of these.

The functions are as those of `gfm_plant.emulator`.
"""

import math
from typing import Any

from gfm_plant.components import (
    GO_BACK,
    KEEP,
    call_components,
    every_begin,
    every_drive,
    every_end,
    every_middle,
)
from gfm_plant.dc_link import advance_dc_link
from gfm_plant.layout import field
from gfm_plant.model import DELTA, V_DC, terminal
from gfm_plant.phases import apply_counts, frame_turn
from gfm_plant.records import COMPARE, I_F, I_O, N_COMMANDS, PlantRecords, V
from gfm_plant.solution import (
    circuit,
    clear_forced,
    cut_to,
    drive,
    grid_source,
    half_step,
    own,
    read_states,
    state,
)
from gfm_runtime.by_address import call_at
from gfm_runtime.compiled import compiled, inlined, inlined_as


@inlined
def advance(plant: PlantRecords, begin: float, end: float) -> None:
    """Go on between two instants of the period, s after its beginning; inf: to its end.

    It reaches the plant's way by an address in its records, see `ways`."""
    call_at(plant.net[0].advance, plant.net[0].records, begin, end)


@inlined
def keep(plant: PlantRecords) -> None:
    """Keep what `go_back` takes the plant back to."""
    n, now = plant.net[0], plant.now[0]
    for k in range(n.n_converters):
        s = plant.st[k]
        s.before[0], s.before[1], s.before[2], s.before[3] = (
            s.x[DELTA], s.x[V_DC], s.i_reg, s.i_source
        )  # fmt: skip
        for j in range(4):
            s.before[4 + j] = s.sensed[j]
        s.before[8], s.before[9], s.before[10] = s.E_most, s.E_commanded[0], s.E_commanded[1]
        s.before[11] = s.soc
        if n.n_units:
            _keep_legs(s)
    unit, unit_before = field(now, "unit"), field(now, "unit_before")
    for k in range(now.n_s):
        unit_before[k] = unit[k]
    w, w_before = field(now, "w"), field(now, "w_before")
    for i in range(n.n_states):
        w_before[i] = w[i]
    call_components(plant, KEEP, circuit(n, now))


@compiled
def go_back(plant: PlantRecords) -> None:
    """Take back what has come since `keep`; the modes are to be entered again."""
    n, now = plant.net[0], plant.now[0]
    for k in range(n.n_converters):
        s = plant.st[k]
        s.x[DELTA], s.x[V_DC], s.i_reg, s.i_source = (
            s.before[0], s.before[1], s.before[2], s.before[3]
        )  # fmt: skip
        for j in range(4):
            s.sensed[j] = s.before[4 + j]
        s.E_most, s.E_commanded[0], s.E_commanded[1] = s.before[8], s.before[9], s.before[10]
        s.soc = s.before[11]
        if n.n_units:
            _legs_go_back(s)
    unit, unit_before = field(now, "unit"), field(now, "unit_before")
    for k in range(now.n_s):
        unit[k] = unit_before[k]
    w, w_before = field(now, "w"), field(now, "w_before")
    for i in range(n.n_states):
        w[i] = w_before[i]
    call_components(plant, GO_BACK, circuit(n, now))


@inlined
def _keep_legs(s: Any) -> None:
    b = s.legs_before
    for x in range(3):
        b[0, x], b[1, x], b[2, x], b[3, x] = s.gate[x], s.level[x], s.on_at[x], s.base[x]
        b[4, x], b[5, x] = s.edges[x, 0], s.edges[x, 1]
    b[6, 0], b[6, 1], b[6, 2] = s.mid, s.limit, s.winds


@inlined
def _legs_go_back(s: Any) -> None:
    b = s.legs_before
    for x in range(3):
        s.gate[x], s.level[x], s.base[x] = int(b[0, x]), int(b[1, x]), int(b[3, x])
        s.on_at[x], s.edges[x, 0], s.edges[x, 1] = b[2, x], b[4, x], b[5, x]
    s.mid, s.limit, s.winds = b[6, 0], b[6, 1], b[6, 2]


@inlined
def take_command(plant: PlantRecords, k: int, part: int) -> None:
    """Set the command that acts in a stretch; a blocked bridge turns as the grid does."""
    n, now, s = plant.net[0], plant.now[0], plant.st[k]
    if s.trip == 0:
        for j in range(N_COMMANDS):
            s.u_now[j] = s.u[field(n, "age")[part, k], j]
        if n.n_units == 0 and not s.u_now[COMPARE] < 0.0:
            begin = 0.0
            for before in range(part):
                begin += field(n, "stretch")[before]
            frame = field(now, "unit")[k] * frame_turn(plant, begin)
            apply_counts(plant, k, frame, field(n, "stretch")[part])
    else:
        s.u_now[1] = now.omega_g + 0.5 * n.T_s * now.omega_g_slope  # see `trip`


@inlined
def limit_voltage(s: Any, most: float) -> None:
    """Set the bridge's voltage by the command that acts, within what the DC link gives."""
    s.E_most = most
    s.E[0], s.E[1] = s.u_now[2], s.u_now[3]
    size = s.E[0] * s.E[0] + s.E[1] * s.E[1]
    if size > most * most:
        scale = most / math.sqrt(size)
        s.E[0] *= scale
        s.E[1] *= scale
    s.E_commanded[0], s.E_commanded[1] = s.E[0], s.E[1]


@compiled
def _may_peak(plant: PlantRecords, k: int, part: int) -> bool:
    """Return whether the current of L_f might come near its limit in a stretch of length h.

    With a = omega_b h / L_f and b = omega_b h / C_f it moves by at most a |E - v| +
    a b / 2 |i - i_o|, as without losses i - i_o and v swing against each other; the fifth of the
    limit that is left is for what i_o does meanwhile. A fault at the terminal takes v at once.
    """
    n, now, r, s = plant.net[0], plant.now[0], plant.par[k], plant.st[k]
    if not r.i_peak < math.inf or s.trip != 0:
        return False
    if now.contact or now.joint:
        return True
    w, at = field(now, "w"), own(k)
    E = complex(s.E_commanded[0], s.E_commanded[1]) * field(now, "unit")[k] - w[at + V]
    h = r.omega_b * field(n, "stretch")[part]
    a, b = h / r.L_f, h / r.C_f
    size = r.current * length(w[at + I_F]) + a * length(E)
    size += 0.5 * a * b * r.current * length(w[at + I_F] - w[at + I_O])
    return not size < 0.8 * r.i_peak


@inlined
def length(z: complex) -> float:
    """Return |z|; quicker than abs(z), which minds overflow."""
    return math.sqrt(z.real * z.real + z.imag * z.imag)


@compiled
def _within_peak(plant: PlantRecords, k: int, part: int) -> tuple[float, float]:
    """Return the bridge's mean voltage over a piece, in the converter's frame.

    It is the command, unless the current of L_f would leave the limit. The hardware then blocks
    pulses, which on average gives the voltage that keeps the current at the limit, in the direction
    in which the command would have led it.
    """
    n, now, r, s = plant.net[0], plant.now[0], plant.par[k], plant.st[k]
    E_d, E_q, most = s.E_commanded[0], s.E_commanded[1], s.E_most
    back = field(now, "unit")[k].conjugate()
    i, v = field(now, "w")[own(k) + I_F], field(now, "w")[own(k) + V] * back
    i = complex(i.real * r.current, i.imag * r.current) * back
    X = s.u_now[1] * r.L_f
    drop_d = v.real + r.R_f * i.real - X * i.imag
    drop_q = v.imag + r.R_f * i.imag + X * i.real
    half_h = field(n, "half_h")[part]
    reach = 2.0 * half_h * r.omega_b / r.L_f  # p.u. of current per p.u. of voltage
    to_d, to_q = i.real + reach * (E_d - drop_d), i.imag + reach * (E_q - drop_q)
    size = math.sqrt(to_d * to_d + to_q * to_q)
    if size <= r.i_peak:
        return E_d, E_q
    scale = r.i_peak / size
    E_d = drop_d + (to_d * scale - i.real) / reach
    E_q = drop_q + (to_q * scale - i.imag) / reach
    size = math.sqrt(E_d * E_d + E_q * E_q)
    if size > most:
        E_d, E_q = E_d * most / size, E_q * most / size
    return E_d, E_q


@inlined
def _look(plant: PlantRecords, k: int, which: int, unit: complex) -> None:
    """Keep the power that bridge k draws, p.u., and what its sensors see at the beginning (0), the
    middle (1) or the end (2) of a piece, when its frame is at ``unit``."""
    r, s, w, at = plant.par[k], plant.st[k], field(plant.now[0], "w"), own(k)
    i, v, i_o = w[at + I_F], w[at + V], w[at + I_O]
    turned = unit.conjugate() * complex(i.real * r.current, i.imag * r.current)
    s.drawn[which] = s.E[0] * turned.real + s.E[1] * turned.imag
    if r.filtered:
        s.seen[which, 0], s.seen[which, 1], s.seen[which, 2] = terminal(
            v.real, v.imag, i_o.real * r.current, i_o.imag * r.current
        )


@inlined
def _sense(n: Any, s: Any, k: int, j: int, part: int, f_0: float, f_1: float, f_2: float) -> None:
    """Pass a quantity through the low-pass of sensor j of converter k."""
    weights = field(n, "lag_weights")
    s.sensed[j] = (
        weights[part, k, 0] * s.sensed[j]
        + weights[part, k, 1] * f_0
        + weights[part, k, 2] * f_1
        + weights[part, k, 3] * f_2
    )


def _make_way(kind: str, *hooks: Any) -> Any:
    """A function (plant, begin, end) that goes on between two instants, s after the period's
    beginning; inf: to its end.

    Args:
        kind: of plants that they are for.
        hooks: of its components: at the beginning of a piece, where its sources act, in its middle
            and at its end.
    """
    piece = inlined_as(f"piece_{kind}", _make_piece(*hooks))
    stretch = inlined_as(f"stretch_{kind}", _make_stretch(piece))

    def go_on_between(plant: PlantRecords, begin: float, end: float) -> None:
        n, starts = plant.net[0], 0.0
        for part in range(n.n_parts):
            ends = starts + field(n, "stretch")[part]
            whole = begin <= starts and ends <= end
            if whole or (starts < end and begin < ends):
                h = math.inf if whole else min(ends, end) - max(starts, begin)
                stretch(plant, part, begin <= starts, h)
            starts = ends

    return inlined_as(f"advance_{kind}", go_on_between)


def _make_piece(begin_all: Any, drive_all: Any, at_middle: Any, end_all: Any) -> Any:
    """A function (plant, c, part) that solves circuit c over a piece of a part of the period."""

    def go_on_by_piece(plant: PlantRecords, c: int, part: int) -> None:
        n, now = plant.net[0], plant.now[0]
        omega_g = now.omega_g + 0.5 * n.T_s * now.omega_g_slope  # in the middle of the tick
        w, half_h = field(now, "w"), field(n, "half_h")[part]
        clear_forced(n, now, c)
        begin_all(plant, c, part)
        for k in range(n.n_converters):
            s = plant.st[k]
            _look(plant, k, 0, field(now, "unit")[k])
            drive(n, now, c, part, k, complex(s.E[0], s.E[1]), s.u_now[1])
        for sequence in range(2 if now.unbalance_left > 0.0 else 1):
            E = now.sequence[sequence]
            E = complex(now.V_g * E.real, now.V_g * E.imag)
            omega = omega_g if sequence == 0 else -omega_g
            drive(n, now, c, part, grid_source(n) + sequence, E, omega)
        drive_all(plant, c, part)

        half_step(n, now, c, part, 0)
        at_middle(plant, c, part)
        for k in range(n.n_converters):
            for i in range(own(k), own(k) + (3 if plant.par[k].filtered else 1)):
                w[i] = state(n, now, c, i)
            _look(plant, k, 1, field(now, "halfway")[k])

        half_step(n, now, c, part, 1)
        read_states(n, now, c)
        end_all(plant, c, part)
        for k in range(n.n_converters):
            _look(plant, k, 2, field(now, "unit")[k])
            r, s = plant.par[k], plant.st[k]
            v_0 = s.x[V_DC]
            v_1, v_2 = advance_dc_link(r, s, half_h)
            if r.filtered:
                _sense(n, s, k, 0, part, v_0, v_1, v_2)
                for j in range(3):
                    _sense(n, s, k, 1 + j, part, s.seen[0, j], s.seen[1, j], s.seen[2, j])
            s.x[DELTA] += 2.0 * half_h * n.omega_b * (s.u_now[1] - omega_g)

    return go_on_by_piece


def _make_stretch(piece: Any) -> Any:
    """A function (plant, part, begins, h) that goes on by a stretch with its commands; h: how long,
    s, inf: all of it."""

    def go_on_by_stretch(plant: PlantRecords, part: int, begins: bool, h: float) -> None:
        n, now, peaks = plant.net[0], plant.now[0], False
        for k in range(n.n_converters):
            take_command(plant, k, part)
            s = plant.st[k]
            if begins:  # the modulator divides by the v_dc that it has then
                limit_voltage(s, plant.par[k].m_max * s.x[V_DC])
            else:
                s.E[0], s.E[1] = s.E_commanded[0], s.E_commanded[1]
        for k in range(n.n_converters):
            peaks = _may_peak(plant, k, part) or peaks
        c, cut = circuit(n, now), part + (n.n_parts if peaks else 0)
        if h < math.inf:
            cut = cut_to(n, now, c, h, 2.0 * field(n, "half_h")[cut])
        for _ in range(field(n, "pieces")[cut]):
            if peaks:
                for k in range(n.n_converters):
                    s = plant.st[k]
                    if plant.par[k].i_peak < math.inf and s.trip == 0:
                        s.E[0], s.E[1] = _within_peak(plant, k, cut)
            piece(plant, c, cut)

    return go_on_by_stretch


@inlined
def _none(plant: PlantRecords, c: int, part: int) -> None:
    return


advance_alone = _make_way("alone", _none, _none, _none, _none)
#: the same for a plant with components that have records
advance_with_components = _make_way(
    "with_components", every_begin, every_drive, every_middle, every_end
)
