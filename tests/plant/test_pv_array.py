"""The PV array across the DC link, and behind the DC source."""

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.integrate import solve_ivp
from scipy.optimize import minimize_scalar

from gfm_plant import Plant, make_plant, set_irradiance
from gfm_plant.dc_link import advance_dc_link
from gfm_plant.model import V_DC, f
from gfm_plant.pv_array import array_current, array_slope, most_power, open_circuit_voltage

SHEET = {"V_oc": 1.25, "I_sc": 1.08, "V_mp": 1.0, "I_mp": 1.0}
ACROSS = {"mode": "array", "pv": SHEET}
OFF = {name: {"enabled": False} for name in ("dc_under_voltage", "dc_over_voltage", "over_current")}


def current(v: Any, G: float) -> Any:
    """By hand: C_2 = -0.2 / ln(1 - 1 / 1.08), C_1 = (1 - 1 / 1.08) exp(-1 / (1.25 C_2))."""
    C_2 = -0.2 / np.log(1 - 1 / 1.08)
    C_1 = (1 - 1 / 1.08) * np.exp(-1 / (1.25 * C_2))
    return 1.08 * (G - C_1 * (np.exp(v / (1.25 * C_2)) - 1))


def record(**pv: float) -> Any:
    options = {"dc_source": {"mode": "array", "pv": {**SHEET, **pv}}}
    return make_plant(Plant.model_validate(options), 1e-4).par[0]


@pytest.mark.parametrize(
    "sheet",
    [
        SHEET,
        {"V_oc": 49.5, "I_sc": 13.9, "V_mp": 41.6, "I_mp": 13.2},  # of a module, V and A
        {"V_oc": 1.4, "I_sc": 0.9, "V_mp": 1.1, "I_mp": 0.8},
    ],
)
def test_the_curve_passes_through_the_data_sheet(sheet):
    """The simplified form misses the points at V_oc and V_mp by C_1 I_sc."""
    r = record(**sheet)
    miss = float(r["I_0"])
    assert miss < 1e-3 * sheet["I_sc"]
    points = (0.0, sheet["I_sc"]), (sheet["V_mp"], sheet["I_mp"]), (sheet["V_oc"], 0.0)
    for v, i in points:
        assert array_current(r, 1.0, v) == pytest.approx(i, abs=1.001 * miss)


@pytest.mark.parametrize("G", [1.2, 1.0, 0.3, 0.01])
def test_most_power_slope_and_open_circuit(G):
    r = record()
    best = minimize_scalar(
        lambda v: -v * current(v, G), bounds=(0.1, 1.4), method="bounded", options={"xatol": 1e-9}
    )
    P, v = most_power(r, G)
    assert -best.fun == pytest.approx(P, rel=1e-12) and best.x == pytest.approx(v, abs=1e-6)
    assert array_current(r, G, open_circuit_voltage(r, G)) == pytest.approx(0.0, abs=1e-14)
    slope = (current(v + 1e-5, G) - current(v - 1e-5, G)) / 2e-5
    assert array_slope(r, v) == pytest.approx(slope, rel=1e-7)


@pytest.mark.full
def test_v_dc_follows_the_array(rest):
    """Against SciPy, up to 1.38 p.u., where the array takes current; the error falls with T_s."""
    errors = []
    for T_s in (1e-4, 5e-5):
        plant = rest(T_s, P=0.9, dc_source=ACROSS, protection=OFF)
        u = plant.near(omega_u=-3e-3, E_u=2e-2)
        set_irradiance(plant.plant, 1.1)

        def slope(_: float, x: Any, u: Any = u, par: Any = plant.par) -> Any:
            return f(x.copy(), np.array([current(x[V_DC], 1.1), *u[1:]]), np.ones(2), par)

        step = {"method": "DOP853", "rtol": 3e-14, "atol": 1e-15, "first_step": 1e-6}
        exact = solve_ivp(slope, (0, 0.2), plant.x, **step).y
        plant.advance(round(0.2 / T_s), u)
        assert plant.st["x"][0] == pytest.approx(exact[:, -1], abs=1e-9)
        errors.append(abs(plant.st["x"][0, V_DC] - exact[V_DC, -1]))
        truth = plant.truth()
        assert truth["i_dc"] == pytest.approx(current(truth["v_dc"], 1.1), abs=1e-12)
    assert np.ptp(exact[V_DC]) > 0.4
    assert errors[0] > 12 * errors[1]  # the power in a piece is a parabola: the fourth order


def test_the_energy_of_the_array_is_in_the_capacitor_and_the_chopper(rest):
    """The bridge draws nothing: C_dc / (2 omega_b) v^2 grows by what v i and -g v^2 bring."""
    chopper = {"P": 0.4, "v_on": 0.95, "v_off": 0.5}
    plant = rest(dc_source={**ACROSS, "chopper": chopper}, protection=OFF)
    r, s = plant.par[0], plant.st[0]
    assert s["chopper"] == 0.4
    s["x"][V_DC], v = 0.8, [0.8]
    for _ in range(2000):
        v += advance_dc_link(r, s, 5e-5)
    v = np.array(v)
    gives = v * current(v, 1.0) - 0.4 * v * v
    simpson = (gives[:-2:2] + 4 * gives[1:-1:2] + gives[2::2]).sum() * 1e-4 / 6
    assert v[-1] > 1.0
    assert r["C_dc"] / (2 * r["omega_b"]) * (v[-1] ** 2 - 0.64) == pytest.approx(simpson, abs=1e-13)


def test_irradiance_moves_in_a_step_or_a_ramp(rest):
    plant = rest(P=0.9, dc_source=ACROSS)
    set_irradiance(plant.plant, 0.95)
    assert plant.st["irradiance"][0] == 0.95
    set_irradiance(plant.plant, 0.9, rate=10.0)
    plant.advance(30)
    assert plant.st["irradiance"][0] == pytest.approx(0.92, abs=1e-12)
    plant.advance(30)
    assert plant.st["irradiance"][0] == 0.9


def test_after_a_trip_the_array_is_off(rest):
    plant = rest(P=0.9, dc_source=ACROSS, protection={"dc_over_voltage": {"threshold": 1.01}})
    plant.advance(200, plant.near(omega_u=-1e-2))
    v_dc = plant.truth()["v_dc"]
    assert plant.truth()["trip"] > 0
    plant.advance(10)
    assert plant.truth()["i_dc"] == 0.0 and plant.truth()["v_dc"] == v_dc


def test_behind_the_source_the_array_limits_its_power(rest):
    """To the most that the light gives, sampled at the tick; it takes nothing back."""
    plant = rest(P=0.6, dc_source={"mode": "regulated", "pv": SHEET}, protection=OFF)
    plant.advance(10)
    assert plant.truth()["v_dc"] == pytest.approx(1.0, abs=1e-9)
    for G, rate, ticks in ((0.4, None, 200), (0.5, 100.0, 20)):
        set_irradiance(plant.plant, G, rate)
        plant.advance(ticks)
        best = minimize_scalar(
            lambda v, G=G: -v * current(v, G), bounds=(0.1, 1.2), method="bounded"
        )
        truth = plant.truth()
        assert truth["v_dc"] < 0.95
        assert truth["i_dc"] * truth["v_dc"] == pytest.approx(-best.fun, rel=1e-9)
    plant = rest(P=-0.3, dc_source={"mode": "regulated", "pv": SHEET}, protection=OFF)
    plant.advance(3)
    assert plant.truth()["i_dc"] == 0.0 and plant.truth()["v_dc"] > 1.0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"dc_source": {"mode": "array"}}, "mode = 'array': needs a table pv"),
        ({"dc_source": {**ACROSS, "i_max": 1.0}}, "i_max: not with mode = 'array'"),
        (
            {"dc_source": {"mode": "array", "pv": {**SHEET, "V_mp": 1.25}}},
            r"V_mp = 1.25: must be more than 0.625 and less than 1.24375, by V_oc; it is 1 of it",
        ),
        ({"dc_source": {"pv": SHEET, "battery": {"energy_s": 5.0}}}, "pv, battery: give one"),
        (
            {"dc_source": ACROSS, "bridge": {"kind": "two-level"}},
            "plant.bridge.kind = 'two-level': a PV array straight across",
        ),
        ({"dc_source": ACROSS, "factors": {"C_dc": 1e-5}}, "plant.dc_source pv: with C_dc"),
    ],
)
def test_what_cannot_be(options, said):
    with pytest.raises((ValidationError, ValueError), match=said):
        make_plant(Plant.model_validate(options), 1e-4)
