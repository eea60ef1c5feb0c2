from .model import Model, ModelError, Rig, model_file, open_model
from .ports import PortMap, read_map

__all__ = ["Model", "ModelError", "PortMap", "Rig", "model_file", "open_model", "read_map"]
