"""The channels of a scope: recorded columns with names and units, and figures of the loop."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.recording.columns import CONTROLLER_INNER, DERIVED, I_REF, PHASES, TABLE, Columns, wave
from gfm_hil.recording.timing import LATE, MISS_NEEDS, ROUND_TRIP, SLACK, Duration, missed
from gfm_hil.recording.waveforms import NEEDS, Phase
from gfm_plant import Bases
from gfm_runtime.signals import names

_LEAST = {"p.u.": 0.01, "Hz": 0.02, "°": 0.5, "": 1.0}  # of a channel's range, by its unit


@dataclass(frozen=True)
class ScopeChannel:
    """One quantity over time."""

    name: str  # in messages between page and server
    group: str  # y, u, ref, d, plant, wave, inner (of a run with an inner stage) or loop
    # symbol, unit, description: for display
    symbol: str
    unit: str
    description: str
    least: float  # the smallest range of values that fills the height of a plot, in ``unit``
    needs: tuple[str, ...]  # columns of the recording from which it is computed
    base: str  # of a value in p.u., see ``si_bases``; "" for other units
    # computes its values of the ticks [first, last) from the columns; NaN if there is none
    of: Callable[[Columns, int, int], NDArray[np.float64]]

    def about(self) -> dict[str, Any]:
        """The channel as plain data for the page."""
        return {key: value for key, value in vars(self).items() if key not in ("needs", "of")}

    def read(self, columns: Columns, first: int, last: int) -> NDArray[np.float32]:
        """Values of ticks first … last-1; all NaN if the recording lacks a column."""
        if any(name not in columns for name in self.needs):
            return np.full(last - first, np.nan, np.float32)
        return self.of(columns, first, last).astype(np.float32)


def si_bases(bases: Bases) -> dict[str, tuple[str, float]]:
    """The unit and the value of 1 p.u. in SI by the base of a channel."""
    S, V = bases.S_n, bases.V_n
    return {
        "S_n": ("W", S), "Q_n": ("var", S), "V_n": ("V", V), "S_n/V_n": ("A", bases.base_of("I")),
        "V_dcref": ("V", bases.V_dcref), "S_n/V_dcref": ("A", S / bases.V_dcref),
        "peak v": ("V", bases.V_peak), "peak i": ("A", bases.I_peak),
    }  # fmt: skip


def make_channels(T_s: float, f_b: float) -> tuple[ScopeChannel, ...]:
    """All channels of a recording with a sampling time T_s, s, and a base frequency, Hz."""
    return (
        *(_column(n, "y", f"y_{n}", f_b) for n in names("y")),
        *(_column(f"u_{n}", "u", f"u_{n}", f_b) for n in names("u")),
        *(_column(f"ref_{n}" if n == "omega_g" else n, "ref", f"ref_{n}", f_b)
          for n in names("ref")),
        *(_column(f"d_{n}", "d", f"true_{n}", f_b) for n in names("d")),
        *(_column(n, "plant", f"true_{n}", f_b) for n in ("i", "delta")),
        *(_phase(n, phase, T_s, f_b) for n in ("v", "i") for phase in PHASES),
        *(_column(n, "inner", f"y_{n}", f_b) for n in names("y_inner")),
        *(_column(f"u_{n}", "inner", f"u_{n}", f_b) for n in names("u_inner")),
        *(_column(n, "inner", n, f_b) for n in CONTROLLER_INNER),
        ScopeChannel("i_ref", "inner", "i_ref", "p.u.", "size of the current that the inner stage"
                     " asks for", _LEAST["p.u."], I_REF, "S_n/V_n", _i_ref),
        _duration("slack", SLACK, 10.0, T_s),
        _duration("round_trip", ROUND_TRIP, 5.0, T_s),
        _duration("late", LATE, 5.0, T_s),
        ScopeChannel("miss", "loop", "miss", "", "ticks without a fresh u", 1.0, MISS_NEEDS, "",
                     _miss),
    )  # fmt: skip


def _column(name: str, group: str, column: str, f_b: float) -> ScopeChannel:
    row = TABLE[column]
    symbol, unit, factor = row.display_unit(f_b)

    def of(columns: Columns, first: int, last: int) -> NDArray[np.float64]:
        return np.asarray(columns[column][first:last] * factor)

    base = row.unit.partition("(")[2].removesuffix(")") if unit == "p.u." else ""
    base = "Q_n" if name in ("q", "Q_ref") else base
    return ScopeChannel(name, group, symbol, unit, row.quantity, _LEAST[unit], (column,), base, of)


def _phase(name: str, phase: str, T_s: float, f_b: float) -> ScopeChannel:
    """A phase of a voltage or current; the recording of a run that goes on has no column t."""
    row, needs = DERIVED[wave(name, phase, si=False)], NEEDS[1:]
    base = f"peak {name}"

    def of(columns: Columns, first: int, last: int) -> NDArray[np.float64]:
        part = {n: columns[n][first:last] for n in needs} | {"t": np.arange(first, last) * T_s}
        return Phase(part, name, phase, f_b)[:]

    return ScopeChannel(
        row.name, "wave", row.symbol, "p.u.", row.quantity, _LEAST["p.u."], needs, base, of
    )


def _i_ref(columns: Columns, first: int, last: int) -> NDArray[np.float64]:
    d, q = (columns[name][first:last] for name in I_REF)
    return np.hypot(d, q)


def _duration(name: str, duration: Duration, least: float, T_s: float) -> ScopeChannel:
    def of(columns: Columns, first: int, last: int) -> NDArray[np.float64]:
        return duration.us(columns, T_s, first, last)

    needs = duration.needs
    return ScopeChannel(name, "loop", duration.name, "µs", duration.meaning, least, needs, "", of)


def _miss(columns: Columns, first: int, last: int) -> NDArray[np.float64]:
    """1 where a u was late, NaN where there was no deadline."""
    due = columns[MISS_NEEDS[0]][first:last] >= 0
    return np.where(due, missed(columns, first, last), np.nan)
