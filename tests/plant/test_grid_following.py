"""The grid-following converter: against DOP853, its PLL's own poles, and its limits."""

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gfm_plant import Network, NetworkParts, Plant, make_network, plant_command, plant_step
from gfm_plant.components import GridFollowing
from gfm_plant.components.grid_following import THETA, V, X
from gfm_plant.model import DELTA, V_DC
from gfm_plant.names import TRIPS

OFF = {name: {"enabled": False} for name, *_ in TRIPS}
DATA = {"node": "m", "S": 0.8, "P": 0.5, "Q": 0.1}
C = 0.1
SUPPORT = {"k_V": 2.0, "band": 0.02, "I_max": 0.6}


def make(T_s: float = 1e-4, **more: Any) -> Network:
    parts = {
        "loads": {"z": {"node": "m", "P": 0.9, "Q": 0.3}},
        "capacitors": {"c": {"node": "m", "Q": C}},
        "grid_following": {"g": DATA | more},
    }
    plant = Plant.model_validate({"protection": OFF, "dc_source": {"mode": "regulated"}})
    return make_network({"a": (plant, "m")}, T_s, Plant().grid, NetworkParts.model_validate(parts))


def started(plant: Network, E: float = 1.05) -> np.ndarray:
    """Put a bridge at E and nominal frequency on it; returns the commands."""
    x, u = np.zeros((1, 8)), np.array([[0.0, 1.0, E, 0.0]])
    x[0, V_DC], x[0, DELTA] = 1.0, 0.0
    plant.start(x, u)
    return u


def wanted(g: GridFollowing, v: complex, V: float) -> complex:
    """The current that it asks for at a voltage v, of which it has measured the size V."""
    size = max(abs(v), g.V_least)
    i = complex(g.P, -g.Q) / size  # along v, and across it
    off = V - 1.0
    if g.k_V > 0.0 and abs(off) > g.band:
        reactive = i.imag + g.k_V * np.sign(off) * (abs(off) - g.band)
        reactive = np.clip(reactive, -g.I_max, g.I_max)
        left = np.sqrt(g.I_max**2 - reactive**2)
        i = complex(np.clip(i.real, -left, left), reactive)
    i *= v / size
    return i * min(1.0, g.I_max / abs(i))


def stepped(T_s: float, duration: float = 0.05, **more: Any) -> tuple[np.ndarray, np.ndarray]:
    """Circuit and states of the converter a time after such a start, of the plant and DOP853."""
    plant = make(T_s, **more)
    u = started(plant)
    assert plant.wiring.order == ("a.i_f", "a.v", "a.i_o", "z", "c")
    now, r, w_b = plant.now[0], plant.par[0], plant.wiring.omega_b
    (one,), z = plant.of(GridFollowing), 0.9**2 + 0.3**2
    g = plant.wiring.fed[0][1]
    w_0, s_0 = now["w"][:5].copy(), one["s"].copy()

    def slope(t: float, x: np.ndarray) -> np.ndarray:
        i_f, v, i_o, i_z, v_m = x[:5]
        theta, integral = x[5:7].real
        own = v_m * np.exp(-1j * theta)
        i = x[7]
        out = np.zeros_like(x)
        out[0] = w_b / r["L_f"] * (u[0, 2] - v - r["R_f"] * i_f)
        out[1] = w_b / r["C_f"] * (i_f - i_o)
        out[2] = w_b / r["L_g"] * (v - v_m - r["R_g"] * i_o)
        out[3] = w_b / (0.3 / z) * (v_m - 0.9 / z * i_z)
        out[4] = w_b / C * (i_o + g.S * i * np.exp(1j * theta) - i_z)
        out[:5] -= 1j * w_b * x[:5]
        out[5], out[6] = integral + g.k_p * own.imag, g.k_i * own.imag
        out[7] = (wanted(g, own, x[8].real) - i) / g.T_i
        out[8] = (abs(v_m) - x[8]) / g.T_V
        return out

    first = np.concatenate([w_0, s_0[:2], [complex(*s_0[2:4]), s_0[V]]])
    end = solve_ivp(slope, (0, duration), first, "DOP853", rtol=1e-10, atol=1e-12).y[:, -1]
    for _ in range(round(duration / T_s)):
        plant_command(plant.records, 0, u[0])
        plant_step(plant.records)
    mine = [*now["w"][:5], *one["s"][:2], complex(*one["s"][2:4]), one["s"][V]]
    assert abs(one["s"][THETA] - s_0[THETA]) > 1e-4  # something moves
    return np.array(mine), end


@pytest.mark.full  # compiles the plant for several converters
@pytest.mark.parametrize(
    ("more", "most", "own"),
    [({}, 0.012, 2e-4), ({"I_max": 0.3}, 0.035, 2e-4), (SUPPORT, 0.03, 5e-4)],
)
def test_a_start_against_dop853(more, most, own):
    """From no current, so that line and bank ring at 1.2 kHz with the size of 1 p.u."""
    mine, exact = stepped(1e-4, **more)
    error = np.abs(mine - exact)
    scale = np.array([1, 1, 1, 1, 1, 1, 100, 1, 1])  # x of the PLL is in rad/s
    assert (error / scale).max() < most and error[5:8].max() < own and error[8] < 5e-4


@pytest.mark.full
@pytest.mark.parametrize("more", [{}, SUPPORT])
def test_its_error_falls_with_the_square_of_the_step(more):
    errors = [np.abs(np.subtract(*stepped(T_s, **more))).max() for T_s in (1e-4, 5e-5)]
    assert 3.0 < errors[0] / errors[1] < 6.0


@pytest.mark.full
@pytest.mark.parametrize(("more", "current"), [({}, None), ({"I_max": 0.3}, 0.3)])
def test_at_rest_it_brings_its_set_points(more, current):
    plant = make(**more)
    u = started(plant)
    for _ in range(20_000):
        plant_command(plant.records, 0, u[0])
        plant_step(plant.records)
    (one,), v = plant.of(GridFollowing), plant.now[0]["w"][4]
    i = complex(*one["s"][2:4]) * np.exp(1j * one["s"][THETA])
    if current is None:
        assert v * i.conjugate() == pytest.approx(complex(0.5, 0.1), abs=1e-9)
    else:
        assert abs(i) == pytest.approx(current, abs=1e-9)
        assert np.angle(v * np.conj(i)) == pytest.approx(np.angle(0.5 + 0.1j), abs=1e-9)
    assert one["s"][X] == pytest.approx(0.0, abs=1e-7)


@pytest.mark.parametrize("V", [0.5, 0.95, 1.0, 1.2])
@pytest.mark.parametrize("more", [{}, {"k_V": 2.0}, {"k_V": 20.0, "band": 0.0}])
def test_it_supports_the_voltage_beyond_its_dead_band(V, more):
    g = GridFollowing.model_validate({**DATA, "P": 0.9, **more})
    v = V * np.exp(0.4j)
    i = g.brings(v)
    assert i == pytest.approx(wanted(g, v, V), abs=1e-12) and abs(i) < g.I_max + 1e-12
    S = v * np.conj(i)
    if V == 0.5 and more.get("k_V") == 2.0:  # 0.8 p.u. of reactive current, and the rest of 1.2
        across = 0.1 / V + 2.0 * (0.9 - V)
        assert pytest.approx(V * complex(np.sqrt(1.2**2 - across**2), across), abs=1e-12) == S
    if V == 0.95 and more == {"k_V": 20.0, "band": 0.0}:
        assert S.imag > 0.1


def test_its_poles_on_a_stiff_voltage():
    """Those of the PLL, s^2 + k_p V s + k_i V, of the current control, -1/T_i, twice, and of the
    measurement of the voltage."""
    plant = make()
    (one,) = plant.of(GridFollowing)
    g, v = plant.wiring.fed[0][1], 1.1 * np.exp(0.3j)
    source = g.settle(one, v, 1.0, 100 * np.pi, np.empty(0))
    part = g.linear(one, v, source, 0.0, 100 * np.pi)
    exact = [*np.roots([1.0, g.k_p * 1.1, g.k_i * 1.1]), -1 / g.T_i, -1 / g.T_i, -1 / g.T_V]
    found = np.linalg.eigvals(part.A)
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(exact), rtol=1e-5)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"T_i": 1e-4}, r"network.grid_following.g: T_i = 0.0001: as fast as 10000 rad/s; allowed"),
        ({"k_p": 1e4}, r"grid_following.g: k_p = 10000: as fast as"),
        ({"T_i": -1.0}, r"grid_following.g.T_i\n.*greater than 0"),
        ({"node": "n"}, r"node n: g brings a current, so the node needs a bank|no path"),
    ],
)
def test_data_of_no_converter(more, message):
    with pytest.raises(ValueError, match=message):
        make(**more)
