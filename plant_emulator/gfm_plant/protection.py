"""Protection: thresholds with persistence, a latched trip, and the words for it."""

from __future__ import annotations

import math
from typing import Any

from gfm_plant.names import (
    BAD_COMMAND,
    CONTROLLER,
    CONTROLLER_SAFE,
    DIVERGED,
    NO_FRESH_U,
    SILENT,
    TRIP_REASONS,
    TRIPS,
)
from gfm_plant.records import PlantRecord
from gfm_plant.solution import I_F, circuit, enter
from gfm_runtime.compiled import compiled


@compiled
def trip(r: Any, s: Any, reason: int, value: float) -> None:
    """Latch a trip, if none is latched: the bridge blocks and the DC source turns off.

    The current of L_f is taken as interrupted at once. From here on the plant obeys no command;
    its frame turns with the grid.
    """
    if s.trip == 0:
        s.trip = reason
        s.trip_tick = s.tick
        s.trip_value = value
        s.x[0] = s.x[1] = s.w[I_F, 0] = s.w[I_F, 1] = s.i_source = s.E[0] = s.E[1] = 0.0
        enter(r, s, circuit(s))
        s.u_now[0], s.u_now[1], s.u_now[2], s.u_now[3] = 0.0, s.omega_g, 0.0, 0.0


@compiled
def protect(r: Any, s: Any) -> None:
    """Check every threshold on the true values of this tick."""
    i = math.sqrt(s.x[0] ** 2 + s.x[1] ** 2)
    V = math.sqrt(s.x[2] ** 2 + s.x[3] ** 2)
    v_dc = s.x[7]
    omega_u = s.u_now[1]
    _watch(r, s, 0, i, 1.0)
    _watch(r, s, 1, V, 1.0)
    _watch(r, s, 2, V, -1.0)
    _watch(r, s, 3, v_dc, 1.0)
    _watch(r, s, 4, v_dc, -1.0)
    _watch(r, s, 5, omega_u, 1.0)
    _watch(r, s, 6, omega_u, -1.0)


@compiled
def _watch(r: Any, s: Any, k: int, value: float, sign: float) -> None:
    if r.trip_ticks[k] < 0 or sign * (value - r.trip_limit[k]) <= 0.0:
        s.crossed[k] = 0
        return
    # The tick that first sees a crossing starts the time.
    if s.crossed[k] >= r.trip_ticks[k]:
        trip(r, s, k + 1, value)
    s.crossed[k] += 1


def trip_reason(st: PlantRecord, par: PlantRecord) -> str:
    """Say what tripped, with quantity, value, threshold and time; "" without a trip."""
    code, tick, value = int(st[0]["trip"]), int(st[0]["trip_tick"]), float(st[0]["trip_value"])
    if code == 0:
        return ""
    T_s = float(par[0]["T_s"])
    at = f"at tick {tick} (t = {tick * T_s:.6g} s)"
    if code == DIVERGED:
        return f"diverged: the state left the range of the model {at}"
    if code == BAD_COMMAND:
        return f"command not finite: u held {value} {at}"
    if code == CONTROLLER:
        return NO_FRESH_U if value == SILENT else CONTROLLER_SAFE
    _, quantity, sign = TRIPS[code - 1]
    limit = par[0]["trip_limit"][code - 1]
    persistence = int(par[0]["trip_ticks"][code - 1]) * T_s
    lasting = f" for {persistence:.6g} s" if persistence else ""
    return (
        f"{TRIP_REASONS[code]}: {quantity} = {value:.6g} p.u. {'>' if sign > 0 else '<'}"
        f" {limit:.6g} p.u.{lasting} {at}"
    )
