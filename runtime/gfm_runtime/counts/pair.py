"""Measurement and modulation of a law together: its tables, constants and variables.

They stand in a law file as ``[measure]`` and ``[modulate]``, or in a file of their own, which a
scenario puts in place of those of its laws; the shipped ones are in ``gfm_runtime/counts_files``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pydantic import Field

from gfm_runtime.compiled import cached, inlined
from gfm_runtime.counts.measure import Measure, calibrate
from gfm_runtime.counts.modulate import Modulate
from gfm_runtime.shipped import Shipped
from gfm_runtime.signals import N_ADC, N_LEGS, NY_INNER, Y_OMEGA
from gfm_runtime.toml_file import TomlTable

_SERIES = {
    "zero": 0.0, "half": 0.5, "three_halves": 1.5, "per_3": 1 / 3, "per_root_3": 1 / math.sqrt(3),
    "half_root_3": math.sqrt(0.75), "per_6": 1 / 6, "per_24": 1 / 24, "per_120": 1 / 120,
    "in_turn": 3.0,
}  # fmt: skip
#: integers in ``law_dtype``; constants, by name and size; variables of an instance, and of a tick
COUNTS_NUMBERS = tuple(
    (n, "i8") for n in ("counts", "two", "modulator", "scales", "compensate", "feed")
)
COUNTS_CONSTANTS = {
    **dict.fromkeys(_SERIES, 1), "adc_zero": N_ADC, "adc_scale": N_ADC,
    **dict.fromkeys(("adc_top", "sum_most", "sum_checks", "still_checks", "still_above"), 1),
    **dict.fromkeys(("follow_y", "turn_back", "calibrate", "per_calibrate", "offset_most"), 1),
    **dict.fromkeys(("turn", "turn_ahead", "per_leg", "top", "ripple"), 1),
    **dict.fromkeys(("dead", "half_dead", "per_band", "least"), 1),
}  # fmt: skip
COUNTS_STATE = (
    ("angle", 2, "unit phasor of the controller's frame in the phases' own"),
    ("sensed", NY_INNER, "y as measured, p.u."),
    ("last", N_ADC, "counts at the last check"),
    ("still", N_ADC, "checks for which a channel has read the same"),
    ("turn", 1, "whose sensors this tick checks: 0 i and v_dc, 1 v, 2 i_o"),
    ("speed", 1, "at which the frame has turned since the last tick, p.u."),
    ("odd", 3, "checks for which the phases of i, v and i_o have not added up to 0"),
    ("shift", N_ADC, "counts that the start has found without current, less those expected"),
    ("calibrated", 1, "how many of them it has taken"),
)
_OF_A_TICK = (("phases", N_ADC), ("legs", N_LEGS), ("edges", N_LEGS), ("compare", N_LEGS))


class Counts(TomlTable):
    """The two tables."""

    measure: Measure = Field(Measure(), description="from counts of the A/D to y")
    modulate: Modulate = Field(Modulate(), description="from u to compare counts")


named_counts = Shipped("counts", "counts_files", Counts, Counts.model_validate).named


def _sized(name: str, f: np.dtype[Any], size: int) -> tuple[Any, ...]:
    return (name, f, (size,)) if size > 1 else (name, f)


def counts_fields(f: np.dtype[Any]) -> list[Any]:
    """The constants in ``law_dtype``."""
    return [_sized(name, f, size) for name, size in COUNTS_CONSTANTS.items()]


def counts_state_fields(f: np.dtype[Any]) -> list[Any]:
    """The variables in ``state_dtype``."""
    kept = [_sized(name, f, size) for name, size, _ in COUNTS_STATE]
    return [("suspect", "i8"), *kept, *((name, f, (size,)) for name, size in _OF_A_TICK)]


def pack_counts(counts: Counts | None, rec: Any, T_s: float, omega_b: float) -> None:
    """Fill the fields ``COUNTS_NUMBERS`` and ``COUNTS_CONSTANTS`` of a law's record, which are 0.

    Args:
        counts: None for a law whose y and u are in p.u.
        T_s: sampling time, s.
        omega_b: base frequency of the converter, rad/s.

    Raises:
        LawError: as ``Measure.constants`` and ``Modulate.top``.
    """
    if counts is None:
        return
    rec["counts"] = 1
    constants = counts.measure.constants(T_s, omega_b) | counts.modulate.constants(T_s, omega_b)
    for name, value in (_SERIES | constants).items():
        rec[name] = value


@inlined
def go_on_with(new, old):
    """Let another law go on with the frame and the filters of the one before."""
    new.speed, new.turn, new.calibrated = old.speed, old.turn, old.calibrated
    new.angle[0], new.angle[1] = old.angle[0], old.angle[1]
    for j in range(NY_INNER):
        new.sensed[j] = old.sensed[j]
    for j in range(N_ADC):
        new.phases[j] = old.phases[j]
        new.last[j], new.still[j] = old.last[j], old.still[j]
        new.shift[j] = old.shift[j]
    for j in range(N_LEGS):
        new.odd[j] = old.odd[j]


@cached
def calibrate_with(laws: Any, states: Any, k: int, rows: Any) -> int:
    """Calibrate law k of arrays of ``law_dtype`` and ``state_dtype``.

    Args:
        rows: counts without current, (``calibrate``, 10).

    Returns:
        The channel whose offset is too large, or -1.
    """
    for i in range(len(rows)):
        calibrate(laws[k], states[k], rows[i], 0)
    return int(states[k].suspect)


def begin_counts(state: Any, y: Any, angle: complex) -> None:
    """Set the variables of a law that starts at rest.

    Args:
        state: one element of ``state_dtype``.
        y: measurements, (11,), p.u.
        angle: unit phasor of the controller's frame.
    """
    state["angle"] = angle.real, angle.imag
    state["sensed"], state["speed"] = y, y[Y_OMEGA]
