"""The grid-following converter: against DOP853, its PLL's own poles, and its limits."""

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gfm_plant import Network, NetworkParts, Plant, make_network, plant_command, plant_step
from gfm_plant.components import GridFollowing
from gfm_plant.components.grid_following import THETA, X
from gfm_plant.model import DELTA, V_DC
from gfm_plant.names import TRIPS

OFF = {name: {"enabled": False} for name, *_ in TRIPS}
DATA = {"node": "m", "S": 0.8, "P": 0.5, "Q": 0.1}
C = 0.1


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
        wanted = complex(g.P, -g.Q) * own / max(abs(own), g.V_least) ** 2
        wanted *= min(1.0, g.I_max / abs(wanted))
        i = x[7]
        out = np.zeros_like(x)
        out[0] = w_b / r["L_f"] * (u[0, 2] - v - r["R_f"] * i_f)
        out[1] = w_b / r["C_f"] * (i_f - i_o)
        out[2] = w_b / r["L_g"] * (v - v_m - r["R_g"] * i_o)
        out[3] = w_b / (0.3 / z) * (v_m - 0.9 / z * i_z)
        out[4] = w_b / C * (i_o + g.S * i * np.exp(1j * theta) - i_z)
        out[:5] -= 1j * w_b * x[:5]
        out[5], out[6] = integral + g.k_p * own.imag, g.k_i * own.imag
        out[7] = (wanted - i) / g.T_i
        return out

    first = np.concatenate([w_0, s_0[:2], [complex(*s_0[2:])]])
    end = solve_ivp(slope, (0, duration), first, "DOP853", rtol=1e-10, atol=1e-12).y[:, -1]
    for _ in range(round(duration / T_s)):
        plant_command(plant.records, 0, u[0])
        plant_step(plant.records)
    mine = [*now["w"][:5], *one["s"][:2], complex(*one["s"][2:])]
    assert abs(one["s"][THETA] - s_0[THETA]) > 1e-4  # something moves
    return np.array(mine), end


@pytest.mark.full  # compiles the plant for several converters
@pytest.mark.parametrize(("more", "most"), [({}, 0.012), ({"I_max": 0.3}, 0.035)])
def test_a_start_against_dop853(more, most):
    """From no current, so that line and bank ring at 1.2 kHz with the size of 1 p.u."""
    mine, exact = stepped(1e-4, **more)
    error = np.abs(mine - exact)
    scale = np.array([1, 1, 1, 1, 1, 1, 100, 1])  # x of the PLL is in rad/s
    assert (error / scale).max() < most and error[5:].max() < 2e-4


@pytest.mark.full
def test_its_error_falls_with_the_square_of_the_step():
    errors = [np.abs(np.subtract(*stepped(T_s))).max() for T_s in (1e-4, 5e-5)]
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
    i = complex(*one["s"][2:]) * np.exp(1j * one["s"][THETA])
    if current is None:
        assert v * i.conjugate() == pytest.approx(complex(0.5, 0.1), abs=1e-9)
    else:
        assert abs(i) == pytest.approx(current, abs=1e-9)
        assert np.angle(v * np.conj(i)) == pytest.approx(np.angle(0.5 + 0.1j), abs=1e-9)
    assert one["s"][X] == pytest.approx(0.0, abs=1e-7)


def test_its_poles_on_a_stiff_voltage():
    """Those of the PLL, s^2 + k_p V s + k_i V, and of the current control, -1/T_i, twice."""
    plant = make()
    (one,) = plant.of(GridFollowing)
    g, v = plant.wiring.fed[0][1], 1.1 * np.exp(0.3j)
    source = g.settle(one, v, 1.0, 100 * np.pi, np.empty(0))
    part = g.linear(one, v, source, 0.0, 100 * np.pi)
    exact = [*np.roots([1.0, g.k_p * 1.1, g.k_i * 1.1]), -1 / g.T_i, -1 / g.T_i]
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
