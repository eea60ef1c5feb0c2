"""The range and resolution of one A/D or D/A channel."""

import numpy as np

from gfm_runtime.compiled import compiled


@compiled
def quantise(value: float, lo: float, hi: float, lsb: float) -> float:
    """Return `value` clamped to [lo, hi] and rounded to the codes lo + n lsb.

    `hi` is the highest code; lsb = 0 only clamps. Inside the range the error is at most lsb/2.
    """
    value = min(max(value, lo), hi)
    if lsb > 0.0:
        value = lo + lsb * np.floor((value - lo) / lsb + 0.5)
    return value
