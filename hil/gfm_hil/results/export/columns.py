"""What each column of a recording is: unit, a line for people, and words for codes.

Measurements, inputs and references take theirs from the signal table.
"""

from __future__ import annotations

from dataclasses import dataclass

from gfm_hil.core.errors import UserError
from gfm_hil.recording.recorder import (
    CONTROLLER_COLUMNS,
    CONTROLLER_TIMES,
    PLANT_COLUMNS,
    PLANT_TIMES,
)
from gfm_plant.names import TRIP_REASONS
from gfm_runtime.signals import SIGNALS
from gfm_runtime.states import STATES

_PREFIXES = {
    "y": "as the A/D reads it",
    "u": "command in hand at this tick",
    "ref": "reference in force",
}
_TRUE = {
    "i": ("p.u. (S_n/V_n)", "magnitude of the current of L_f"),
    "delta": ("rad", "angle of the converter's frame ahead of the grid's"),
    "omega_g": ("p.u. (omega_n)", "grid frequency"),
    "V_g": ("p.u. (V_n)", "grid voltage magnitude"),
    "trip": ("", "what has tripped"),
    "i_dc": ("p.u. (S_n/V_dcref)", "current of the DC source"),
}
_OTHERS = {
    "tick": ("", "number of the tick"),
    "t": ("s", "time of the run, tick × T_s"),
    "law": ("", "law in force"),
    "state": ("", "state of the controller"),
    "X_est": ("p.u. (Z_b)", "grid reactance as a scheduled law estimates it"),
}
_CLOCK = "CLOCK_MONOTONIC of the {side}, -1: never; "
_TIMES = {
    "scheduled": "deadline at which the tick begins",
    "woke": "when the tick began",
    "sent": "when the frame was handed to the link",
    "received": "when the frame of this tick was taken from the link",
    "computed": "when u was computed",
    "stall": "longest gap between two looks at the clock",
}


@dataclass(frozen=True)
class Described:
    """One column: its name in the run folder, unit (empty for codes), a line for people, and the
    words for its values if it is a code."""

    name: str
    unit: str
    comment: str
    words: tuple[tuple[int, str], ...] = ()


def describe(name: str, laws: list[str]) -> Described:
    """A column of signals.npz or timing.npz, by its name there.

    Args:
        name: of the column.
        laws: labels of the run's laws, in the order of the recording's indices.

    Raises:
        UserError: there is no such column.
    """
    if name not in all_columns():
        raise UserError(f"column {name!r}: is none of a recording; there are {all_columns()}")
    words = {
        "law": tuple(enumerate(laws)),
        "state": tuple(enumerate(STATES)),
        "true_trip": tuple(TRIP_REASONS.items()),
    }
    return Described(name, *_unit_and_comment(name), words.get(name, ()))


def _unit_and_comment(name: str) -> tuple[str, str]:
    if name in _OTHERS:
        return _OTHERS[name]
    prefix, _, rest = name.partition("_")
    if prefix == "true" and rest in _TRUE:
        unit, comment = _TRUE[rest]
        return unit, f"{comment}, of the plant itself"
    if prefix in ("plant", "controller"):
        kept = "" if rest == "stall" else _CLOCK.format(side=prefix)
        return "ns", f"{kept}{_TIMES[rest]}"
    group = "y" if prefix == "true" else prefix
    row = next(s for s in SIGNALS if (s.group, s.name) == (group, rest))
    where = _PREFIXES.get(prefix, "of the plant itself")
    return f"{row.unit} ({row.base})", f"{row.description}, {where}"


def all_columns() -> list[str]:
    """Every column that a recording may have, in the order of the files."""
    plant = [f"plant_{n}" for n in PLANT_TIMES]
    controller = [f"controller_{n}" for n in CONTROLLER_TIMES]
    return ["tick", "t", *PLANT_COLUMNS, *CONTROLLER_COLUMNS, *plant, *controller]
