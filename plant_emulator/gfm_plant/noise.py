"""Gaussian noise that is a pure function of (seed, tick, pair of channels).

No generator state is carried along, so a sample does not depend on how often or in which order
others are drawn: every link, mode and restart sees the same noise.
"""

import math

import numpy as np

from gfm_runtime.compiled import compiled, inlined

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_PAIRS = np.uint64(8)  # counters reserved for one tick
_S52, _ROOT_HALF = np.int64(52), np.float64(math.sqrt(0.5)).view(np.int64)
_S30, _S27, _S31, _S32 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(32)
_LOW_32, _LOW_30 = np.uint64(2**32 - 1), np.uint64(2**30 - 1)
# of the series of cos and sin; the compiler does not turn a division into a product
_C_4, _C_6, _C_8, _C_10 = (1 / math.factorial(n) for n in (4, 6, 8, 10))
_S_3, _S_5, _S_7, _S_9 = (1 / math.factorial(n) for n in (3, 5, 7, 9))
_LN_2, (_3, _5, _7, _9, _11, _13, _15) = math.log(2.0), (1 / n for n in range(3, 16, 2))


@inlined
def _splitmix(counter: np.uint64) -> np.uint64:
    """Return the output of splitmix64 (Steele, Lea, Flood 2014) for one state."""
    z = counter
    z = (z ^ (z >> _S30)) * _MIX_1
    z = (z ^ (z >> _S27)) * _MIX_2
    return z ^ (z >> _S31)


@inlined
def random_bits(seed: int, tick: int, pair: int) -> np.uint64:
    """Return 64 random bits."""
    key = np.uint64(seed) + _GOLDEN * (np.uint64(tick) * _PAIRS + np.uint64(pair))
    bits: np.uint64 = _splitmix(_splitmix(key))
    return bits


@inlined
def _log(x: float) -> float:
    """Return ln(x) of 2^-1022 <= x, within 1e-13 of itself: by the exponent, and a series of the
    mantissa between the square roots of 1/2 and 2. That of a library has other last bits on other
    machines, and a processor computes it of one number at a time."""
    exponent = (np.float64(x).view(np.int64) - _ROOT_HALF) >> _S52
    m = np.int64(np.float64(x).view(np.int64) - (exponent << _S52)).view(np.float64)
    f = (m - 1.0) / (m + 1.0)
    f2 = f * f
    odd = 1 + f2 * (_3 + f2 * (_5 + f2 * (_7 + f2 * (_9 + f2 * (_11 + f2 * (_13 + f2 * _15))))))
    return exponent * _LN_2 + 2.0 * f * odd


@inlined
def normal_pair(bits: np.uint64) -> tuple[float, float]:
    """Return two samples of N(0, 1) by 64 random bits."""
    # a number in (0, 1], so that its logarithm is finite, by the upper half of the bits
    length = math.sqrt(-2.0 * _log((np.float64(bits >> _S32) + 1.0) * 2.0**-32))
    # an angle between -45 and 45 degrees, by series, and one of four quarter turns
    x = (np.float64(bits & _LOW_30) * 2.0**-30 - 0.5) * (0.5 * math.pi)
    x2 = x * x
    c = length * (1 - x2 * (1 / 2 - x2 * (_C_4 - x2 * (_C_6 - x2 * (_C_8 - x2 * _C_10)))))
    s = length * x * (1 - x2 * (_S_3 - x2 * (_S_5 - x2 * (_S_7 - x2 * _S_9))))
    quarter = (bits & _LOW_32) >> _S30
    one, other = (c, s) if quarter == 0 or quarter == 2 else (s, c)
    return (
        -one if quarter == 1 or quarter == 2 else one,
        -other if quarter == 2 or quarter == 3 else other,
    )


@compiled
def gaussians(seed: int, tick: int, pair: int) -> tuple[float, float]:
    """Return two samples of N(0, 1), by Box-Muller from two uniform 32-bit numbers; none is larger
    than 6.7. 0 <= pair < 8."""
    return normal_pair(random_bits(seed, tick, pair))
