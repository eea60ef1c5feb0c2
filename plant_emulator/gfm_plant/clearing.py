"""Faults that are cleared and breakers that open: each phase opens where its current passes zero.

The zero lies between two ticks. The plant goes back to the beginning of the tick, or to the opening
before, and tries the time of the zero until the current vanishes there: the circuit is solved
exactly at every time, so this is the zero to rounding.
"""

from __future__ import annotations

import math
from typing import Any

from gfm_plant.going_on import advance
from gfm_plant.layout import field
from gfm_plant.period import go_back, keep
from gfm_plant.records import PlantRecords
from gfm_plant.solution import circuit, enter, mirror_sources
from gfm_runtime.compiled import compiled

_NOTHING = 1e-9  # p.u.; a phase that carries no more may open at any time
_ZERO = 1e-12  # p.u.; how near to zero a current is interrupted
_TRIES = 60


@compiled
def begin_clearing(n: Any, now: Any) -> bool:
    """Clear the fault, or have each of its phases open as soon as it can; returns whether the fault
    is gone at once."""
    now.fault_left = math.inf
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
        before = _currents(plant, begin)
        advance(plant, begin, math.inf)
        after = _currents(plant, n.T_s)
        first, which = math.inf, -1
        for p in range(3):
            if field(n, "opens_to")[now.contact, p] >= 0 and _passes(before[p], after[p]):
                at = _find_zero(plant, p, begin, before[p], after[p])
                if at < first:
                    first, which = at, p
        if which < 0:
            return
        _go_to(plant, begin, first)
        _open(plant, which, first)
        keep(plant)
        begin = first
    advance(plant, begin, math.inf)


@compiled
def _passes(before: float, after: float) -> bool:
    return before * after <= 0.0 or (abs(before) < _NOTHING and abs(after) < _NOTHING)


@compiled
def _find_zero(plant: PlantRecords, p: int, begin: float, f_a: float, f_b: float) -> float:
    """Return when the current of phase p is zero, s after the beginning of the period, by false
    position (the Illinois form) between ``begin`` and the end of the period, where it is f_a, f_b.
    """
    if abs(f_a) < _NOTHING:
        return begin
    a, b, side = begin, plant.net[0].T_s, 0
    for _ in range(_TRIES):
        at = (a * f_b - b * f_a) / (f_b - f_a)
        _go_to(plant, begin, at)
        f = _currents(plant, at)[p]
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
    i_a, i_b, i_c = _currents(plant, at)
    now.contact = field(n, "opens_to")[now.contact, p]
    now.clearing = 1 if now.contact else 0
    if n.contact_w >= 0:
        vector = complex((2.0 * i_a - i_b - i_c) / 3.0, (i_b - i_c) / math.sqrt(3.0))
        field(now, "w")[n.contact_w] = vector * _turn(plant, at).conjugate()
    _enter(plant, at)


@compiled
def _currents(plant: PlantRecords, at: float) -> tuple[float, float, float]:
    """Return the currents of phases a, b, c through the contact at an instant of the period."""
    n, now = plant.net[0], plant.now[0]
    by_w, w, turn = field(n, "contact_current"), field(now, "w"), _turn(plant, at)
    i_a = i_b = i_c = 0j
    for i in range(n.n_states):
        i_a += by_w[now.contact, 0, i] * w[i]
        i_b += by_w[now.contact, 1, i] * w[i]
        i_c += by_w[now.contact, 2, i] * w[i]
    return (i_a * turn).real, (i_b * turn).real, (i_c * turn).real


@compiled
def _turn(plant: PlantRecords, at: float) -> complex:
    """Return e^(j omega_b t): from the common frame to the one that stands still."""
    n = plant.net[0]
    angle = n.omega_b * (n.T_s * plant.st[0].tick + at)
    return complex(math.cos(angle), math.sin(angle))
