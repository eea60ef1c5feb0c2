"""Measurement and modulation of a law together: its tables, constants and variables.

They stand in a law file as ``[measure]`` and ``[modulate]``, or in a file of their own, which a
scenario puts in place of those of its laws; the shipped ones are in ``gfm_runtime/counts_files``.
"""

from __future__ import annotations

import math
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from pydantic import Field, ValidationError

from gfm_runtime.compiled import inlined
from gfm_runtime.counts.measure import Measure
from gfm_runtime.counts.modulate import Modulate
from gfm_runtime.errors import LawError, meant
from gfm_runtime.mistakes import lines
from gfm_runtime.signals import N_ADC, N_LEGS, NY_INNER
from gfm_runtime.toml_file import TomlTable, parse_toml, read_text

NO_COUNTS = "none"

_SERIES = {
    "zero": 0.0, "half": 0.5, "three_halves": 1.5, "per_3": 1 / 3, "per_root_3": 1 / math.sqrt(3),
    "half_root_3": math.sqrt(0.75), "per_6": 1 / 6, "per_24": 1 / 24, "per_120": 1 / 120,
    "per_720": 1 / 720, "per_5040": 1 / 5040,
}  # fmt: skip
#: integers in ``law_dtype``; constants, by name and size; variables of an instance, and of a tick
COUNTS_NUMBERS = tuple(
    (n, "i8") for n in ("counts", "two", "modulator", "scales", "compensate", "feed")
)
COUNTS_CONSTANTS = {
    **dict.fromkeys(_SERIES, 1), "adc_zero": N_ADC, "adc_scale": N_ADC,
    **dict.fromkeys(("adc_top", "sum_most", "sum_ticks", "still_ticks", "still_above"), 1),
    "follow_y": 1,
    **dict.fromkeys(("turn", "turn_ahead", "per_leg", "top", "per_top", "ripple"), 1),
    **dict.fromkeys(("dead", "per_band", "least"), 1),
}  # fmt: skip
COUNTS_STATE = (
    ("angle", 2, "unit phasor of the controller's frame in the phases' own"),
    ("sensed", NY_INNER, "y as measured, p.u."),
    ("last", N_ADC, "counts of the last tick"),
    ("still", N_ADC, "ticks for which a channel has read the same"),
    ("speed", 1, "at which the frame has turned since the last tick, p.u."),
    ("odd", 3, "ticks for which the phases of i, v and i_o have not added up to 0"),
)
_OF_A_TICK = (("phases", N_ADC), ("legs", N_LEGS), ("edges", N_LEGS), ("compare", N_LEGS))


class Counts(TomlTable):
    """The two tables."""

    measure: Measure = Field(Measure(), description="from counts of the A/D to y")
    modulate: Modulate = Field(Modulate(), description="from u to compare counts")


@cache
def counts_names() -> tuple[str, ...]:
    """The names of the shipped files, and ``none``."""
    folder = files("gfm_runtime").joinpath("counts_files")
    found = [p.name.removesuffix(".toml") for p in folder.iterdir() if p.name.endswith(".toml")]
    return (NO_COUNTS, *sorted(found))


def named_counts(name: str) -> Counts | None:
    """The two tables of a shipped name, or of a path that ends in ``.toml``; None for ``none``.

    Raises:
        LawError: an unknown name, or every mistake of the file.
    """
    if name == NO_COUNTS:
        return None
    where, content = f"counts {name}", dict[str, Any]()
    try:
        if name.endswith(".toml"):
            text = read_text(name)
        elif name in counts_names():
            folder = files("gfm_runtime").joinpath("counts_files")
            text = folder.joinpath(f"{name}.toml").read_text(encoding="utf-8")
        else:
            known = list(counts_names())
            raise ValueError(f"unknown; use a .toml file or one of {known}{meant(name, known)}")
        content = parse_toml(text)
        return Counts.model_validate(content)
    except ValidationError as problem:
        raise LawError(where, *lines(problem, Counts, content=content)) from None
    except ValueError as problem:
        raise LawError(where, str(problem)) from None


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
        LawError: as ``Modulate.top``.
    """
    if counts is None:
        return
    rec["counts"] = 1
    constants = counts.measure.constants(T_s) | counts.modulate.constants(T_s, omega_b)
    for name, value in (_SERIES | constants).items():
        rec[name] = value


@inlined
def go_on_with(new, old):
    """Let another law go on with the frame and the filters of the one before."""
    new.speed = old.speed
    new.angle[0], new.angle[1] = old.angle[0], old.angle[1]
    for j in range(NY_INNER):
        new.sensed[j] = old.sensed[j]
    for j in range(N_ADC):
        new.phases[j] = old.phases[j]
        new.last[j], new.still[j] = old.last[j], old.still[j]
    for j in range(N_LEGS):
        new.odd[j] = old.odd[j]


def begin_counts(state: Any, y: Any, angle: complex) -> None:
    """Set the variables of a law that starts at rest.

    Args:
        state: one element of ``state_dtype``.
        y: measurements, (11,), p.u.
        angle: unit phasor of the controller's frame.
    """
    state["angle"] = angle.real, angle.imag
    state["sensed"], state["speed"] = y, y[2]
