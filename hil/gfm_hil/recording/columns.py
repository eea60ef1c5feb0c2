"""The one table of the columns of a recording: each column's name, symbol, unit and meaning.

The signal table describes measurements, commands and references; this table adds the columns of
the plant itself, of the controller and of the two clocks. Export files, figures, the scope,
streams, data frames and the documentation take names and units from here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import Role
from gfm_plant import BATTERY, CONNECTION, TRUTH
from gfm_plant.names import TRIP_REASONS
from gfm_runtime.signals import (
    COUNTS,
    INNER,
    PLAIN,
    REF_NAMES,
    SIGNALS,
    U_NAMES,
    Y_NAMES,
    carried,
    names,
)
from gfm_runtime.states import STATES

if TYPE_CHECKING:
    from gfm_hil.scenario import Scenario

PLANT_COLUMNS = (
    *(f"y_{n}" for n in Y_NAMES),
    *(f"u_{n}" for n in U_NAMES),
    *(f"true_{n}" for n in TRUTH),
)
#: a run with an inner stage records these after the plant's and the controller's
PLANT_INNER = (*(f"y_{n}" for n in names("y_inner")), *(f"u_{n}" for n in names("u_inner")))
#: a run records those of its plant's options last: of a converter's own transformer, of a battery
PLANT_OPTIONS = tuple(f"true_{n}" for n in (*CONNECTION, *BATTERY))
I_REF = ("i_ref_d", "i_ref_q")
CONTROLLER_INNER = ("E_law", *I_REF, "limited")
#: a run with counts records these after those of an inner stage: what the A/D reads and the bridge
#: gets, and y as the law has measured it
PLANT_COUNTS = (*(f"y_{n}" for n in names("adc")), *(f"u_{n}" for n in names("compare")))
CONTROLLER_COUNTS = tuple(f"m_{n}" for n in carried("y", INNER))
CONTROLLER_COLUMNS = (*(f"ref_{n}" for n in REF_NAMES), "law", "state", "X_est")
# ns of CLOCK_MONOTONIC, -1: never; in lockstep a sample late, an answer is "received" at the look
# that finds the next frame "sent"; "stall" is the longest gap between two looks at the clock
PLANT_TIMES = ("scheduled", "woke", "sent", "received", "stall", "measured")
CONTROLLER_TIMES = ("scheduled", "received", "computed", "sent", "stall")

SIGNALS_OF: dict[Role, tuple[str, ...]] = {"plant": PLANT_COLUMNS, "controller": CONTROLLER_COLUMNS}
TIMES_OF: dict[Role, tuple[str, ...]] = {"plant": PLANT_TIMES, "controller": CONTROLLER_TIMES}
#: kept after the times: the tick whose u acts, -1: that of the start; the instructions of a law
#: that runs on a processor in the loop, -1: not counted
COUNTS_OF: dict[Role, tuple[str, ...]] = {"plant": ("acts",), "controller": ("instructions",)}
ACTS, INSTRUCTIONS = "plant_acts", "controller_instructions"
_MORE_OF: dict[Role, tuple[tuple[str, ...], ...]] = {
    "plant": (PLANT_INNER, PLANT_COUNTS), "controller": (CONTROLLER_INNER, CONTROLLER_COUNTS)
}  # fmt: skip


def kept_of(role: Role) -> tuple[str, ...]:
    """The columns that a role keeps beside its signals, integers: times, and counts after them."""
    return TIMES_OF[role] + COUNTS_OF[role]


@dataclass(frozen=True)
class ColumnSet:
    """Which columns the run of a converter records."""

    signal_set: int = PLAIN  # see ``Scenario.signal_set``
    options: tuple[
        str, ...
    ] = ()  # what its plant has by options, see ``Scenario.optional_signals``
    flows: tuple[str, ...] = ()  # of its network, see ``Scenario.flows``; the plant records them

    @classmethod
    def of(cls, scenario: Scenario, place: int = 0) -> Self:
        """Those of the converter at a place of a scenario's network; the first has the flows."""
        flows = scenario.flows if place == 0 else ()
        return cls(scenario.signal_set, scenario.optional_signals, flows)

    def signals(self, role: Role) -> tuple[str, ...]:
        """Those of a role, without times and flows."""
        found = SIGNALS_OF[role] + tuple(n for x in _MORE_OF[role][: self.signal_set] for n in x)
        return found + (tuple(f"true_{n}" for n in self.options) if role == "plant" else ())

    def bytes_per_tick(self, converters: int = 1) -> int:
        """What a tick takes in the parts of all converters of a run."""
        each = sum(len(self.signals(role)) + len(kept_of(role)) for role in SIGNALS_OF)
        return 8 * (converters * each + len(self.flows))


PLAIN_COLUMNS = ColumnSet()  #: those of every run
ALL_COLUMNS = ColumnSet(COUNTS, CONNECTION + BATTERY)  #: all but those of a network


def recorded_in(role: Role, width: int) -> tuple[str, ...]:
    """The columns of a recording of so many of them; empty if no run records so many."""
    options = ((), CONNECTION, BATTERY, CONNECTION + BATTERY)
    each = (ColumnSet(*which).signals(role) for which in product((PLAIN, INNER, COUNTS), options))
    return {len(names): names for names in each}.get(width, ())


PIECE = 1 << 18  # ticks of a column that a reader holds in memory at a time


class ColumnLike(Protocol):
    """A column, shape (ticks,): an array, or a column of a file of which only slices are read."""

    @property
    def dtype(self) -> np.dtype[Any]: ...
    def __len__(self) -> int: ...
    def __getitem__(self, rows: slice, /) -> Any: ...


Columns = Mapping[str, ColumnLike]  #: columns of a run by name, all of the same length


def pieces(column: ColumnLike, first: int, last: int) -> Iterator[Any]:
    """Rows [first, last) of a column, at most ``PIECE`` at a time, so that memory is bounded."""
    return (column[a : min(a + PIECE, last)] for a in range(first, last, PIECE))


class DisplayUnit(NamedTuple):
    """How to display a column: symbol, unit, and the factor for recorded values."""

    symbol: str
    unit: str
    factor: float


@dataclass(frozen=True)
class ColumnInfo:
    """One row of the table."""

    name: str  # of the column in the run folder
    symbol: str  # as printed, LaTeX; empty for codes and times
    unit: str  # of what is recorded, with the base of a per-unit value; empty for codes
    quantity: str  # short description
    origin: str = ""  # where it was recorded, in short; may be empty
    words: tuple[tuple[int, str], ...] = ()  # meanings of the values of a code
    limits: tuple[float, float] | None = None  # of a signal, by the signal table

    @property
    def comment(self) -> str:
        """``quantity`` and ``origin`` in one line."""
        return f"{self.quantity}, {self.origin}" if self.origin else self.quantity

    def display_unit(self, f_n: float) -> DisplayUnit:
        """A frequency in Hz (``f_n`` is nominal), an angle in degrees, the rest as recorded."""
        signal = self.name
        if self.name not in CONTROLLER_INNER and "." not in self.name:  # their names have no prefix
            signal = self.name.partition("_")[2] or self.name
        if self.unit == "p.u. (omega_n)":
            return DisplayUnit("f_g" if signal == "omega_g" else "f", "Hz", f_n)
        if self.unit == "rad":
            return DisplayUnit("δ", "°", math.degrees(1.0))
        return DisplayUnit(signal, self.unit.partition(" (")[0], 1.0)


_SENSOR, _COMMAND, _REFERENCE, _TRUE = (
    "as the A/D reads it", "newest command at this tick", "reference in force",
    "of the plant itself",
)  # fmt: skip
_TIMES = {
    "scheduled": "deadline at which the tick begins",
    "woke": "when the tick began",
    "sent": "when the frame was handed to the link",
    "received": "when the frame of this tick was taken from the link",
    "measured": "when y was ready for the link",
    "computed": "when u was computed",
    "stall": "longest gap between two looks at the clock",
}


def _signals(prefix: str, groups: tuple[str, ...], origin: str) -> list[ColumnInfo]:
    """The rows of the signal table's groups, as columns with a prefix."""
    found = []
    for s in SIGNALS:
        if s.group in groups:
            about = s.symbol, f"{s.unit} ({s.base})", s.description, origin
            found.append(ColumnInfo(f"{prefix}_{s.name}", *about, limits=(s.low, s.high)))
    return found


def _time(role: Role, name: str) -> ColumnInfo:
    clock = "" if name == "stall" else f"CLOCK_MONOTONIC of the {role}, -1: never; "
    return ColumnInfo(f"{role}_{name}", "", "ns", f"{clock}{_TIMES[name]}")


#: letter, base and meaning; both parts of each are recorded, see `gfm_plant.TRUTH`
_SPACE_VECTORS = (("v", "p.u. (V_n)", "voltage of C_f"), ("i", "p.u. (S_n/V_n)", "current of L_f"))


def _table() -> dict[str, ColumnInfo]:
    rows = [
        ColumnInfo("tick", "k", "", "number of the tick"),
        ColumnInfo("t", "t", "s", "time of the run, tick × T_s"),
        *_signals("y", ("y",), _SENSOR),
        *_signals("u", ("u",), _COMMAND),
        *_signals("true", ("y", "d"), _TRUE),
        ColumnInfo(
            "true_i", r"\lvert i_{dq} \rvert", "p.u. (S_n/V_n)",
            "magnitude of the current of L_f", _TRUE,
        ),
        ColumnInfo(
            "true_delta", r"\delta", "rad",
            "angle of the converter's frame ahead of the grid's", _TRUE,
        ),
        ColumnInfo("true_i_dc", "i_{dc}", "p.u. (S_n/V_dcref)", "current of the DC source", _TRUE),
        *(
            ColumnInfo(
                f"true_{n}_{part}", rf"\{sign} {n}", base,
                f"space vector of the {what}, {axis} in the frame that turns at omega_n", _TRUE,
            )
            for n, base, what in _SPACE_VECTORS
            for part, sign, axis in (("re", "Re", "real part"), ("im", "Im", "imaginary part"))
        ),
        ColumnInfo(
            "true_trip", "", "", "what has tripped", _TRUE, tuple(TRIP_REASONS.items())
        ),
        *_signals("ref", ("ref",), _REFERENCE),
        *(
            ColumnInfo(
                f"true_{n}", f"{n[0]}_c", f"p.u. ({base})", f"{what} at the connection point", _TRUE
            )
            for n, base, what in zip(
                CONNECTION, ("S_n", "S_n", "V_n"), ("active power", "reactive power", "voltage"),
                strict=True,
            )
        ),
        ColumnInfo("true_soc", "SoC", "p.u. (energy_s)", "state of charge of the battery", _TRUE),
        ColumnInfo("law", "", "", "law in force"),  # index into `laws` of signals.npz
        ColumnInfo("state", "", "", "state of the controller", "", tuple(enumerate(STATES))),
        ColumnInfo(
            "X_est", "X_{est}", "p.u. (Z_b)", "grid reactance as a scheduled law estimates it"
        ),
        *_signals("y", ("y_inner",), _SENSOR),
        *_signals("u", ("u_inner",), _COMMAND),
        ColumnInfo("E_law", "E_u", "p.u. (V_n)", "voltage that the law asks for"),
        *(
            ColumnInfo(f"i_ref_{a}", f"i^*_{a}", "p.u. (S_n/V_n)",
                      f"current that the inner stage asks for, {a}")
            for a in "dq"
        ),
        ColumnInfo("limited", "", "", "whether the inner stage limits the current", "",
                  ((0, "no"), (1, "yes"))),
        *_signals("y", ("adc",), "at the sample"),
        *_signals("u", ("compare",), _COMMAND),
        *_signals("m", ("y", "y_inner"), "as the law measures it"),
        *(_time(role, name) for role, times in TIMES_OF.items() for name in times),
        ColumnInfo(ACTS, "", "", "tick whose u the D/A gets, -1: that of the start"),
        ColumnInfo(INSTRUCTIONS, "", "", "instructions of a step on a processor in the loop"),
    ]  # fmt: skip
    found = {row.name: row for row in rows}
    times = [f"{role}_{name}" for role in TIMES_OF for name in kept_of(role)]
    inner = (*PLANT_INNER, *PLANT_OPTIONS, *CONTROLLER_INNER, *PLANT_COUNTS, *CONTROLLER_COUNTS)
    return {n: found[n] for n in ("tick", "t", *PLANT_COLUMNS, *CONTROLLER_COLUMNS, *inner, *times)}


TABLE = _table()
"""Every column that a recording may have by its name, in the order of the files."""

PHASES = ("a", "b", "c")
WAVES = {"v": "V", "i": "A", "i_o": "A"}  #: what has three phases, and its unit in SI


def wave(name: str, phase: str, si: bool) -> str:
    """The name of a derived column: a phase of one of ``WAVES``, in p.u., or in V or A."""
    return f"{name}{'' if name == 'i_o' else '_'}{phase}{f'_{WAVES[name]}' if si else ''}"


def _derived() -> dict[str, ColumnInfo]:
    meanings = {
        "v": ("p.u. (sqrt(2/3) V_n)", "voltage of C_f"),
        "i": ("p.u. (sqrt(2/3) S_n/V_n)", "current of L_f"),
        "i_o": ("p.u. (sqrt(2/3) S_n/V_n)", "current of the line, towards the grid"),
    }
    rows = [
        ColumnInfo(
            wave(name, phase, si),
            f"{name}{phase}" if name == "i_o" else f"{name}_{phase}",
            WAVES[name] if si else base,
            f"{quantity}, phase {phase}",
            _TRUE,
        )
        for si in (False, True)
        for name, (base, quantity) in meanings.items()
        for phase in PHASES
    ]
    return {row.name: row for row in rows}


DERIVED = _derived()
"""The columns of `gfm_hil.recording.waveforms`: they are not recorded but follow from what is.

A phase's voltage is that against the star point of the three: with three wires there is no zero
sequence."""

_FLOWS = {
    "P": ("P", "p.u. (S_n)", "active power"),
    "Q": ("Q", "p.u. (S_n)", "reactive power"),
    "i_re": (r"\Re i", "p.u. (S_n/V_n)", "current, real part in the frame that turns at omega_n"),
    "i_im": (r"\Im i", "p.u. (S_n/V_n)", "current, imaginary part in that frame"),
    "omega": (r"\omega", "p.u. (f_n)", "speed, or frequency by a PLL or meter,"),
    "V": ("V", "p.u. (V_n)", "voltage"),
    "P_set": ("P_{set}", "p.u. (S of the plant)", "set-point of the power"),
    "Q_set": ("Q_{set}", "p.u. (S of the plant)", "set-point of the reactive power"),
    "V_set": ("V_{set}", "p.u. (V_n)", "set-point of the voltage"),
    **{
        f"i_{phase}": (f"i_{phase}", "p.u. (sqrt(2/3) S_n/V_n)", f"current of phase {phase}")
        for phase in PHASES
    },
}
"""What a run records of parts of a network, see `gfm_plant.components.part.Terminal`: symbol, unit,
with the bases of the first converter, and meaning by what follows the name of the part and a dot.
"""


def of_network(name: str) -> ColumnInfo | None:
    """A column of a network, by its name."""
    part, _, what = name.rpartition(".")
    if not part or what not in _FLOWS:
        return None
    symbol, unit, quantity = _FLOWS[what]
    return ColumnInfo(name, symbol, unit, f"{quantity} of {part}", _TRUE)


HERTZ = "f_hz"
"""The converter's frequency in Hz, which is derived: true_omega_u times the nominal frequency."""


def describe(name: str, laws: list[str]) -> ColumnInfo:
    """A column of signals.npz or timing.npz, by its name there, one of ``DERIVED``, or one of a
    network. Raises UserError: there is no such column.

    Args:
        name: of the column.
        laws: labels of the run's laws, in the order of the recording's indices.
    """
    row = TABLE.get(name) or DERIVED.get(name) or of_network(name)
    if row is None:
        raise UserError(f"column {name!r}: unknown; a recording has {[*TABLE]}")
    return replace(row, words=tuple(enumerate(laws))) if name == "law" else row


def unit_of(name: str) -> str:
    """The unit of a signal by a column's name, by the bare name of one of the plant's own, or
    ``f_hz``; per unit without its base, and empty for codes."""
    if name == HERTZ:
        return "Hz"
    row = TABLE.get(name) or of_network(name) or TABLE[f"true_{name}"]
    return row.unit.partition(" (")[0]


def symbol_of(name: str) -> str:
    """A signal's name as people write it: f for ``f_hz``, ω_u for ``omega_u``, δ for ``delta``."""
    return "f" if name == HERTZ else name.replace("omega", "ω").replace("delta", "δ")


def named(
    role: Role, signals: NDArray[Any], times: NDArray[Any] | None = None
) -> dict[str, NDArray[Any]]:
    """A side's arrays, shape (ticks, columns) each, as views of shape (ticks,) by column name."""
    found = {name: signals[:, j] for j, name in enumerate(recorded_in(role, signals.shape[1]))}
    if times is not None:
        found |= {f"{role}_{name}": times[:, j] for j, name in enumerate(TIMES_OF[role])}
    return found
