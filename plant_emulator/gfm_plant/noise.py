"""Gaussian noise that is a pure function of (seed, tick, pair of channels).

No generator state is carried along, so a sample does not depend on how often or in which order
others are drawn: every link, mode and restart sees the same noise.
"""

from __future__ import annotations

import math

import numpy as np

from gfm_runtime.compiled import compiled

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_PAIRS = np.uint64(8)  # counters reserved for one tick
_TWO, _ONE = np.uint64(2), np.uint64(1)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)


@compiled
def _splitmix(counter: np.uint64) -> np.uint64:
    """Return the output of splitmix64 (Steele, Lea, Flood 2014) for one state."""
    z = counter
    z = (z ^ (z >> _S30)) * _MIX_1
    z = (z ^ (z >> _S27)) * _MIX_2
    return z ^ (z >> _S31)


@compiled
def gaussians(seed: int, tick: int, pair: int) -> tuple[float, float]:
    """Return two samples of N(0, 1), by Box-Muller from two uniform numbers; 0 <= pair < 8."""
    key = _splitmix(np.uint64(seed) + _GOLDEN)
    n = _TWO * (np.uint64(tick) * _PAIRS + np.uint64(pair))
    a = _splitmix(key + _GOLDEN * (n + _ONE)) >> _S11
    b = _splitmix(key + _GOLDEN * (n + _TWO)) >> _S11
    one = (np.float64(a) + 1.0) * 2.0**-53  # in (0, 1], so that the logarithm is finite
    angle = 2.0 * math.pi * (np.float64(b) * 2.0**-53)  # in [0, 2 pi)
    length = math.sqrt(-2.0 * math.log(one))
    return length * math.cos(angle), length * math.sin(angle)
