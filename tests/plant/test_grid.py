"""Every action of the grid simulator has its effect."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gfm_plant import breaker, grid_frequency, grid_impedance, grid_voltage, phase_jump
from gfm_plant.model import DELTA

LOAD = {"load_R": 72.2, "load_L": 0.05}  # 2 p.u. and 0.43512 p.u.


def load_current(plant: Any) -> complex:
    """Of the local load, in the converter's frame."""
    return plant.phasor("load")


def test_start_values(rest):
    truth = rest(grid={"omega_g": 0.99, "V_g": 0.9}, V=0.9).truth()
    assert (truth["omega_g"], truth["V_g"]) == (0.99, 0.9)
    assert truth["p"] == pytest.approx(0.5)
    assert truth["omega_u"] == 0.99


def test_frequency_step_turns_the_angle(rest):
    plant = rest()
    grid_frequency(plant.plant, 0.999)
    before = plant.truth()["delta"]
    plant.advance(10)
    # Eq. (7): delta' = omega_b (omega_u - omega_g) = 0.314 rad/s for 1 ms
    assert plant.truth()["delta"] - before == pytest.approx(100 * math.pi * 1e-3 * 1e-3)


@pytest.mark.parametrize(("goal", "sign"), [(0.998, -1), (1.002, 1)])
def test_frequency_ramp(rest, goal, sign):
    plant = rest()
    grid_frequency(plant.plant, goal, rate=0.1)
    values = []
    for _ in range(300):
        values.append(plant.truth()["omega_g"])
        plant.advance()
    assert np.diff(values[:200]) == pytest.approx(sign * 0.1 * 1e-4, rel=1e-9)
    assert values[0] == 1.0
    assert values[201:] == [goal] * 99


def test_voltage_step_ramp_and_sag(rest):
    plant = rest()
    grid_voltage(plant.plant, 0.9)
    assert plant.truth()["V_g"] == 0.9
    grid_voltage(plant.plant, 1.0, rate=10.0)
    plant.advance(50)
    assert plant.truth()["V_g"] == pytest.approx(0.95)
    plant.advance(60)
    assert plant.truth()["V_g"] == 1.0
    grid_voltage(plant.plant, 0.7, duration=0.0123)
    plant.advance(122)
    assert plant.truth()["V_g"] == 0.7
    plant.advance(1)
    assert plant.truth()["V_g"] == 1.0


def test_sag_within_a_sag_recovers_to_before_both(rest):
    plant = rest()
    grid_voltage(plant.plant, 0.8, duration=0.01)
    plant.advance(5)
    grid_voltage(plant.plant, 0.6, duration=0.001)
    plant.advance(10)
    assert plant.truth()["V_g"] == 1.0


def test_step_within_a_sag_cancels_the_recovery(rest):
    plant = rest()
    grid_voltage(plant.plant, 0.8, duration=0.001)
    grid_voltage(plant.plant, 0.95)
    plant.advance(20)
    assert plant.truth()["V_g"] == 0.95


def test_phase_jump_of_the_grid(rest):
    plant = rest()
    phase_jump(plant.plant, 10.0)
    assert plant.truth()["delta"] == pytest.approx(plant.x[DELTA] - math.radians(10))
    plant.advance(5)
    assert plant.truth()["p"] < 0.5  # a leading grid takes less power


def test_a_full_turn_changes_nothing(rest):
    plant = rest()
    phase_jump(plant.plant, 360.0)
    plant.advance(100)
    assert plant.truth()["p"] == pytest.approx(0.5, abs=1e-9)


def test_impedance_change_is_a_factor_on_the_nominal_line(rest):
    plant = rest(factors={"L_g": 2.0})
    current = plant.st["x"][0, 4:6].copy()
    grid_impedance(plant.plant, 5.0, 3.0)
    assert plant.par[0]["L_g"] == pytest.approx(5 * 0.0174049446)
    assert plant.par[0]["R_g"] == pytest.approx(3 * 0.06 / 36.1)
    assert plant.st["x"][0, 4:6] == pytest.approx(current, abs=1e-15)
    strong = rest(factors={"L_g": 5.0, "R_g": 3.0})
    assert strong.par[0]["L_g"] == plant.par[0]["L_g"]


def test_breaker_conserves_flux(rest):
    plant = rest(grid=LOAD)
    L_g, L_load = plant.par[0]["L_g"], plant.plant.wiring.branches[0].L
    assert L_load == pytest.approx(0.4351236)
    i_o, i_load = complex(*plant.st["x"][0, 4:6]), load_current(plant)
    assert abs(i_load) == pytest.approx(1 / math.hypot(2.0, 0.4351236))
    breaker(plant.plant, closed=False, clearing="instant")
    current = (L_g * i_o + L_load * i_load) / (L_g + L_load)
    assert complex(*plant.st["x"][0, 4:6]) == pytest.approx(current)
    breaker(plant.plant, closed=True)
    assert complex(*plant.st["x"][0, 4:6]) == pytest.approx(current)
    assert load_current(plant) == pytest.approx(current)
    assert plant.par[0]["L_g"] == L_g


def test_local_load_rests_while_the_breaker_is_closed(rest):
    plant = rest(grid=LOAD)
    before = load_current(plant)
    plant.advance(1000)
    assert load_current(plant) == pytest.approx(before, abs=1e-10)
    assert plant.truth()["p"] == pytest.approx(0.5, abs=1e-9)


def test_local_load_follows_the_grid(rest):
    """Against SciPy: L_load di/dt = omega_b (v_g - R_load i) - j omega_b omega_u L_load i."""
    plant = rest(grid=LOAD)
    (load,) = plant.plant.wiring.branches
    start = load_current(plant)
    grid_voltage(plant.plant, 0.5)
    plant.advance(100)
    w, v_g = 100 * math.pi, 0.5 * np.exp(-1j * plant.x[DELTA])

    def slope(_: float, i: Any) -> Any:
        return w / load.L * (v_g - load.R * i) - 1j * w * i

    exact = solve_ivp(slope, (0, 0.01), [start], "DOP853", rtol=1e-12, atol=1e-13).y[0, -1]
    assert load_current(plant) == pytest.approx(exact, abs=1e-10)


def test_island_runs_at_the_converters_frequency(rest):
    """Its waveform in a fixed frame rotates at omega_u, independent of the disconnected grid."""
    plant = rest(dc_source={"mode": "regulated"}, grid=LOAD)
    breaker(plant.plant, closed=False)
    grid_frequency(plant.plant, 0.9)
    u = plant.near(omega_u=0.02)
    plant.advance(10_000, u)  # 1 s: transients have decayed
    x = plant.st["x"][0]
    settled = x.copy()
    plant.advance(100, u)
    assert x[:6] == pytest.approx(settled[:6], abs=1e-8)  # constant in the frame of omega_u
    assert plant.truth()["omega_u"] == pytest.approx(1.02)
    # and the current is the load's at that frequency
    v, i_o = complex(x[2], x[3]), complex(x[4], x[5])
    Z = complex(2.0 + 0.06 / 36.1, 1.02 * (0.4351236 + 0.0174049446))
    assert i_o == pytest.approx(v / Z, abs=1e-7)
    assert plant.truth()["trip"] == 0


def test_impedance_change_of_an_island(rest):
    plant = rest(grid=LOAD)
    breaker(plant.plant, closed=False)
    grid_impedance(plant.plant, 2.0, 1.0)
    plant.advance(10_000)  # transients have decayed: line and load are in series
    x = plant.st["x"][0]
    Z = complex(2.0 + 0.06 / 36.1, 0.4351236 + 2 * 0.0174049446)
    assert complex(*x[4:6]) == pytest.approx(complex(*x[2:4]) / Z, abs=1e-7)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (lambda p: grid_frequency(p.plant, 0.0), "omega_g = 0.0: must be > 0"),
        (lambda p: grid_frequency(p.plant, 1.0, rate=-1.0), "rate = -1.0: must be > 0"),
        (lambda p: grid_voltage(p.plant, -0.1), "V_g = -0.1: must be >= 0"),
        (lambda p: grid_voltage(p.plant, 0.5, duration=0.0), "duration = 0.0: must be > 0"),
        (lambda p: grid_voltage(p.plant, 0.5, 1.0, 1.0), "rate = 1.0, duration = 1.0: give one"),
        (lambda p: phase_jump(p.plant, math.inf), "degrees = inf: must be finite"),
        (lambda p: grid_impedance(p.plant, 0.0, 1.0), "L_g = 0.0: must be a factor > 0"),
        (lambda p: grid_impedance(p.plant, 1e-9, 0.0), "fastest mode"),
        (lambda p: breaker(p.plant, closed=False), "load_R, plant.grid.load_L: not set"),
    ],
)
def test_impossible_actions_change_nothing(rest, action, message):
    plant = rest()
    before = [r.tobytes() for r in plant.plant.memory]
    with pytest.raises(ValueError, match=message):
        action(plant)
    assert [r.tobytes() for r in plant.plant.memory] == before
