"""The H-infinity norm against python-control, dense grids and values computed by hand."""

import control
import numpy as np
import pytest

from gfm_design.norms.hinf import Unstable, hinf_norm

Matrix = np.ndarray


def random_system(seed: int, direct: bool) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    random = np.random.default_rng(seed)
    n, m, p = random.integers(2, 9), random.integers(1, 4), random.integers(1, 4)
    A = random.normal(size=(n, n))
    A -= (np.linalg.eigvals(A).real.max() + 0.1) * np.eye(n)
    D = random.normal(size=(p, m)) * direct
    return A, random.normal(size=(n, m)), random.normal(size=(p, n)), D


def on_grid(A: Matrix, B: Matrix, C: Matrix, D: Matrix, points: Matrix) -> float:
    """The largest singular value at complex frequencies."""
    inner = np.linalg.solve(points[:, None, None] * np.eye(len(A)) - A, B[None])
    return float(np.linalg.svd(C @ inner + D, compute_uv=False).max())


@pytest.mark.parametrize("direct", [False, True])
@pytest.mark.parametrize("seed", range(12))
def test_random_systems(seed, direct):
    system = random_system(seed, direct)
    found = hinf_norm(*system)
    # control takes a tolerance of 1e-10 here
    assert found.gain == pytest.approx(
        control.linfnorm(control.ss(*system), tol=1e-10)[0], rel=1e-6
    )
    w = np.concatenate([[0.0], np.logspace(-3, 3, 3000)])
    assert on_grid(*system, 1j * w) <= found.gain * (1 + 1e-8)
    if np.isfinite(found.omega):
        assert on_grid(*system, np.array([1j * found.omega])) == pytest.approx(found.gain, rel=1e-9)


@pytest.mark.parametrize("seed", range(8))
def test_discrete_systems(seed):
    A, B, C, D = random_system(seed, True)
    A = A / (np.abs(np.linalg.eigvals(A)).max() * 1.05)
    T = 1e-3
    found = hinf_norm(A, B, C, D, T_s=T)
    z = np.exp(1j * np.linspace(0, np.pi, 4000))
    assert on_grid(A, B, C, D, z) == pytest.approx(found.gain, rel=2e-3)  # of the grid
    assert on_grid(A, B, C, D, z) <= found.gain * (1 + 1e-8)
    peak = np.array([np.exp(1j * found.omega * T)])
    assert on_grid(A, B, C, D, peak) == pytest.approx(found.gain, rel=1e-7)


@pytest.mark.parametrize("damping", [1e-3, 1e-6])
def test_resonance_close_to_the_axis(damping):
    # 1/(s^2 + 2 d w s + w^2): the peak is 1/(2 d sqrt(1 - d^2) w^2), by hand
    w = 6800.0
    A = np.array([[0.0, w], [-w, -2 * damping * w]])
    found = hinf_norm(A, np.array([[0.0], [w]]), np.array([[1.0, 0.0]]), np.zeros((1, 1)))
    assert found.gain == pytest.approx(1 / (2 * damping * np.sqrt(1 - damping**2)), rel=1e-6)
    assert found.omega == pytest.approx(w, rel=1e-5)


def test_peak_only_in_the_limit():
    # (s + 1)/(s + 2) grows towards 1
    one = np.ones((1, 1))
    found = hinf_norm(-2 * one, one, -one, one)
    assert found.gain == pytest.approx(1.0, rel=1e-8)


def test_scales_eight_decades_apart():
    # (s + 4)/(s + 4e-4) into 1/(1.4e-5 s + 1): 1e4 at s = 0
    A = np.array([[-4e-4, 0.0], [1e5 / 1.4, -1e5 / 1.4]])
    B, C = np.array([[4.0 - 4e-4], [1e5 / 1.4]]), np.array([[0.0, 1.0]])
    found = hinf_norm(A, B, C, np.zeros((1, 1)))
    assert found.gain == pytest.approx(1e4, rel=1e-6)


@pytest.mark.parametrize("T_s", [None, 1e-4])
def test_no_norm_on_or_beyond_the_edge(T_s):
    one = np.ones((1, 1))
    for pole in (0.0, 1.0) if T_s is None else (1.0, -1.0, 1.5):
        with pytest.raises(Unstable, match="unstable"):
            hinf_norm(pole * one, one, one, 0 * one, T_s)
