"""Faults that are cleared and breakers that open: each phase opens where its current passes zero.

The zero lies between two ticks. The plant goes back to the beginning of the tick, or to the opening
before, and tries the time of the zero until the current vanishes there: the circuit is solved
exactly at every time, so this is the zero to rounding.
"""

import math
from typing import Any

from gfm_plant.joint import drop_dead, fault_phases
from gfm_plant.layout import field
from gfm_plant.period import advance, go_back, keep
from gfm_plant.phases import frame_turn
from gfm_plant.records import PlantRecords
from gfm_plant.solution import circuit, enter, mirror_sources
from gfm_runtime.compiled import compiled, inlined

_NOTHING = 1e-9  # p.u.; a phase that carries no more may open at any time
_ZERO = 1e-12  # p.u.; how near to zero a current is interrupted
_TRIES = 60


@compiled
def begin_clearing(n: Any, now: Any) -> bool:
    """Clear the fault, or have each of its phases open as soon as it can; returns whether the fault
    is gone at once."""
    now.fault_left = math.inf
    if now.joint:
        conducts = field(now, "conducts")
        field(now, "opens")[0] = n.at_zeros
        for p in range(3):
            conducts[0, p] *= n.at_zeros
        now.made, now.contact = 0, now.contact * n.at_zeros
        return n.at_zeros == 0
    follows = field(n, "opens_to")[now.contact]
    now.clearing = 1 if max(follows[0], follows[1], follows[2]) >= 0 else 0
    if now.clearing == 0:
        now.contact = 0
    return now.clearing == 0


@compiled
def advance_clearing(plant: PlantRecords) -> None:
    """Go on by one sampling period, from a plant that has just been kept, while phases open."""
    n, now, begin = plant.net[0], plant.now[0], 0.0
    while now.clearing:
        _keep_currents(plant, begin, 0)
        advance(plant, begin, math.inf)
        _keep_currents(plant, n.T_s, 1)
        first, which, phase, i = math.inf, -1, -1, field(now, "carried")
        for j in range(n.poles + 1 if now.joint else 1):
            for p in range(3):
                if _may_open(n, now, j, p) and _passes(i[0, j, p], i[1, j, p]):
                    at = _find_zero(plant, j, p, begin, i[0, j, p], i[1, j, p])
                    if at < first:
                        first, which, phase = at, j, p
        if which < 0:
            return
        _go_to(plant, begin, first)
        if now.joint:
            _open_joint(plant, which, phase, first)
        else:
            _open(plant, phase, first)
        keep(plant)
        begin = first
    advance(plant, begin, math.inf)


@inlined
def _may_open(n: Any, now: Any, j: int, p: int) -> bool:
    if now.joint:
        return field(now, "opens")[j] * field(now, "conducts")[j, p] != 0
    return field(n, "opens_to")[now.contact, p] >= 0


@compiled
def _keep_currents(plant: PlantRecords, at: float, which: int) -> None:
    n, i = plant.net[0], field(plant.now[0], "carried")
    for j in range(n.poles + 1):
        i[which, j, 0], i[which, j, 1], i[which, j, 2] = contact_currents(plant, at, j)


@compiled
def _passes(before: float, after: float) -> bool:
    return before * after <= 0.0 or (abs(before) < _NOTHING and abs(after) < _NOTHING)


@compiled
def _find_zero(plant: PlantRecords, j: int, p: int, begin: float, f_a: float, f_b: float) -> float:
    """Return when the current of phase p of contact j is zero, s after the beginning of the period,
    by false position (the Illinois form) between ``begin`` and its end, where it is f_a, f_b.
    """
    if abs(f_a) < _NOTHING:
        return begin
    a, b, side = begin, plant.net[0].T_s, 0
    for _ in range(_TRIES):
        at = (a * f_b - b * f_a) / (f_b - f_a)
        _go_to(plant, begin, at)
        f = contact_currents(plant, at, j)[p]
        if abs(f) < _ZERO:
            return at
        if f * f_b > 0.0:
            b, f_b = at, f
            f_a *= 0.5 if side == 1 else 1.0
            side = 1
        else:
            a, f_a = at, f
            f_b *= 0.5 if side == -1 else 1.0
            side = -1
    return b


@compiled
def _go_to(plant: PlantRecords, begin: float, at: float) -> None:
    """Go back to ``begin``, where the plant was kept, and on to another instant of the period."""
    go_back(plant)
    _enter(plant, begin)
    advance(plant, begin, at)


@compiled
def _enter(plant: PlantRecords, at: float) -> None:
    """Start the modes of the circuit in force at an instant of the period."""
    n, now = plant.net[0], plant.now[0]
    c, tick = circuit(n, now), plant.st[0].tick + at / n.T_s
    if field(n, "unbalanced")[c]:
        mirror_sources(n, now, tick)
    enter(n, now, tick, c)


@compiled
def _open(plant: PlantRecords, p: int, at: float) -> None:
    """Interrupt phase p. What flows on through the contact has to be passed to the circuit of what
    is left, where it may be a state of its own."""
    n, now = plant.net[0], plant.now[0]
    _pass_on(plant, at)
    now.contact = field(n, "opens_to")[now.contact, p]
    now.clearing = 1 if now.contact else 0
    _enter(plant, at)


@compiled
def _pass_on(plant: PlantRecords, at: float) -> None:
    """Set the contact's own current, if it may become a state, to what flows through it now."""
    n = plant.net[0]
    if n.contact_w >= 0:
        i_a, i_b, i_c = contact_currents(plant, at, 0)
        vector = complex((2.0 * i_a - i_b - i_c) / 3.0, (i_b - i_c) / math.sqrt(3.0))
        field(plant.now[0], "w")[n.contact_w] = vector * frame_turn(plant, at).conjugate()


@compiled
def _open_joint(plant: PlantRecords, j: int, p: int, at: float) -> None:
    """Interrupt phase p of one of several contacts. When no pole is left the circuit is that of the
    fault alone, or of none."""
    n, now = plant.net[0], plant.now[0]
    conducts, opens = field(now, "conducts"), field(now, "opens")
    conducts[j, p], now.made = 0, 0
    drop_dead(n, now)
    now.clearing, now.joint = 0, 0
    for i in range(n.poles + 1):
        for x in range(3):
            now.clearing |= opens[i] * conducts[i, x]
            now.joint |= conducts[i, x] * (i > 0)
    now.contact = field(n, "contact_of")[fault_phases(now)]
    if not now.joint:
        now.joint = 1
        _pass_on(plant, at)
        now.joint = 0
    _enter(plant, at)


@compiled
def contact_currents(plant: PlantRecords, at: float, j: int) -> tuple[float, float, float]:
    """Return the currents of phases a, b, c through contact j, of several or the only one, at an
    instant of the period."""
    n, now = plant.net[0], plant.now[0]
    by_w, w, turn = field(n, "contact_current")[now.contact], field(now, "w"), frame_turn(plant, at)
    if now.joint:
        by_w = (
            field(n, "pole_carries")[j - 1] if j else field(n, "fault_carries")[fault_phases(now)]
        )
    i_a = i_b = i_c = 0j
    for i in range(n.n_states):
        i_a += by_w[0, i] * w[i]
        i_b += by_w[1, i] * w[i]
        i_c += by_w[2, i] * w[i]
    return (i_a * turn).real, (i_b * turn).real, (i_c * turn).real
