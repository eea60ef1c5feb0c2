from .dual_sequence import DualSequence
from .grid_following import GridFollowingStage
from .kinds import (
    INNER_CONSTANTS,
    INNER_NUMBERS,
    KINDS,
    NONE,
    STAGES,
    STIFF,
    Inner,
    inner_fields,
    pack_inner,
    settle,
    settle_inner,
    shape,
)
from .stage import (
    INNER_STATE,
    PAPER_M,
    PRIORITIES,
    InnerStage,
    PowerLimiter,
    faded,
    inner_state_fields,
    limited,
    measure_frequency,
    take_measurements,
)
from .stiff_source import StiffSource
from .virtual_stator import VirtualStator
from .voltage_loop import Cascaded, ThresholdImpedance

__all__ = [
    "INNER_CONSTANTS",
    "INNER_NUMBERS",
    "INNER_STATE",
    "KINDS",
    "NONE",
    "PAPER_M",
    "PRIORITIES",
    "STAGES",
    "STIFF",
    "Cascaded",
    "DualSequence",
    "GridFollowingStage",
    "Inner",
    "InnerStage",
    "PowerLimiter",
    "StiffSource",
    "ThresholdImpedance",
    "VirtualStator",
    "faded",
    "inner_fields",
    "inner_state_fields",
    "limited",
    "measure_frequency",
    "pack_inner",
    "settle",
    "settle_inner",
    "shape",
    "take_measurements",
]
