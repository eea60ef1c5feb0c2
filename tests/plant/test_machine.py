"""Synchronous machines: the classical model, against SciPy."""

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gfm_plant import Network, NetworkParts, Plant, make_network, plant_command, plant_step
from gfm_plant.components import Machine
from gfm_plant.grid import line_breaker
from gfm_plant.model import DELTA, V_DC
from gfm_plant.names import TRIPS

pytestmark = pytest.mark.full  # compiles the plant for several converters

T_S = 1e-4
OFF = {name: {"enabled": False} for name, *_ in TRIPS}
MACHINE = {"node": "m", "S": 2.0, "H": 0.8, "P": 0.4, "D": 0.5, "T_gov": 0.2, "E": 1.03, "R": 0.004}


def make(**machines: dict[str, Any]) -> Network:
    parts = {
        "loads": {"z": {"node": "m", "P": 0.9, "Q": 0.3}},
        "capacitors": {"c": {"node": "m", "Q": 0.06}},
        "machines": machines,
    }
    plant = Plant.model_validate({"protection": OFF, "dc_source": {"mode": "regulated"}})
    return make_network({"a": (plant, "m")}, T_S, Plant().grid, NetworkParts.model_validate(parts))


def rest(plant: Network, angles: list[float]) -> np.ndarray:
    """Put it where all sources turn at nominal speed; returns the commands."""
    u, x = np.array([[0.0, 1.0, 1.01, 0.0]]), np.zeros((1, 8))
    x[0, DELTA], x[0, V_DC] = 0.02, 1.0
    volts = {"a.bridge": 1.01 * np.exp(0.02j)}
    for (name, machine), angle in zip(plant.wiring.fed, angles, strict=True):
        volts[f"{name}.emf"] = machine.E * np.exp(1j * angle)
    modes, sources = plant.wiring.modes(frozenset(), None)
    w = modes.states @ (modes.drive @ [volts[name] for name in sources] / -modes.rates)
    own = w[:3] * np.exp(-0.02j)
    x[0, 0:6:2], x[0, 1:6:2] = own.real, own.imag
    u[0, 0] = u[0, 2] * own[0].real
    plant.start(x, u, [(np.array([angle]), 1.0) for angle in angles])
    return u


def test_a_step_against_an_adaptive_integrator():
    plant = make(g=MACHINE)
    u = rest(plant, [0.05])
    wiring, n, now = plant.wiring, plant.net[0], plant.now[0]
    (one,) = plant.of(Machine)
    assert wiring.order == ("a.i_f", "a.v", "a.i_o", "z", "g", "c")
    s0 = now["w"][:6]
    E, X, R, S = MACHINE["E"], 0.3 / 2.0, 0.004 / 2.0, 2.0
    P_0 = (E * np.exp(0.05j) * s0[4].conj()).real / S
    assert one["P_turbine"] == pytest.approx(P_0, abs=1e-12)
    r, w_b, z = plant.par[0], wiring.omega_b, 0.9**2 + 0.3**2
    u[0, 2] += 0.05
    u[0, 1] += 1e-3

    def slope(t: float, s: np.ndarray) -> np.ndarray:
        i_f, v, i_o, i_z, i_g, v_m = s[:6]
        angle, omega, P = s[6:9].real
        e = u[0, 2] * np.exp(1j * (0.02 + w_b * (u[0, 1] - 1) * t))
        emf = E * np.exp(1j * angle)
        out = np.empty_like(s)
        out[0] = w_b / r["L_f"] * (e - v - r["R_f"] * i_f)
        out[1] = w_b / r["C_f"] * (i_f - i_o)
        out[2] = w_b / r["L_g"] * (v - v_m - r["R_g"] * i_o)
        out[3] = w_b / (0.3 / z) * (v_m - 0.9 / z * i_z)
        out[4] = w_b / X * (emf - v_m - R * i_g)
        out[5] = w_b / 0.06 * (i_o + i_g - i_z)
        out[:6] -= 1j * w_b * s[:6]
        out[6] = w_b * (omega - 1)
        out[7] = (P - (emf * i_g.conj()).real / S - 0.5 * (omega - 1)) / (2 * 0.8)
        out[8] = (P_0 - (omega - 1) / 0.05 - P) / 0.2
        return out

    start = np.concatenate([s0, [0.05, 1.0, P_0]])
    exact = solve_ivp(slope, (0, 0.3), start, "DOP853", rtol=1e-11, atol=1e-13).y[:, -1]
    for _ in range(3000):
        plant_command(plant.records, 0, u[0])
        plant_step(plant.records)
    assert abs(exact[7] - 1) > 1e-4  # it swings
    assert one["omega"] == pytest.approx(exact[7].real, abs=1e-8)
    assert one["P_turbine"] == pytest.approx(exact[8].real, abs=1e-7)
    assert now["omega_g"] == one["omega"]  # there is no other grid
    angle = np.angle(complex(now["unit"][n["n_converters"] + 2]))
    assert angle == pytest.approx(np.angle(np.exp(1j * exact[6].real)), abs=1e-6)
    assert np.abs(now["w"][:6] - exact[:6]).max() < 1e-6


def test_a_machine_that_is_lost_runs_up_by_itself():
    """Without load: 2 H d(omega)/dt = P_turbine - D (omega - 1), the current is zero at once."""
    plant = make(g=MACHINE, h={**MACHINE, "S": 1.0})
    u = rest(plant, [0.05, 0.03])
    line_breaker(plant, "h", closed=False, clearing="instant")
    now, k = plant.now[0], plant.wiring.order.index("h")
    g, h = plant.of(Machine)
    P = float(h["P_turbine"])
    ticks = 200
    for _ in range(ticks):
        plant_command(plant.records, 0, u[0])
        plant_step(plant.records)
    assert now["w"][k] == 0.0
    assert h["omega"] - 1 == pytest.approx(P * ticks * T_S / (2 * 0.8), rel=0.1)
    assert g["omega"] != h["omega"] and now["omega_g"] == g["omega"]
    line_breaker(plant, "g", closed=False, clearing="instant")
    last = float(now["omega_g"])
    plant_step(plant.records)
    assert now["omega_g"] == last and g["omega"] > last  # the last machine is gone


def test_five_of_a_fifth_are_one():
    found = []
    for count in (1, 5):
        plant = make(**{f"g{k}": {**MACHINE, "S": 2.0 / count} for k in range(count)})
        u = rest(plant, [0.05] * count)
        u[0, 2] += 0.05
        for _ in range(300):
            plant_command(plant.records, 0, u[0])
            plant_step(plant.records)
        found.append([*plant.st["x"][0], plant.of(Machine)["omega"][-1], plant.now["omega_g"][0]])
    assert found[0] == pytest.approx(found[1], abs=1e-11)


def test_a_machine_that_swings_too_fast():
    with pytest.raises(ValueError, match=r"network.machines.g: it swings at .* rad/s; allowed are"):
        make(g={**MACHINE, "H": 1e-4})
