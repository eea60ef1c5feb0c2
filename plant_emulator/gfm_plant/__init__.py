"""The plant: a grid-forming converter with its filter, DC source, line, grid and instruments.

Describe one with `options.Plant`, build its records with `make_plant`, put it at rest with
`plant_equilibrium` and `plant_init`, then alternate `plant_sample` and `plant_advance`.
"""

from gfm_plant.bases import Bases
from gfm_plant.build import make_plant
from gfm_plant.emulator import (
    TRUTH,
    plant_advance,
    plant_ahead,
    plant_go_on,
    plant_init,
    plant_take,
    plant_truth,
)
from gfm_plant.grid import breaker, grid_frequency, grid_impedance, grid_voltage, phase_jump
from gfm_plant.options import Plant
from gfm_plant.parameters import ConverterParameters, load_converter
from gfm_plant.protection import CONTROLLER_SAFE, NO_FRESH_U, TRIP_REASONS, trip_reason
from gfm_plant.records import plant_par_dtype, plant_state_dtype
from gfm_plant.sensors import plant_sample
from gfm_plant.steady_state import NoEquilibrium, plant_equilibrium

__all__ = [
    "CONTROLLER_SAFE",
    "NO_FRESH_U",
    "TRIP_REASONS",
    "TRUTH",
    "Bases",
    "ConverterParameters",
    "NoEquilibrium",
    "Plant",
    "breaker",
    "grid_frequency",
    "grid_impedance",
    "grid_voltage",
    "load_converter",
    "make_plant",
    "phase_jump",
    "plant_advance",
    "plant_ahead",
    "plant_equilibrium",
    "plant_go_on",
    "plant_init",
    "plant_par_dtype",
    "plant_sample",
    "plant_state_dtype",
    "plant_take",
    "plant_truth",
    "trip_reason",
]
