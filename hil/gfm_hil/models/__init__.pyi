from .model import Model, ModelError, model_file, open_model
from .ports import PortMap, read_map

__all__ = ["Model", "ModelError", "PortMap", "model_file", "open_model", "read_map"]
