from .measure import Measure, align, calibrate, measure
from .modulate import Modulate, modulate
from .pair import (
    COUNTS_CONSTANTS,
    COUNTS_NUMBERS,
    COUNTS_STATE,
    Counts,
    begin_counts,
    calibrate_with,
    counts_fields,
    counts_state_fields,
    go_on_with,
    named_counts,
    pack_counts,
)

__all__ = [
    "COUNTS_CONSTANTS",
    "COUNTS_NUMBERS",
    "COUNTS_STATE",
    "Counts",
    "Measure",
    "Modulate",
    "align",
    "begin_counts",
    "calibrate",
    "calibrate_with",
    "counts_fields",
    "counts_state_fields",
    "go_on_with",
    "measure",
    "modulate",
    "named_counts",
    "pack_counts",
]
