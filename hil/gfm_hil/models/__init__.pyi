from .kinds import FORMS, PIL, model_file, open_model, precision
from .model import BenchContext, Model, ModelError, check_currents
from .pil import PilModel
from .ports import PortMap, read_map

__all__ = [
    "FORMS",
    "PIL",
    "BenchContext",
    "Model",
    "ModelError",
    "PilModel",
    "PortMap",
    "check_currents",
    "model_file",
    "open_model",
    "precision",
    "read_map",
]
