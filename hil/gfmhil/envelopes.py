"""Envelopes of a grid-forming unit's answer, and the unit that a law makes of a converter."""

from gfm_hil.api.studies import measure_unit
from gfm_hil.studies.envelopes import (
    Envelope,
    Tolerance,
    Unit,
    amplitude_step,
    fit_jump,
    fit_ramp,
    phase_jump,
    rocof,
    rocof_response,
    scr_jump,
    scr_jump_response,
)
from gfm_hil.studies.unit_fit import UnitFit, fit_run

__all__ = [
    "Envelope",
    "Tolerance",
    "Unit",
    "UnitFit",
    "amplitude_step",
    "fit_jump",
    "fit_ramp",
    "fit_run",
    "measure_unit",
    "phase_jump",
    "rocof",
    "rocof_response",
    "scr_jump",
    "scr_jump_response",
]
