"""The grid simulator: its events, called between two ticks, and its ramps, advanced every tick.

Frequencies and voltages are in p.u., times in s. An event acts from the coming tick on.
"""

from __future__ import annotations

import math
from typing import Any

from gfm_plant.build import check_sub_step
from gfm_plant.model import DELTA
from gfm_plant.records import PlantRecord
from gfm_runtime.compiled import compiled


def grid_frequency(st: PlantRecord, omega_g: float, rate: float | None = None) -> None:
    """Step the grid frequency to `omega_g`, or ramp it there at `rate` (p.u./s, > 0)."""
    _require("omega_g", omega_g, omega_g > 0, "> 0 p.u.")
    st["omega_g_to"], st["omega_g_rate"] = omega_g, _rate(rate)
    if rate is None:
        st["omega_g"] = omega_g


def grid_voltage(
    st: PlantRecord, V_g: float, rate: float | None = None, duration: float | None = None
) -> None:
    """Step the grid voltage to `V_g`, ramp it there, or let it sag and recover.

    Args:
        st: State record.
        V_g: Voltage in p.u., >= 0.
        rate: Slope of a ramp in p.u./s, > 0.
        duration: Length of a sag in s, > 0, after which the voltage steps back to where it
            was, or was going. A sag within a sag recovers to the voltage before both; a step or
            ramp within a sag cancels the recovery.

    Raises:
        ValueError: If a value is out of range, or both `rate` and `duration` are given.
    """
    _require("V_g", V_g, V_g >= 0, ">= 0 p.u.")
    if rate is not None and duration is not None:
        raise ValueError(f"rate = {rate}, duration = {duration}: give one, a ramp or a sag")
    if duration is None:
        st["sag_left"] = 0.0
    else:
        _require("duration", duration, duration > 0, "> 0 s")
        if st[0]["sag_left"] == 0.0:
            st["V_g_after"] = st["V_g_to"]
        st["sag_left"] = duration
    st["V_g_to"], st["V_g_rate"] = V_g, _rate(rate)
    if rate is None:
        st["V_g"] = V_g


def phase_jump(st: PlantRecord, degrees: float) -> None:
    """Advance the grid's angle by `degrees`, so that delta falls by as much."""
    _require("degrees", degrees, True, "finite")
    st["x"][0, DELTA] -= math.radians(degrees)


def grid_impedance(par: PlantRecord, st: PlantRecord, L_g: float, R_g: float) -> None:
    """Set the line to `L_g` and `R_g` times the elements of the converter file.

    Its current is continuous. Factors of the options are not applied on top.

    Raises:
        ValueError: If L_g <= 0 or R_g < 0, or the line becomes too fast for the sub-step. The
            plant is then unchanged.
    """
    _require("L_g", L_g, L_g > 0, "a factor > 0")
    _require("R_g", R_g, R_g >= 0, "a factor >= 0")
    before = par.copy()
    par["L_line"], par["R_line"] = L_g * par["L_line_n"], R_g * par["R_line_n"]
    _connect(par, st)
    try:
        check_sub_step(par)
    except ValueError:
        par[:] = before
        raise


def breaker(par: PlantRecord, st: PlantRecord, closed: bool) -> None:
    """Open or close the breaker between the grid and the local load at the far end of the line.

    While it is closed the grid alone sets the load's voltage. When it opens, line and load are in
    series, and what current they share follows from the flux that both held:
    (L_g i_o + L_load i_load) / (L_g + L_load). The angle delta stays that to the grid, so closing
    again meets whatever phase has built up.

    Raises:
        ValueError: If it opens onto no load.
    """
    if closed == bool(st[0]["closed"]):
        return
    i_o, i_load = st["x"][0, 4:6], st["i_load"][0]  # views
    if closed:
        i_load[:] = i_o
    else:
        L_line, L_load = par[0]["L_line"], par[0]["L_load"]
        if L_load == 0:
            raise ValueError(
                "plant.grid.load_R, plant.grid.load_L: not set; the breaker opens only onto a load"
            )
        i_o[:] = (L_line * i_o + L_load * i_load) / (L_line + L_load)
    st["closed"] = closed
    _connect(par, st)


@compiled
def advance_grid(r: Any, s: Any) -> None:
    """Move ramps and sags on by one tick."""
    T_s = r.T_s
    s.omega_g = _towards(s.omega_g, s.omega_g_to, s.omega_g_rate * T_s)
    s.V_g = _towards(s.V_g, s.V_g_to, s.V_g_rate * T_s)
    if s.sag_left > 0.0:
        s.sag_left -= T_s
        if s.sag_left < 0.5 * T_s:  # half a tick of slack absorbs the rounding of the sum
            s.sag_left = 0.0
            s.V_g = s.V_g_to = s.V_g_after


@compiled
def _towards(value: float, goal: float, most: float) -> float:
    """Move `value` towards `goal` by at most `most`."""
    return min(value + most, goal) if value < goal else max(value - most, goal)


def _connect(par: PlantRecord, st: PlantRecord) -> None:
    """Set the path of i_o: the line, and behind an open breaker the load in series with it."""
    islanded = not st[0]["closed"]
    par["L_g"] = par["L_line"] + islanded * par["L_load"]
    par["R_g"] = par["R_line"] + islanded * par["R_load"]


def _rate(rate: float | None) -> float:
    if rate is None:
        return math.inf
    _require("rate", rate, rate > 0, "> 0 p.u./s")
    return rate


def _require(name: str, value: float, holds: bool, allowed: str) -> None:
    if not (holds and math.isfinite(value)):
        raise ValueError(f"{name} = {value}: must be {allowed}")
