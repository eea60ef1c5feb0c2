from .bases import Bases
from .build import make_network, make_plant
from .components import NetworkParts
from .components.plant_controller import begin_set_points, set_plant_reference
from .emulator import (
    plant_advance,
    plant_command,
    plant_is_delayed,
    plant_options,
    plant_step,
    plant_truth,
)
from .flows import plant_flows
from .grid import (
    SynchroCheckResult,
    breaker,
    check_synchronism,
    clear_fault,
    fault,
    finish_check,
    grid_frequency,
    grid_impedance,
    grid_load,
    grid_unbalance,
    grid_voltage,
    line_breaker,
    phase_jump,
    start_again,
    take_out,
)
from .names import BATTERY, CONNECTION, CONTROLLER_SAFE, NO_FRESH_U, TRIP_REASONS, TRUTH
from .network import Network
from .options import Plant
from .parameters import ConverterParameters, load_converter
from .protection import trip_reason, wait_reason
from .pv_array import set_irradiance
from .records import PlantRecords
from .sensors import plant_sample, plant_set_points
from .steady_state import NoEquilibrium, plant_equilibrium

__all__ = [
    "BATTERY",
    "CONNECTION",
    "CONTROLLER_SAFE",
    "NO_FRESH_U",
    "TRIP_REASONS",
    "TRUTH",
    "Bases",
    "ConverterParameters",
    "Network",
    "NetworkParts",
    "NoEquilibrium",
    "Plant",
    "PlantRecords",
    "SynchroCheckResult",
    "begin_set_points",
    "breaker",
    "check_synchronism",
    "clear_fault",
    "fault",
    "finish_check",
    "grid_frequency",
    "grid_impedance",
    "grid_load",
    "grid_unbalance",
    "grid_voltage",
    "line_breaker",
    "load_converter",
    "make_network",
    "make_plant",
    "phase_jump",
    "plant_advance",
    "plant_command",
    "plant_equilibrium",
    "plant_flows",
    "plant_is_delayed",
    "plant_options",
    "plant_sample",
    "plant_set_points",
    "plant_step",
    "plant_truth",
    "set_irradiance",
    "set_plant_reference",
    "start_again",
    "take_out",
    "trip_reason",
    "wait_reason",
]
