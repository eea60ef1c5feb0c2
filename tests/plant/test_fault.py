"""Three-phase faults on the line and at the filter capacitor, and their clearing."""

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gfm_plant import clear_fault, fault, grid_impedance

WEAK = {"scr": 3.0, "x_over_r": 6.0}
NO_TRIP = {name: {"enabled": False} for name in ("over_current", "under_voltage", "over_voltage")}


def moved(plant: Any, w: Any, t: float, at: float, R: float | None) -> Any:
    """w = (i_f, v, i_o, i_g) after t seconds, in the frame of u: the network's own equations.

    R: of the fault; None: none, and i_g is i_o.
    """
    r, E = plant.par[0], plant.u[2]
    v_g = np.exp(-1j * plant.x[6])
    L, Z = r["L_g"], r["R_g"]

    def slope(_: float, w: Any) -> Any:
        i_f, v, i_o, i_g = w
        leak = 0.0
        if R is None:
            di_o = di_g = (v - v_g - Z * i_o) / L
        elif at == 0:
            leak = v / R
            di_o = di_g = (v - v_g - Z * i_o) / L
        else:
            there = R * (i_o - i_g)
            di_o = (v - there - at * Z * i_o) / (at * L)
            di_g = (there - v_g - (1 - at) * Z * i_g) / ((1 - at) * L)
        rates = [(E - v - r["R_f"] * i_f) / r["L_f"], (i_f - i_o - leak) / r["C_f"], di_o, di_g]
        return r["omega_b"] * (np.array(rates) - 1j * w)

    return solve_ivp(slope, (0, t), w, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]


@pytest.mark.parametrize(("at", "R"), [(0.0, 0.5), (0.0, 0.3), (0.4, 0.0), (0.7, 0.1)])
def test_fault_and_clearing_against_the_equations(rest, at, R):
    plant = rest(grid=WEAK, protection=NO_TRIP, dc_source={"mode": "regulated"})
    x = plant.x[:6]
    w = np.array([complex(*x[:2]), complex(*x[2:4]), complex(*x[4:]), complex(*x[4:])])
    fault(plant.plant, at, R, duration=0.02, clearing="instant")
    plant.advance(200)
    w = moved(plant, w, 0.02, at, R)
    if at > 0:
        i_g = plant.phasor("beyond")
        assert abs(w[2] - w[3]) > 0.1
        w[2] = w[3] = at * w[2] + (1 - at) * w[3]  # the line keeps its flux
        assert i_g == pytest.approx(w[3], abs=1e-9)  # cleared at the end of the last tick
    now = plant.st["x"][0]
    assert [complex(*now[k : k + 2]) for k in (0, 2, 4)] == pytest.approx(w[:3], abs=1e-9)
    plant.advance(100)
    w = moved(plant, w, 0.01, at, None)
    assert [complex(*now[k : k + 2]) for k in (0, 2, 4)] == pytest.approx(w[:3], abs=1e-9)


def test_bolted_fault_in_the_steady_state(rest):
    """The bridge feeds its filter and 0.3 of the line: phasors at nominal frequency, by hand."""
    plant = rest(grid=WEAK, protection=NO_TRIP, dc_source={"mode": "regulated", "k_p": 200.0})
    fault(plant.plant, 0.3, 0.0)
    plant.advance(20_000)
    r = plant.par[0]
    Z_f, Z = complex(r["R_f"], r["L_f"]), 0.3 * complex(r["R_g"], r["L_g"])
    Y = 1 / Z + 1j * r["C_f"]
    v = plant.u[2] / (1 + Z_f * Y)
    assert complex(*plant.st["x"][0, 2:4]) == pytest.approx(v, abs=1e-6)
    assert complex(*plant.st["x"][0, 4:6]) == pytest.approx(v / Z, abs=1e-6)
    clear_fault(plant.plant)
    plant.advance(20_000)
    assert plant.st["x"][0, :7] == pytest.approx(plant.x[:7], abs=1e-6)


def test_fault_on_a_tripped_plant_and_a_new_line(rest):
    """A bolted fault trips by current; the grid then feeds it alone through 0.8 of the line."""
    plant = rest(grid=WEAK)
    fault(plant.plant, 0.2, 0.0)
    plant.advance(50)
    assert plant.truth()["trip"] == 1
    grid_impedance(plant.plant, 2 * plant.par[0]["L_g"] / plant.par[0]["L_line_n"], 100.0)
    plant.advance(20_000)
    r = plant.par[0]
    i_g = abs(plant.phasor("beyond"))
    assert i_g == pytest.approx(1 / abs(0.8 * complex(r["R_g"], r["L_g"])), abs=1e-6)
    assert plant.truth()["V"] < 1e-6


@pytest.mark.parametrize(
    ("at", "R", "duration", "message"),
    [
        (1.0, 0.1, None, r"position = 1.0: must be 0, or in \[0.001, 0.999\]"),
        (0.999999999, 0.1, None, r"position = 0.999999999: must be 0, or in \[0.001, 0.999\]"),
        (1e-9, 0.1, None, r"position = 1e-09: must be 0, or in \[0.001, 0.999\]"),
        (0.0, 0.0, None, "R = 0.0: must be >= 0.0001 p.u. at position 0"),
        (0.5, -1.0, None, "R = -1.0: must be >= 0"),
        (0.5, 0.1, 0.0, "duration = 0.0: must be > 0 s"),
    ],
)
def test_impossible_faults_change_nothing(rest, at, R, duration, message):
    plant = rest()
    before = [r.tobytes() for r in plant.plant.memory]
    with pytest.raises(ValueError, match=message):
        fault(plant.plant, at, R, duration)
    assert [r.tobytes() for r in plant.plant.memory] == before
