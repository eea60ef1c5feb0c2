"""The estimate of the grid's reactance from synthetic swings."""

import math

import numpy as np
import pytest
from numba import njit

from gfm_runtime.impedance import estimate, make_impedance

T_S = 1e-4
OMEGA_B = 100 * math.pi


@njit
def feed(est, p, omega_u, V):
    """Feed all samples; returns the estimate after each."""
    out = np.empty(len(p))
    for k in range(len(p)):
        out[k] = estimate(est[0], p[k], omega_u[k], V[k])
    return out


def swing(  # type: ignore[no-untyped-def]
    X: float, hz: float, dp: float, P: float = 0.5, omega_g: float = 1.0, seconds: float = 5.0
):
    """p and omega_u of a converter behind X that swings by dp, its grid at omega_g."""
    t = np.arange(round(seconds / T_S)) * T_S
    delta_0 = math.asin(P * X)
    amplitude = dp * X / math.cos(delta_0)
    delta = delta_0 + amplitude * np.sin(2 * math.pi * hz * t)
    omega_u = omega_g + amplitude * 2 * math.pi * hz / OMEGA_B * np.cos(2 * math.pi * hz * t)
    return np.sin(delta) / X, omega_u, np.ones_like(t)


@pytest.mark.parametrize("X", [0.0174, 0.1, 0.5])
@pytest.mark.parametrize("hz", [2.0, 8.0])
@pytest.mark.parametrize("omega_g", [1.0, 0.998])
def test_a_swing_tells_x(X, hz, omega_g):
    """At any frequency of the grid, which the estimator does not know."""
    est = make_impedance(T_S, 1.0)
    found = feed(est, *swing(X, hz, dp=0.15, omega_g=omega_g))
    np.testing.assert_allclose(found[-5000:], X, rtol=0.05)


@pytest.mark.parametrize("P", [0.0, 0.5, 1.0])
def test_at_any_operating_point(P):
    """On a weak grid sin(delta) differs from delta; the term p^2 corrects for it."""
    est = make_impedance(T_S, 0.02)
    found = feed(est, *swing(0.6, 4.0, dp=0.05, P=P))
    np.testing.assert_allclose(found[-5000:], 0.6, rtol=0.05)


def test_a_change_of_the_grid_is_followed():
    est = make_impedance(T_S, 1.0)
    feed(est, *swing(0.05, 5.0, dp=0.2))
    found = feed(est, *swing(0.2, 5.0, dp=0.2, seconds=8.0))
    np.testing.assert_allclose(found[-5000:], 0.2, rtol=0.05)


def test_noise_does_not_bias_it_much():
    rng = np.random.default_rng(1)
    p, omega_u, V = swing(0.1, 4.0, dp=0.2)
    est = make_impedance(T_S, 1.0)
    noisy = p + 0.02 * rng.normal(size=len(p))
    found = feed(est, noisy, omega_u, V)
    np.testing.assert_allclose(found[-5000:], 0.1, rtol=0.05)


@pytest.mark.parametrize("omega_g", [1.0, 0.99])
def test_held_without_excitation(omega_g):
    """A steady state, or noise on p alone, contains no information about X."""
    rng = np.random.default_rng(2)
    est = make_impedance(T_S, 0.3)
    n = 30_000
    p = 0.5 + 0.01 * rng.normal(size=n)
    found = feed(est, p, np.full(n, omega_g), np.ones(n))
    assert np.all(found == 0.3)


def test_held_once_the_swing_is_over():
    est = make_impedance(T_S, 1.0)
    feed(est, *swing(0.1, 4.0, dp=0.2))
    found = feed(est, np.full(200_000, 0.5), np.ones(200_000), np.ones(200_000))
    assert found[-1] == found[-50_000]
    assert found[-1] == pytest.approx(0.1, rel=0.1)


def test_a_swing_the_wrong_way_round_is_not_believed():
    """p that falls while delta rises does not come from a grid."""
    p, omega_u, V = swing(0.1, 4.0, dp=0.2)
    est = make_impedance(T_S, 0.3)
    found = feed(est, 1.0 - p, omega_u, V)
    assert found[-1] == 0.3


@pytest.mark.parametrize("name", ["T_s", "X_0", "omega_b"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan])
def test_wrong_settings_are_named(name, value):
    settings = {"T_s": T_S, "X_0": 0.1, name: value}
    with pytest.raises(ValueError, match=rf"{name} = .* must be > 0"):
        make_impedance(**settings)


def test_a_step_of_the_grids_frequency_is_not_taken_for_a_swing():
    """p moves because the grid moved: for a moment the converter's own angle has no meaning."""
    p, omega_u, V = swing(0.1, 4.0, dp=0.15, seconds=4.0)
    est = make_impedance(T_S, 1.0)
    feed(est, p, omega_u, V)
    t = np.arange(40_000) * T_S
    moved = 1.0 - 0.002 * (1 - np.exp(-t / 0.05))  # the converter follows in 50 ms
    delta = math.asin(0.5 * 0.1) + np.cumsum(moved - 0.998) * T_S * OMEGA_B
    found = feed(est, np.sin(delta) / 0.1, moved, np.ones_like(t))
    assert np.all(np.abs(found - 0.1) < 0.05)
