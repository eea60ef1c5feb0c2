"""The exact solution against SciPy's DOP853 on the same equations; what of it is not exact, and
how fast that converges."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from gfm_plant.model import V_DC, f

T_S = 1e-4
D = np.array([1.0, 1.0])

Segments = list[tuple[int, NDArray[np.float64]]]  # (ticks, u held for these ticks)


def reference(rest: Any, segments: Segments) -> NDArray[np.float64]:
    """Return x at every tick with the DC source's PI, (ticks, 8), to 1e-12 relative."""
    r = rest.par[0]

    def slope(_: float, z: NDArray[np.float64], u: NDArray[np.float64]) -> NDArray[np.float64]:
        error = 1.0 - z[7]
        i_dc = r["i_u_gain"] * u[0] + r["k_p"] * error + z[8]
        dx = f(z[:8].copy(), np.array([i_dc, u[1], u[2]]), D, rest.par)
        return np.append(dx, r["k_i"] * error)

    z = np.append(rest.x, rest.u[0] * (1.0 - r["i_u_gain"]))
    rows = []
    for ticks, u in segments:
        t = np.arange(1, ticks + 1) * T_S
        solution = solve_ivp(slope, (0, t[-1]), z, "DOP853", t, rtol=1e-12, atol=1e-13, args=(u,))
        z = solution.y[:, -1]
        rows.append(solution.y[:8].T)
    return np.concatenate(rows)


def emulated(rest: Any, segments: Segments) -> NDArray[np.float64]:
    rows = []
    for ticks, u in segments:
        for _ in range(ticks):
            rest.advance(u=u)
            rows.append(rest.st["x"][0].copy())
    return np.array(rows)


def assert_exact(x: NDArray[np.float64], truth: NDArray[np.float64]) -> None:
    error = np.abs(x - truth).max(axis=0)
    assert np.delete(error, V_DC).max() < 1e-9
    assert error[V_DC] < 1e-8


def test_one_second_open_loop(rest):
    """The paper's DC source while it charges: v_dc is then stable without control."""
    plant = rest(P=-0.5)
    segments = [(10_000, plant.near(E_u=1e-3))]
    x = emulated(plant, segments)
    assert np.ptp(x[:, 4]) > 0.03  # the state did move
    assert_exact(x, reference(plant, segments))


@pytest.mark.full
def test_one_second_with_the_regulated_source(rest):
    """The angle moves for 50 ms at +0.001 p.u., which is 0.45 p.u. of power; then it is held."""
    plant = rest(dc_source={"mode": "regulated"})
    segments = [(500, plant.near(omega_u=1e-3)), (9500, plant.u)]
    x = emulated(plant, segments)
    assert np.ptp(x[:, 4]) > 0.4
    assert_exact(x, reference(plant, segments))


def test_fourth_order_of_the_dc_link(rest):
    """A step makes the filter ring; half the period gives a sixteenth of the error of v_dc."""
    errors = []
    for n in (1, 2, 4):
        plant = rest(T_s=T_S / n, dc_source={"mode": "regulated"})
        u = plant.near(omega_u=1e-2, E_u=2e-2)
        x = emulated(plant, [(100 * n, u)])[n - 1 :: n]
        errors.append(np.abs(x - reference(plant, [(100, u)]))[:, V_DC].max())
    assert errors[0] > 1e-10  # far above rounding
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders == pytest.approx([4.0, 4.0], abs=0.3)


@pytest.mark.parametrize("omega_u", [0.0, 1e-9, 1e-6, 1e-3])
def test_a_circuit_without_losses_driven_near_its_own_frequency(rest, omega_u):
    """Without resistance the currents' mean is a mode at 0 Hz, which the bridge then drives."""
    off = {"over_current": {"enabled": False}, "under_frequency": {"enabled": False}}
    plant = rest(factors={"R_f": 0.0, "R_g": 0.0}, protection=off, dc_source={"mode": "regulated"})
    u = np.array([plant.u[0], omega_u, 0.1])
    x, truth = emulated(plant, [(20, u)]), reference(plant, [(20, u)])
    assert abs(x[-1, 0]) > 0.1
    assert np.abs(np.delete(x - truth, V_DC, axis=1)).max() < 1e-9


def test_power_balance_of_a_run(rest):
    """Energy from C_dc and the DC source is lost, stored or delivered, by Simpson's rule."""
    plant = rest(T_s=1e-5)
    u = plant.near(i_u=0.2, omega_u=5e-4, E_u=2e-3)
    n = 10_000  # even
    x = np.concatenate([plant.x[None], emulated(plant, [(n, u)])])
    r = plant.par[0]
    i, v, i_o = x[:, 0:2], x[:, 2:4], x[:, 4:6]
    v_g = np.stack([np.cos(x[:, 6]), -np.sin(x[:, 6])], axis=1)

    def square(z: NDArray[np.float64]) -> NDArray[np.float64]:
        return (z * z).sum(axis=1)

    flow = u[0] * x[:, 7] - r["R_f"] * square(i) - r["R_g"] * square(i_o) - (v_g * i_o).sum(axis=1)
    weights = np.ones(n + 1)
    weights[1:-1:2], weights[2:-1:2] = 4.0, 2.0
    stored = (
        r["L_f"] * square(i) + r["C_f"] * square(v) + r["L_g"] * square(i_o)
        + r["C_dc"] * x[:, 7] ** 2
    ) / (2 * r["omega_b"])  # fmt: skip
    change = stored[-1] - stored[0]
    assert abs(change) > 1e-3
    assert change == pytest.approx(weights @ flow * 1e-5 / 3, abs=1e-9)
