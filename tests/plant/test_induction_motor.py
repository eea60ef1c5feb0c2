"""The induction motor, against its flux linkages in SciPy, its equivalent circuit and a stall."""

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from gfm_plant import Network, NetworkParts, Plant, make_network, plant_command, plant_step
from gfm_plant.components import InductionMotor
from gfm_plant.model import DELTA, V_DC
from gfm_plant.names import TRIPS

OFF = {name: {"enabled": False} for name, *_ in TRIPS}
DATA: dict[str, Any] = {"node": "m", "S": 0.8, "P": 0.7, "H": 0.3, "R_r": 0.02}
C, OMEGA_B = 0.1, 100 * np.pi


def make(T_s: float = 1e-4, **more: Any) -> Network:
    parts = {
        "loads": {"z": {"node": "m", "P": 0.3, "Q": 0.1}},
        "capacitors": {"c": {"node": "m", "Q": C}},
        "induction_motors": {"g": DATA | more},
    }
    plant = Plant.model_validate({"protection": OFF, "dc_source": {"mode": "regulated"}})
    return make_network({"a": (plant, "m")}, T_s, Plant().grid, NetworkParts.model_validate(parts))


def slip_of(motor: InductionMotor, V: float) -> float:
    """At which it draws its P, by its equivalent circuit."""

    def more(s: float) -> float:
        return V**2 * (1 / motor.impedance(s)).real - motor.P

    return brentq(more, 0.0, 0.05, xtol=1e-15)


def started(plant: Network, E: float = 1.05) -> np.ndarray:
    """Put the motor at rest on 1 p.u., and a bridge at E on it; returns the commands."""
    motor = plant.wiring.fed[0][1]
    x, u = np.zeros((1, 8)), np.array([[0.0, 1.0, E, 0.0]])
    x[0, V_DC], x[0, DELTA] = 1.0, 0.0
    plant.start(x, u, [(np.array([slip_of(motor, 1.0), 1.0, 0.0]), 1.0)])
    return u


class Windings:
    """The motor by the flux linkages of stator and rotor in the frame that turns at nominal speed,
    as Krause has them; currents by the inverse of the inductances."""

    def __init__(self, motor: InductionMotor) -> None:
        self.motor = m = motor
        self.per_X = np.linalg.inv([[m.X_s + m.X_m, m.X_m], [m.X_m, m.X_r + m.X_m]])

    def slope(self, v: complex, x: np.ndarray, T_load: float, omega_0: float) -> list[complex]:
        """d/dt of (psi_s, psi_r, omega) at a voltage."""
        psi, omega, m = x[:2], x[2].real, self.motor
        i = self.per_X @ psi
        torque = (np.conj(psi[0]) * i[0]).imag
        load = T_load * (omega / omega_0) ** m.load_exponent
        return [
            OMEGA_B * (v - m.R_s * i[0] - 1j * psi[0]),
            OMEGA_B * (-m.R_r * i[1] - 1j * (1 - omega) * psi[1]),
            (torque - load) / (2 * m.H),
        ]

    def fluxes(self, i: complex, psi_r: complex) -> list[complex]:
        """(psi_s, psi_r) by the current of the stator."""
        m = self.motor
        i_r = (psi_r - m.X_m * i) / (m.X_r + m.X_m)
        return [(m.X_s + m.X_m) * i + m.X_m * i_r, psi_r]


def stepped(T_s: float, duration: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Circuit, flux and speed a time after the bridge goes on, of the plant and DOP853."""
    plant = make(T_s)
    u = started(plant)
    assert plant.wiring.order == ("a.i_f", "a.v", "a.i_o", "z", "g", "c")
    now, r, (one,) = plant.now[0], plant.par[0], plant.of(InductionMotor)
    windings, z = Windings(motor := plant.wiring.fed[0][1]), 0.3**2 + 0.1**2
    T_load, omega_0 = float(one["T_load"]), float(one["omega_0"])

    def slope(t: float, x: np.ndarray) -> np.ndarray:
        i_f, v, i_o, i_z, v_m = x[:5]
        i = (windings.per_X @ x[5:7])[0]
        out = np.zeros_like(x)
        out[0] = OMEGA_B / r["L_f"] * (u[0, 2] - v - r["R_f"] * i_f)
        out[1] = OMEGA_B / r["C_f"] * (i_f - i_o)
        out[2] = OMEGA_B / r["L_g"] * (v - v_m - r["R_g"] * i_o)
        out[3] = OMEGA_B / (0.1 / z) * (v_m - 0.3 / z * i_z)
        out[4] = OMEGA_B / C * (i_o - motor.S * i - i_z)
        out[:5] -= 1j * OMEGA_B * x[:5]
        out[5:] = windings.slope(v_m, x[5:], T_load, omega_0)
        return out

    w = now["w"][:6].copy()
    first = [*w[[0, 1, 2, 3, 5]], *windings.fluxes(-w[4] / motor.S, one["psi"]), omega_0]
    end = solve_ivp(
        slope, (0, duration), np.array(first, complex), "DOP853", rtol=1e-10, atol=1e-12
    ).y[:, -1]
    for _ in range(round(duration / T_s)):
        plant_command(plant.records, 0, u[0])
        plant_step(plant.records)
    w = now["w"][:6]
    mine = [*w[[0, 1, 2, 3, 5]], *windings.fluxes(-w[4] / motor.S, one["psi"]), one["omega"]]
    assert abs(one["omega"] - omega_0) > 1e-4  # something moves
    return np.array(mine), end


@pytest.mark.full  # compiles the plant for several converters
def test_a_start_against_its_flux_linkages_and_with_the_square_of_the_step():
    """From no current, so that line and bank ring at 1.2 kHz with the size of 1 p.u."""
    errors = [np.abs(np.subtract(*stepped(T_s))) for T_s in (1e-4, 5e-5)]
    assert errors[0].max() < 1e-4 and errors[0][6:].max() < 1e-6
    assert 3.0 < errors[0].max() / errors[1].max() < 6.0


@pytest.mark.full
def test_at_rest_it_is_its_equivalent_circuit():
    plant = make()
    u = started(plant, 1.1)
    for _ in range(40_000):
        plant_command(plant.records, 0, u[0])
        plant_step(plant.records)
    (one,), w = plant.of(InductionMotor), plant.now[0]["w"]
    motor, v = plant.wiring.fed[0][1], w[5]
    i = v / motor.impedance(1.0 - one["omega"])
    assert -w[4] / motor.S == pytest.approx(i, abs=1e-8)
    torque = (v * np.conj(i)).real - motor.R_s * abs(i) ** 2
    assert torque == pytest.approx(one["T_load"] * (one["omega"] / one["omega_0"]) ** 2, abs=1e-8)


def test_its_poles_on_a_stiff_voltage():
    """They are those of the five equations of its flux linkages, linearised by differences."""
    plant = make()
    started(plant)
    (one,), v = plant.of(InductionMotor), 1.0 + 0j
    motor = plant.wiring.fed[0][1]
    i = complex(v / motor.impedance(1.0 - float(one["omega"])))
    windings, slip = Windings(motor), 3.0  # its island is 3 rad/s ahead

    def moved(x: np.ndarray) -> np.ndarray:
        """d/dt of the parts of both fluxes, and of the speed, in the island's frame."""
        psi = np.array([*(x[:2] + 1j * x[2:4]), x[4]])
        out = np.array(windings.slope(v, psi, float(one["T_load"]), float(one["omega_0"])))
        out[:2] -= 1j * slip * psi[:2]
        return np.array([*out[:2].real, *out[:2].imag, out[2].real])

    fluxes = np.array(windings.fluxes(i, complex(one["psi"])))
    x = np.array([*fluxes.real, *fluxes.imag, float(one["omega"])])
    exact = np.stack([(moved(x + d) - moved(x - d)) / 2e-6 for d in 1e-6 * np.eye(5)], axis=1)

    part = motor.linear(one, -motor.S * i, complex(one["E"]), slip, OMEGA_B)
    (branch,) = motor.elements("g")
    own = -OMEGA_B * complex(branch.R, branch.L) / branch.L - 1j * slip
    rates = np.zeros((5, 5))  # the branch's current, and the motor's states
    rates[:2, :2] = [[own.real, -own.imag], [own.imag, own.real]]
    rates[:2, 2:] = OMEGA_B / branch.L * part.source
    rates[2:, :2], rates[2:, 2:] = part.by_seen, part.A
    found = np.sort_complex(np.linalg.eigvals(rates))
    np.testing.assert_allclose(found, np.sort_complex(np.linalg.eigvals(exact)), rtol=1e-6)


@pytest.mark.parametrize(
    ("more", "why"),
    [
        ({"P": 3.0}, "at nominal voltage it draws between -2"),
        ({"H": 1e-4}, "it moves at 2\\S* rad/s; allowed are 1000 rad/s at this T_s; raise H"),
    ],
)
def test_what_it_cannot_be(more, why):
    with pytest.raises(ValueError, match=why):
        make(**more)
