from .external import BenchContext, ControllerError, ExternalController, check_currents
from .kinds import FORMS, PIL, controller_file, open_controller, precision
from .pil import PilController
from .ports import PortMap, read_map

__all__ = [
    "FORMS",
    "PIL",
    "BenchContext",
    "ControllerError",
    "ExternalController",
    "PilController",
    "PortMap",
    "check_currents",
    "controller_file",
    "open_controller",
    "precision",
    "read_map",
]
