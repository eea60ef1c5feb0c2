"""The inner stage between a law and the bridge: current limit, current and voltage loops.

``stage`` has what all kinds share, ``kinds`` the list of them and the tick of a stage.
"""

from gfm_runtime.inner.kinds import (
    INNER_CONSTANTS,
    INNER_NUMBERS,
    KINDS,
    NONE,
    STAGES,
    Inner,
    inner_fields,
    pack_inner,
    settle,
    settle_inner,
    shape,
)
from gfm_runtime.inner.stage import (
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
from gfm_runtime.inner.virtual_stator import VirtualStator
from gfm_runtime.inner.voltage_loop import Cascaded, ThresholdImpedance

__all__ = [
    "INNER_CONSTANTS",
    "INNER_NUMBERS",
    "INNER_STATE",
    "KINDS",
    "NONE",
    "PAPER_M",
    "PRIORITIES",
    "STAGES",
    "Cascaded",
    "Inner",
    "InnerStage",
    "PowerLimiter",
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
