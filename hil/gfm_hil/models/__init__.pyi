from .model import Model, ModelError, open_model
from .ports import PortMap, read_map

__all__ = ["Model", "ModelError", "PortMap", "open_model", "read_map"]
