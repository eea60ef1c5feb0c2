from .kinds import FORMS, PIL, model_file, open_model, precision
from .model import Model, ModelError, Rig, check_currents
from .pil import PilModel
from .ports import PortMap, read_map

__all__ = [
    "FORMS",
    "PIL",
    "Model",
    "ModelError",
    "PilModel",
    "PortMap",
    "Rig",
    "check_currents",
    "model_file",
    "open_model",
    "precision",
    "read_map",
]
