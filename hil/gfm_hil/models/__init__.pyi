from .model import Model, ModelError, Rig, open_model
from .ports import PortMap, read_map

__all__ = ["Model", "ModelError", "PortMap", "Rig", "open_model", "read_map"]
