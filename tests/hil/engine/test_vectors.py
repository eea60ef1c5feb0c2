"""Eight numbers at a time are what NumPy computes of each."""

import numba
import numpy as np
from hypothesis import given
from hypothesis.extra.numpy import arrays
from hypothesis.strategies import floats

from gfm_hil.engine.vectors import WIDTH, bits, everywhere, put, times, vector, where
from gfm_runtime.inner.stage import limited


@numba.njit(error_model="numpy")
def _compute(a, b, ages, made):
    x, y = vector(a), vector(b)
    put(made[0], x + y * 2.0 - 1 / x)
    put(made[1], np.sqrt(abs(x)) + np.floor(-y))
    put(made[2], limited(x, y, 3.0))
    put(made[3], where((x > y) & ~(y >= 0.0) | (x != x), 0.0, y))
    put(made[4], where(vector(ages) == 2, x, 5.0))
    put(made[5], times((x, y), (y, x))[1])
    return bits(everywhere(True) & (x <= y)), bits(x < y)


_EIGHT = arrays(float, WIDTH, elements=floats(allow_subnormal=False))


@given(_EIGHT, _EIGHT)
def test_vectors_compute_what_numpy_does(a, b):
    ages, made = np.arange(WIDTH) % 3, np.empty((6, WIDTH))
    at_most, below = _compute(a, b, ages, made)
    with np.errstate(all="ignore"):
        expected = [
            a + b * 2.0 - 1 / a,
            np.sqrt(np.abs(a)) + np.floor(-b),
            np.where(np.where(b > a, b, a) > 3.0, 3.0, np.where(b > a, b, a)),
            np.where((a > b) & ~(b >= 0.0) | (a != a), 0.0, b),
            np.where(ages == 2, a, 5.0),
            a * a + b * b,
        ]
    np.testing.assert_array_equal(made, expected)
    assert [at_most >> j & 1 for j in range(WIDTH)] == (a <= b).tolist()
    assert [below >> j & 1 for j in range(WIDTH)] == (a < b).tolist()
