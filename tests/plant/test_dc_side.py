"""The DC source's lag, its battery and chopper, and the bridge's modulation limit."""

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


@pytest.mark.full
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


BATTERY = {"energy_s": 5.0, "P_discharge": 0.52, "P_charge": 0.4, "R": 0.05}


def test_a_battery_limits_the_source_and_is_drained_by_what_it_gives(rest):
    """Against SciPy in steps of a tick, as the limit samples v_dc; R i^2 - i + P = 0."""
    plant = rest(dc_source={"mode": "regulated", "battery": BATTERY})
    r, u = plant.par[0], plant.near(omega_u=2e-3, E_u=1e-2)
    z = np.concatenate([plant.x, [plant.u[0], 0.5]])
    limited = 0
    for _ in range(300):
        most = 0.52 / z[V_DC]

        def slope(_: float, z: Any, most: float = most) -> Any:
            error = 1.0 - z[V_DC]
            asked = r["k_p"] * error + z[8]
            i, di = min(asked, most), r["k_i"] * error
            if asked > most:
                di = min(di, 0.0)
            dx = f(z[:8].copy(), np.array([i, *u[1:]]), np.ones(2), plant.par)
            drained = (1 - math.sqrt(1 - 4 * 0.05 * i * z[V_DC])) / (2 * 0.05)
            return np.concatenate([dx, [di, -drained / 5.0]])

        step = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-12, "max_step": 1e-5}
        z = solve_ivp(slope, (0, T_S), z, **step).y[:, -1]
        plant.advance(u=u)
        limited += plant.truth()["i_dc"] == plant.st["i_most"][0, 0]
        assert plant.truth()["v_dc"] == pytest.approx(z[V_DC], abs=1e-7)
        assert plant.st["soc"][0] == pytest.approx(z[9], abs=1e-7)
    assert 50 < limited < 300 and plant.st["soc"][0] < 0.497


@pytest.mark.parametrize(("P", "soc", "end"), [(0.5, 0.051, 0.05), (-0.5, 0.949, 0.95)])
def test_an_empty_battery_gives_nothing_and_a_full_one_takes_nothing(rest, P, soc, end):
    off = {name: {"enabled": False} for name in ("dc_under_voltage", "dc_over_voltage")}
    battery = {"energy_s": 5.0, "soc": soc}
    plant = rest(P=P, protection=off, dc_source={"mode": "regulated", "battery": battery})
    plant.advance(110)
    assert plant.st["soc"][0] == pytest.approx(end, abs=2e-5)
    assert plant.truth()["i_dc"] == 0.0
    charge = float(plant.st["soc"][0])
    plant.advance(20)
    assert plant.st["soc"][0] == charge


def test_a_chopper_holds_the_link_in_its_band(rest):
    """A source that goes on giving raises v_dc until the resistor takes more than it gives."""
    off = {"dc_over_voltage": {"enabled": False}}
    chopper = {"P": 2.0, "v_on": 1.2, "v_off": 1.1}
    plant = rest(P=0.0, protection=off, dc_source={"chopper": chopper})
    r = plant.par[0]
    v, on = [], []
    for _ in range(3000):
        plant.advance(u=plant.near(i_u=0.5))
        v.append(plant.truth()["v_dc"])
        on.append(plant.st["chopper"][0])
    rate = r["omega_b"] / r["C_dc"] * T_S
    assert set(on) == {0.0, 2.0}
    assert 1.2 < max(v) < 1.2 + 1.1 * rate * 0.5
    first = on.index(2.0)
    settled = v[first:]
    assert min(settled) > 1.1 - 1.1 * rate * (2.0 * 1.2 - 0.5)
    # C v' = omega_b (i - p / v - g v), and the bridge draws nearly nothing
    for k in (first - 2, first + 2):
        step = v[k + 1] - v[k]
        assert step == pytest.approx(rate * (0.5 - on[k] * v[k]), rel=0.05)
