"""The error maps against closed forms in extended precision."""

import numpy as np
import pytest
from numba import njit

from gfm_runtime.error_maps import HYBRID_ANGLE, R_MIN, _sine_of_half, map_errors


@njit
def sines(vectors, half, out):
    """sin((a - b)/2) of pairs of vectors, as the map of hybrid-angle computes it."""
    for k in range(len(vectors)):
        x_a, y_a, x_b, y_b = vectors[k]
        out[k] = _sine_of_half(x_a, y_a, x_b, y_b, half)


@pytest.mark.parametrize("real", [np.float64, np.float32])
def test_the_half_angle_is_right_to_one_and_a_half_eps(real):
    """10^6 pairs of any direction and size against sin and atan2 in extended precision."""
    rng = np.random.default_rng(3)
    angle, size = rng.uniform(-np.pi, np.pi, (2, 10**6)), 2.0 ** rng.uniform(-14, 14, (2, 10**6))
    vectors = np.empty((10**6, 4), real)
    vectors[:, ::2], vectors[:, 1::2] = (size * np.cos(angle)).T, (size * np.sin(angle)).T
    out = np.empty(10**6, real)
    sines(vectors, real(0.5), out)
    x_a, y_a, x_b, y_b = vectors.T.astype(np.longdouble)
    exact = np.sin((np.arctan2(y_a, x_a) - np.arctan2(y_b, x_b)) / 2)
    assert np.max(np.abs(out - exact)) <= 1.5 * np.finfo(real).eps


@pytest.mark.parametrize(
    ("x", "y", "degrees"),
    [
        (1, 0, 0),
        (0, 1, 90),
        (-1, 0, 180),
        (0, -1, -90),
        (0, 0, 0),
        (R_MIN / 2, R_MIN / 2, 0),
        (1e-9, 1e-9, 45),
    ],
)
def test_axes_and_the_vector_without_length(x, y, degrees):
    out = np.empty(1)
    sines(np.array([[x, y, 1.0, 0.0]], float), 0.5, out)
    assert out[0] == pytest.approx(np.sin(np.radians(degrees) / 2), abs=1e-15)


def test_hybrid_angle_is_the_angle_across_the_line():
    """A voltage V behind R + jX: the current conj((p + jq)/V) drops V to V_g e^(-j delta)."""
    R, X, V, V_ref = 0.05, 0.3, 1.05, 1.0
    r, y = np.array([1.0, 0.5, 1.0, 0.1, V_ref]), np.array([1.0, -0.7, 1.0, 0.4, V])

    def delta(p: float, q: float, V: float) -> float:
        return float(-np.angle(V - (R + 1j * X) * np.conj(p + 1j * q) / V))

    expected = np.sin((delta(0.5, 0.1, V_ref) - delta(-0.7, 0.4, V)) / 2)
    map_errors(HYBRID_ANGLE, np.array([R, X]), r, y)
    assert (r[1], y[1]) == (pytest.approx(expected, abs=1e-15), 0.0)
