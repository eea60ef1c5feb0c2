"""The DC source's lag and the bridge's modulation limit."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gfm_plant import NoEquilibrium, Plant, make_plant
from gfm_plant.dc_link import advance_dc_link
from gfm_plant.model import V_DC, f
from gfm_runtime.inner import VirtualStator

T_S = 1e-4


@pytest.mark.parametrize("source", [{}, {"mode": "regulated"}])
def test_source_with_a_lag(rest, source):
    """Against SciPy: tau i' = what is asked for - i, and C_dc takes i."""
    plant = rest(P=-0.5, dc_source={**source, "tau_s": 0.02})
    r, u = plant.par[0], plant.near(i_u=0.1, E_u=1e-3)

    def slope(_: float, z: Any) -> Any:
        error = 1.0 - z[V_DC]
        asked = r["i_u_gain"] * u[0] + r["k_p"] * error + z[8]
        dx = f(z[:8].copy(), np.array([z[9], u[1], u[2]]), np.array([1.0, 1.0]), plant.par)
        return np.concatenate([dx, [r["k_i"] * error, (asked - z[9]) / 0.02]])

    z = np.concatenate([plant.x, [plant.u[0] * (1 - r["i_u_gain"]), plant.u[0]]])
    exact = solve_ivp(slope, (0, 0.1), z, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    plant.advance(1000, u)
    assert plant.st["x"][0] == pytest.approx(exact[:8], abs=1e-8)
    assert plant.truth()["i_dc"] == pytest.approx(exact[9], abs=1e-7)


def test_lag_comes_after_the_limit(rest):
    plant = rest(P=-0.5, dc_source={"i_max": 0.6, "tau_s": 0.01})
    plant.advance(100, plant.near(i_u=-9.0))  # one time constant towards -0.6
    start = plant.u[0]
    assert plant.truth()["i_dc"] == pytest.approx(-0.6 + (start + 0.6) * np.exp(-1.0), abs=1e-9)


@pytest.mark.parametrize("tau", [0.0, 1e-3])
def test_a_source_that_reaches_its_limit(rest, tau):
    """Between two ticks; against SciPy in steps of 2 us, which see when."""
    lag = {"tau_s": tau} if tau else {}
    plant = rest(dc_source={"mode": "regulated", "i_max": 0.55, **lag})
    r, u = plant.par[0], plant.near(omega_u=1e-2, E_u=2e-2)

    def slope(_: float, z: Any) -> Any:
        error = 1.0 - z[V_DC]
        asked = r["k_p"] * error + z[8]
        i, di = min(asked, 0.55), r["k_i"] * error
        if asked > 0.55:
            di = min(di, 0.0)
        dx = f(z[:8].copy(), np.array([z[9] if tau else i, *u[1:]]), np.ones(2), plant.par)
        return np.concatenate([dx, [di, (i - z[9]) / tau if tau else 0.0]])

    z = np.concatenate([plant.x, [plant.u[0], plant.u[0]]])
    t = np.arange(1, 101) * T_S
    exact = solve_ivp(slope, (0, t[-1]), z, "DOP853", t, rtol=1e-11, atol=1e-12, max_step=2e-6)
    v_dc = []
    for _ in t:
        plant.advance(u=u)
        v_dc.append(plant.truth()["v_dc"])
    assert min(v_dc) < 0.95  # it was at its limit
    assert np.array(v_dc) == pytest.approx(exact.y[V_DC], abs=2e-8)


@pytest.mark.parametrize("empty", [False, True])
def test_a_link_that_empties(rest, empty):
    """A load of constant power alone: C_dc / omega_b v v' = -p, so v^2 falls in a straight line."""
    plant = rest()
    r, s = plant.par[0], plant.st[0]
    slope = -2.0 * r["omega_b"] / r["C_dc"]
    ticks = 30 if empty else 29
    s["x"][V_DC], s["u_now"][0], s["drawn"] = np.sqrt(-29.5 * slope * T_S), 0.0, 1.0
    for _ in range(ticks):
        advance_dc_link(r, s, T_S / 2)
    if empty:
        assert not s["x"][V_DC] > 0.0
    else:
        assert s["x"][V_DC] == pytest.approx(np.sqrt(-0.5 * slope * T_S), abs=1e-6)


@pytest.mark.parametrize(("modulation", "most"), [("space-vector", 1.3026), ("sine", 1.1281)])
def test_modulation_limits_the_bridge_by_v_dc(rest, modulation, most):
    """Line-to-line RMS of 700 V DC over 380 V, by hand: 1 / sqrt(2), and sqrt(3 / 8)."""
    off = {name: {"enabled": False} for name in ("over_current", "over_voltage")}
    plant = rest(modulation=modulation, protection=off)
    limits = []
    for _ in range(30):
        limits.append(most * plant.truth()["v_dc"])
        plant.advance(u=plant.near(E_u=2.0))
        assert plant.st["E"][0, 0] == pytest.approx(limits[-1], abs=1e-4)
    assert limits[-1] < 0.98 * limits[0]  # v_dc has sagged, and the limit with it


def test_no_rest_beyond_the_modulation(rest):
    with pytest.raises(NoEquilibrium, match=r"need E_u = 1.195 p.u.* gives 1.128 p.u."):
        rest(V=1.2, modulation="sine", grid={"V_g": 1.2})


def test_a_stage_and_the_bridge_have_the_same_limit_of_space_vector_modulation():
    """They differed in the fifth digit, 1.30255 and 1.30257, in the stage
    and the bridge; the circle in the hexagon has sqrt(3/2) / sqrt(3) of v_dc line to line."""
    plant = make_plant(Plant.model_validate({"modulation": "space-vector"}), 1e-4)
    assert VirtualStator().m == plant.par[0]["m_max"]
    m = VirtualStator().m
    assert m == pytest.approx(700 / 380 * math.sqrt(3 / 2) / math.sqrt(3), rel=1e-15)
