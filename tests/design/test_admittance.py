"""Passivity and stability from an admittance, against poles and closed forms."""

import math

import numpy as np
import pytest

from gfm_design.margins.admittance import eigenloci, grid_stability, line_impedance, passivity

OMEGA_B = 100 * math.pi
HZ = np.geomspace(0.01, 2000.0, 2000)


def turned(of: np.ndarray) -> np.ndarray:
    """A complex transfer at the positive and the negative frequencies, as a real 2 x 2 one."""
    plus, minus = of[: len(HZ)], of[len(HZ) :].conj()
    d, q = (plus + minus) / 2, (plus - minus) / 2j
    return np.stack([np.stack([d, -q], -1), np.stack([q, d], -1)], -2)


def both() -> np.ndarray:
    return 2j * np.pi * np.concatenate([HZ, -HZ])


def test_a_line_is_its_phasor_impedance_in_the_dq_frame():
    s = both()
    expected = turned(0.02 + (s + 1.01j * OMEGA_B) * 0.3 / OMEGA_B)
    assert line_impedance(HZ, 0.02, 0.3, OMEGA_B, 1.01) == pytest.approx(expected, rel=1e-12)


def test_passivity_is_that_of_a_resistor_and_of_a_constant_power_load():
    R = np.tile(np.diag([4.0, 4.0]).astype(complex), (3, 1, 1))
    assert passivity(R) == pytest.approx([8.0] * 3)
    load = np.tile(np.diag([-0.5, 0.5]).astype(complex), (3, 1, 1))  # P / V^2 in d, against it
    assert passivity(load) == pytest.approx([-1.0] * 3)
    coil = np.linalg.inv(line_impedance(HZ, 0.0, 0.2, OMEGA_B))
    assert np.abs(passivity(coil)).max() < 1e-9 * np.abs(coil).max()


def poles(R: float, L: float, c: float, g: float, b: float) -> np.ndarray:
    """Of R and L in series with a capacitor, and with an active conductance -g that a lag 1/b
    bounds, all in one complex frame: det(I + Z Y) = 0 times the denominators."""
    line = np.array([L / OMEGA_B, R + 1j * L])  # ascending in s from the right
    cap = np.array([c / OMEGA_B, 1j * c])
    Y_num = np.polyadd(np.polymul(cap, [1.0, b]), [-g * b])
    return np.roots(np.polyadd(np.polymul(line, Y_num), [1.0, b]))


@pytest.mark.parametrize(
    ("R", "L", "g", "b"),
    [(0.02, 0.1, 0.4, 300.0), (0.02, 0.1, 2.0, 300.0), (0.02, 0.4, 0.4, 300.0),
     (0.3, 0.6, 0.4, 900.0), (0.3, 0.6, 0.9, 900.0), (0.1, 0.1, 2.2, 50.0)],
)  # fmt: skip
def test_nyquist_counts_the_unstable_poles(R, L, g, b):
    c, stable = 0.2, (0.4, 0.05)
    s = both()
    Y = turned((s / OMEGA_B + 1j) * c - g * b / (s + b))
    assert poles(*stable, c, g, b).real.max() < 0.0
    found = grid_stability(
        HZ, Y, line_impedance(HZ, R, L, OMEGA_B), line_impedance(HZ, *stable, OMEGA_B)
    )
    # each pole of the complex frame is a pair of the real one
    expected = 2 * int((poles(R, L, c, g, b).real > 0.0).sum())
    assert found.unstable == expected, found
    assert found.stable is (expected == 0)


def test_the_margin_is_the_least_distance_from_minus_one():
    Y = np.tile(np.diag([-0.5, 0.25]).astype(complex), (len(HZ), 1, 1))
    Z = np.tile(np.eye(2, dtype=complex), (len(HZ), 1, 1))
    found = grid_stability(HZ, Y, Z, 0.1 * Z)
    assert found.margin == pytest.approx(0.5) and found.stable
    assert sorted(eigenloci(Y, Z)[0].real) == pytest.approx([-0.5, 0.25])


def test_what_the_frequencies_do_not_show_is_not_judged():
    s = both()
    c, g, b = 0.2, 0.4, 300.0
    Y = turned((s / OMEGA_B + 1j) * c - g * b / (s + b))
    Z, stable = (line_impedance(HZ, *x, OMEGA_B) for x in ((0.001, 0.1), (0.4, 0.05)))
    few = slice(None, None, 200)
    found = grid_stability(HZ[few], Y[few], Z[few], stable[few])
    assert found.stable is None and "too few points between" in found.reason
    low = HZ < 200.0
    found = grid_stability(HZ[low], Y[low], Z[low], stable[low])
    assert found.stable is None and found.reason
