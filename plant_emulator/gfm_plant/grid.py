"""The events of the grid simulator, called between two ticks.

Frequencies and voltages are in p.u., times in s. An event acts from the coming tick on.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence

from gfm_plant.build import connect
from gfm_plant.emulator import reconnect
from gfm_plant.model import DELTA
from gfm_plant.records import PlantRecord
from gfm_plant.solution import GRID, I_G, I_O, NEGATIVE

LEAST_FAULT_R = 1e-4
"""p.u., at a capacitor: a metallic short circuit there would discharge it in no time."""


def grid_frequency(
    par: PlantRecord, st: PlantRecord, omega_g: float, rate: float | None = None
) -> None:
    """Step the frequency of an ideal grid to `omega_g`, or ramp it there at `rate` (p.u./s, > 0).

    Raises:
        ValueError: If a value is out of range, or the grid is finite and has its own frequency.
    """
    if par[0]["H_grid"] > 0:
        raise ValueError("plant.grid.finite: such a grid sets its own frequency; use grid-load")
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


def grid_load(par: PlantRecord, st: PlantRecord, change: float) -> None:
    """Add `change` to the load of a finite grid, p.u. of the grid's rating.

    Raises:
        ValueError: If the grid is ideal, or `change` is not finite.
    """
    _require("change", change, True, "finite")
    if par[0]["H_grid"] == 0:
        raise ValueError("plant.grid.finite: not set; an ideal grid has no load of its own")
    st["P_load"] += change


def fault(
    par: PlantRecord, st: PlantRecord, position: float, R: float, duration: float | None = None
) -> None:
    """Short the three phases to ground through `R`.

    Args:
        position: Place on the line: 0 at the filter capacitor, 1 at the grid.
        R: Resistance of the fault, p.u.; > 0 at the filter capacitor.
        duration: Time until the fault is cleared, s; None: `clear_fault` clears it.

    Raises:
        ValueError: If a value is out of range. The plant is then unchanged.
    """
    _require("position", position, 0 <= position < 1, "in [0, 1)")
    least = 0.0 if position > 0 else LEAST_FAULT_R
    _require("R", R, least <= R, f">= {least:g} p.u. at position {position:g}")
    if duration is not None:
        _require("duration", duration, duration > 0, "> 0 s")
    whole = par[0]["fault_at"] <= 0
    _rebuild(par, bool(st[0]["closed"]), fault_at=position, fault_R=R)
    if whole:  # the line was in one piece
        st["w"][0, I_G] = st["w"][0, I_O]
    st["faulted"], st["fault_left"] = 1, math.inf if duration is None else duration
    reconnect(par, st)


def clear_fault(par: PlantRecord, st: PlantRecord) -> None:
    """Clear the fault, if there is one."""
    st["faulted"] = 0
    reconnect(par, st)


def grid_unbalance(
    par: PlantRecord,
    st: PlantRecord,
    phases: Sequence[complex],
    duration: float | None = None,
) -> None:
    """Multiply the three phase voltages of the grid; (1, 1, 1) makes them equal again.

    Their positive sequence is (a + b + c) / 3 of what it was, and they have a negative sequence of
    (a + b e^(j 120 deg) + c e^(-j 120 deg)) / 3. A zero sequence finds no path: the converter has
    three wires.

    Args:
        phases: Factors of phases a, b, c: their length is the retained voltage, their angle a jump
            of that phase.
        duration: Time until they are equal again, s; None: until another call.

    Raises:
        ValueError: If a value is out of range. The plant is then unchanged.
    """
    a, b, c = phases
    for value in phases:
        _require("phases", abs(value), True, "finite")
    if duration is not None:
        _require("duration", duration, duration > 0, "> 0 s")
    turn = complex(-0.5, math.sqrt(0.75))
    positive, negative = (a + b + c) / 3, (a + turn * b + turn.conjugate() * c) / 3
    st["sequence"][0] = [
        [positive.real, positive.imag],
        # of the space vector v = v+ e^(j omega t) + conj(v-) e^(-j omega t)
        [negative.real, -negative.imag],
    ]
    # what turns the other way, in a frame that turns with omega_b
    r, s = par[0], st[0]
    angle = 2 * math.remainder(float(r["omega_b"] * r["T_s"]) * int(s["tick"]), math.pi)
    unit = complex(s["unit"][GRID, 0], -s["unit"][GRID, 1]) * cmath.exp(-1j * angle)
    st["unit"][0, NEGATIVE] = unit.real, unit.imag
    balanced = a == b == c == 1
    st["unbalance_left"] = 0.0 if balanced else math.inf if duration is None else duration


def phase_jump(st: PlantRecord, degrees: float) -> None:
    """Advance the grid's angle by `degrees`, so that delta falls by as much."""
    _require("degrees", degrees, True, "finite")
    angle = math.radians(degrees)
    st["x"][0, DELTA] -= angle
    for place, turn in ((GRID, angle), (NEGATIVE, -angle)):
        unit = complex(*st["unit"][0, place]) * cmath.exp(1j * turn)
        st["unit"][0, place] = unit.real, unit.imag


def grid_impedance(par: PlantRecord, st: PlantRecord, L_g: float, R_g: float) -> None:
    """Set the line to `L_g` and `R_g` times the elements of the converter file.

    Its current is continuous, but in an island, where the flux of line and load is. Factors of the
    options are not applied on top.

    Raises:
        ValueError: If L_g <= 0 or R_g < 0, or a mode becomes too fast for the DC link. The plant
            is then unchanged.
    """
    _require("L_g", L_g, L_g > 0, "a factor > 0")
    _require("R_g", R_g, R_g >= 0, "a factor >= 0")
    _rebuild(par, bool(st[0]["closed"]), L_g=L_g * par[0]["L_line_n"], R_g=R_g * par[0]["R_line_n"])
    reconnect(par, st)


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
    if not closed and par[0]["L_load"] == 0:
        raise ValueError(
            "plant.grid.load_R, plant.grid.load_L: not set; the breaker opens only onto a load"
        )
    _rebuild(par, closed)
    st["closed"] = closed
    reconnect(par, st)


def _rebuild(par: PlantRecord, closed: bool, **elements: float) -> None:
    """Set elements of the circuit and find its modes; a ValueError leaves `par` as it was."""
    changed = par.copy()
    for name, value in elements.items():
        changed[name] = value
    connect(changed, closed)
    par[:] = changed


def _rate(rate: float | None) -> float:
    if rate is None:
        return math.inf
    _require("rate", rate, rate > 0, "> 0 p.u./s")
    return rate


def _require(name: str, value: float, holds: bool, allowed: str) -> None:
    if not (holds and math.isfinite(value)):
        raise ValueError(f"{name} = {value}: must be {allowed}")
