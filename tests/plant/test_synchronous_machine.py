"""The synchronous machine of order 6, against its windings in SciPy and a short circuit."""

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.signal import tf2ss

from gfm_plant import Network, NetworkParts, Plant, make_network, plant_command, plant_step
from gfm_plant.components import SynchronousMachine
from gfm_plant.components.synchronous_machine import AVR
from gfm_plant.grid import fault, line_breaker
from gfm_plant.model import DELTA, V_DC
from gfm_plant.names import TRIPS
from gfm_plant.steady_state import NoEquilibrium

OFF = {name: {"enabled": False} for name, *_ in TRIPS}
DATA = {"node": "m", "S": 2.0, "H": 0.8, "P": 0.4, "V": 1.01, "D": 0.5, "R": 0.004}
SEXS = {"K": 20.0, "T_A": 0.4, "T_B": 1.5}
# every control by its standard names; the exciter saturates at this rest
CONTROLLED: dict[str, Any] = {
    "avr": {"type": "IEEET1", "E_1": 1.0, "S_E1": 0.04, "E_2": 2.0, "S_E2": 0.33},
    "governor": {"R": 0.04, "T1": 0.2, "T2": 0.6, "T3": 2.0, "D_t": 0.1},
    "pss": {"T6": 0.01, "A1": 0.02, "A2": 2e-4},
}
SALIENT = {"X_q": 1.1, "X_q1": 1.1, "saturates_by": "E_q1", "S_10": 0.1, "S_12": 0.4, "T_gov": 0.2}
COMPOUND = {"avr": {"type": "ESST3A", "K_C": 0.2}, "T_gov": 0.2, "S_10": 0.1, "S_12": 0.4}
GAS: dict[str, Any] = {
    "avr": {"type": "ESST4B", "K_C": 0.2, "V_Rmax": 3.0},
    "governor": {"type": "GGOV1", "T_rate": 0.9, "T_pelec": 0.1, "D_m": 0.1, "R_open": 1.0},
}
SATURATED = {"S_10": 0.1, "S_12": 0.4, "avr": SEXS, "T_gov": 0.2}


def make(T_s: float = 1e-4, **more: Any) -> Network:
    parts = {
        "loads": {"z": {"node": "m", "P": 0.9, "Q": 0.3}},
        "capacitors": {"c": {"node": "m", "Q": 0.06}},
        "synchronous_machines": {"g": DATA | more},
    }
    plant = Plant.model_validate({"protection": OFF, "dc_source": {"mode": "regulated"}})
    return make_network({"a": (plant, "m")}, T_s, Plant().grid, NetworkParts.model_validate(parts))


def rest(plant: Network, i: complex) -> np.ndarray:
    """Put it where the machine gives i, p.u. of its rating, at nominal speed and 1.01 p.u.; returns
    the commands."""
    r, v_m = plant.par[0], 1.01 + 0j
    z = 0.9**2 + 0.3**2
    i_o = (0.9 / z + 0.3j / z) ** -1 * v_m + 0.06j * v_m - DATA["S"] * i
    v = v_m + complex(r["R_g"], r["L_g"]) * i_o
    i_f = i_o + 1j * r["C_f"] * v
    e = v + complex(r["R_f"], r["L_f"]) * i_f
    delta = np.angle(e)
    own = np.array([i_f, v, i_o]) * np.exp(-1j * delta)
    x, u = np.zeros((1, 8)), np.array([[0.0, 1.0, abs(e), 0.0]])
    x[0, 0:6:2], x[0, 1:6:2], x[0, DELTA], x[0, V_DC] = own.real, own.imag, delta, 1.0
    u[0, 0] = u[0, 2] * own[0].real
    plant.start(x, u, [(np.array([i.real, i.imag, v_m.real, v_m.imag]), 1.0)])
    return u


class Windings:
    """The machine by the flux linkages of its stator, field and three dampers: Park's equations,
    with resistances and inductances from reactances and time constants (Sauer and Pai, chapter 3).
    With salient poles the third damper has no mutual inductance and no current.
    """

    def __init__(self, one: SynchronousMachine, omega_b: float) -> None:
        self.one, self.omega_b = one, omega_b
        self.salient = one.saturates_by == "E_q1"
        # of the saturation in the q axis
        self.share = 0.0 if self.salient else (one.X_q - one.X_l) / (one.X_d - one.X_l)

        def axis(X: float, X_1: float, T_1: float, T_2: float) -> tuple[np.ndarray, list[float]]:
            m, first = X - one.X_l, X_1 - one.X_l
            slow = 1 / (1 / first - 1 / m)
            fast = 1 / (1 / (one.X_2 - one.X_l) - 1 / first)
            L = np.array([[-X, m, m], [-m, m + slow, m], [-m, m, m + fast]])
            return L, [(m + slow) / (omega_b * T_1), (fast + first) / (omega_b * T_2)]

        self.L_d, (self.R_fd, self.R_kd) = axis(one.X_d, one.X_d1, one.T_d10, one.T_d20)
        if self.salient:
            m = one.X_q - one.X_l
            own = m + 1 / (1 / (one.X_2 - one.X_l) - 1 / m)
            self.L_q = np.array([[-one.X_q, m, 0.0], [-m, own, 0.0], [0.0, 0.0, 1.0]])
            self.R_kq = [own / (omega_b * one.T_q20), 0.0]
        else:
            self.L_q, self.R_kq = axis(one.X_q, one.X_q1, one.T_q10, one.T_q20)

    def start(self, i: complex, v: complex) -> tuple[np.ndarray, float, float]:
        """Fluxes (psi_d, psi_fd, psi_kd, psi_q, psi_kq1, psi_kq2), angle of the d axis, E_fd."""
        one, L_ad = self.one, self.one.X_d - self.one.X_l
        S = self.saturation(v + complex(one.R, one.X_2) * i)
        X_q = one.X_2 + (one.X_q - one.X_2) / (1.0 + S * self.share)
        angle = np.angle(v + complex(one.R, X_q) * i) - np.pi / 2
        own = i * np.exp(-1j * angle)
        v_q = (v * np.exp(-1j * angle)).imag
        E_I = v_q + one.R * own.imag + one.X_d * own.real  # L_ad times the field's current
        iron = v_q + one.R * own.imag + one.X_2 * own.real
        if self.salient:
            iron = E_I - (one.X_d - one.X_d1) * own.real
            S = self.saturation(iron)
        E_fd = E_I + S * iron
        i_1 = (one.X_q - X_q) * own.imag / (one.X_q - one.X_l)
        d, q = self.L_d @ [own.real, E_I / L_ad, 0.0], self.L_q @ [own.imag, i_1, 0.0]
        return np.concatenate([d, q]), float(angle), float(E_fd)

    def saturation(self, psi: complex) -> float:
        """S of the flux behind X'', by the parabola through S_10 and S_12."""
        one = self.one
        if one.S_12 == 0.0:
            return 0.0
        rise = (np.sqrt(1.2 * one.S_12) - np.sqrt(one.S_10)) / 0.2
        above = max(abs(psi) - 1.0 + np.sqrt(one.S_10) / rise, 0.0)
        return float((rise * above) ** 2 / abs(psi))

    def seen(self, psi: np.ndarray, omega: float) -> tuple[complex, complex, float]:
        """Phasors of voltage and current, and X_ad I_fd with what the iron takes."""
        i, L_ad = self.current(psi), self.one.X_d - self.one.X_l
        psi_2 = complex(psi[0], psi[3]) + self.one.X_2 * i
        field = L_ad * np.linalg.solve(self.L_d, psi[:3])[1] + self.saturation(psi_2) * psi_2.real
        return 1j * omega * psi_2 - complex(self.one.R, omega * self.one.X_2) * i, i, float(field)

    def current(self, psi: np.ndarray) -> complex:
        return complex(np.linalg.solve(self.L_d, psi[:3])[0], np.linalg.solve(self.L_q, psi[3:])[0])

    def slope(self, psi: np.ndarray, v: complex, omega: float, E_fd: float) -> np.ndarray:
        """d/dt of the fluxes, at a voltage v in the rotor's frame."""
        i_d, i_fd, i_kd = np.linalg.solve(self.L_d, psi[:3])
        i_q, i_1, i_2 = np.linalg.solve(self.L_q, psi[3:])
        psi_2 = complex(psi[0] + self.one.X_2 * i_d, psi[3] + self.one.X_2 * i_q)
        if self.salient:  # E_q', by the flux of the field
            psi_2 = complex(psi[1] * self.L_d[0, 1] / self.L_d[1, 1], 0.0)
        S = self.saturation(psi_2)
        L_ad, L_aq = self.one.X_d - self.one.X_l, self.one.X_q - self.one.X_l
        v_fd = self.R_fd * (E_fd - S * psi_2.real) / L_ad
        v_1 = -self.R_kq[0] * S * self.share * psi_2.imag / L_aq
        return self.omega_b * np.array([
            v.real + self.one.R * i_d + omega * psi[3], v_fd - self.R_fd * i_fd, -self.R_kd * i_kd,
            v.imag + self.one.R * i_q - omega * psi[0], v_1 - self.R_kq[0] * i_1,
            -self.R_kq[1] * i_2,
        ])  # fmt: skip


class Simple:
    """SEXS, or a constant excitation, and the governor of one lag: states P, V_m, x, E_fd."""

    def __init__(self, one: SynchronousMachine, E_fd: float, P: float) -> None:
        self.avr, self.P = one.avr, P
        ahead = E_fd / self.avr.K if self.avr else 0.0
        self.V_set, self.start = 1.01 + ahead, [P, 1.01, ahead, E_fd]

    def given(self, c: np.ndarray, w: float, seen: Any) -> tuple[float, float, float]:
        """V_m, E_fd and the torque of the turbine."""
        return c[1], c[3], c[0]

    def slope(self, c: np.ndarray, V: float, w: float, seen: Any) -> list[float]:
        P, V_m, x, E_fd = c
        if not (avr := self.avr):
            return [(self.P - w / 0.05 - P) / 0.2, 0.0, 0.0, 0.0]
        off = self.V_set - V_m
        return [
            (self.P - w / 0.05 - P) / 0.2, (V - V_m) / avr.T_R, (off - x) / avr.T_B,
            (avr.K * (x + avr.T_A / avr.T_B * (off - x)) - E_fd) / avr.T_E,
        ]  # fmt: skip


class Compound:
    """ESST3A within its limits, its rectifier under a light load, and the governor of one lag:
    states P, V_m, y, V_M."""

    def __init__(self, one: SynchronousMachine, E_fd: float, P: float) -> None:
        self.P, self.E_fd, self.start = P, E_fd, [P, 1.01, 0.0, 0.0]

    def rest(self, seen: tuple[complex, complex, float]) -> None:
        V_M = self.E_fd / self.V_B(seen)
        ahead = (V_M / 8.0 + self.E_fd) / 20.0
        self.V_set, self.start = 1.01 + ahead, [self.P, 1.01, ahead, V_M]

    def V_B(self, seen: tuple[complex, complex, float]) -> float:
        v, i, I_fd = seen
        K_P = 3.67 * np.exp(1j * np.radians(3.33))
        V_E = abs(K_P * v + 1j * (0.435 + 0.0098 * K_P) * i)
        return float(V_E - 0.577 * 0.2 * I_fd)

    def excitation(self, x: np.ndarray, seen: tuple[complex, complex, float]) -> float:
        """E_fd by the states of the plant's own control."""
        return float(x[3] * self.V_B(seen))

    def given(self, c: np.ndarray, w: float, seen: Any) -> tuple[float, float, float]:
        return c[1], c[3] * self.V_B(seen), c[0]

    def slope(self, c: np.ndarray, V: float, w: float, seen: Any) -> list[float]:
        P, V_m, y, V_M = c
        off, E_fd = self.V_set - V_m, V_M * self.V_B(seen)
        V_R = 20.0 * (y + 1.0 / 5.0 * (off - y))
        return [
            (self.P - w / 0.05 - P) / 0.2, (V - V_m) / 0.02, (off - y) / 5.0,
            (8.0 * (V_R - E_fd) - V_M) / 0.4,
        ]  # fmt: skip


class Gas(Compound):
    """GAS within its limits: states of ESST4B, and of GGOV1 without its derivative. The load
    limiter does not act."""

    def rest(self, seen: tuple[complex, complex, float]) -> None:
        v, i, _ = seen
        P_e, V_R, V_M = (v * i.conjugate()).real / 0.9, 0.1 * self.E_fd, self.E_fd / self.V_B(seen)
        burns = self.P / 0.9 / 1.5 + 0.2
        self.asked = P_e
        self.start = [1.01, V_R, V_R, V_M, P_e, *[burns] * 2, self.P / 0.9]

    def excitation(self, x: np.ndarray, seen: tuple[complex, complex, float]) -> float:
        V_B = self.V_B(seen)
        return float(V_B * (x[2] + x[3]) / (1.0 + 0.1 * V_B))

    def given(self, c: np.ndarray, w: float, seen: Any) -> tuple[float, float, float]:
        return c[0], self.excitation(c, seen), 0.9 * (c[7] - 0.1 * w)

    def slope(self, c: np.ndarray, V: float, w: float, seen: Any) -> list[float]:
        V_m, x_R, V_A, _, P, x_I, v, y = c
        off, u = 1.01 - V_m, V_A - 0.1 * self.given(c, w, seen)[1]
        e = 0.04 * (self.asked - P) - w
        f = 10.0 * e + x_I
        assert -0.05 < f - v < 0.5  # the rates of the valve do not act
        return [
            (V - V_m) / 0.02, 2.97 * off, (2.97 * off + x_R - V_A) / 0.01, 0.2 * u,
            ((seen[0] * seen[1].conjugate()).real / 0.9 - P) / 0.1, 2.0 * e, (f - v) / 0.5,
            (1.5 * (v * (1.0 + w) - 0.2) - y) / 0.1,
        ]  # fmt: skip


class Standard:
    """CONTROLLED, the stabiliser as one transfer function: states of IEEET1, TGOV1 and that."""

    def __init__(self, one: SynchronousMachine, E_fd: float, P: float) -> None:
        # the parabola b (E - a)^2 that passes both points
        first, second = np.sqrt(1.0 * 0.04), np.sqrt(2.0 * 0.33)
        self.b, self.a = (second - first) ** 2, 1.0 - first / (second - first)
        num, den = [20.0 * 10.0, 0.0], [10.0, 1.0]
        for lead, lag in (([0.05, 1], [0.02, 1]), ([3.0, 1], [5.4, 1]), ([1], [0.01, 1]),
                          ([1], [2e-4, 0.02, 1])):  # fmt: skip
            num, den = np.polymul(num, lead), np.polymul(den, lag)
        self.pss = tf2ss(num, den)
        V_R = E_fd + self.b * (E_fd - self.a) ** 2
        self.V_set, self.P = 1.01 + V_R / 20.0, P
        self.start = [1.01, V_R, E_fd, E_fd, P, P, *np.zeros(len(den) - 1)]

    def given(self, c: np.ndarray, w: float, seen: Any) -> tuple[float, float, float]:
        return c[0], c[2], c[5] + 0.6 / 2.0 * (c[4] - c[5]) - 0.1 * w

    def slope(self, c: np.ndarray, V: float, w: float, seen: Any) -> list[float]:
        V_m, V_R, E_fd, behind, valve, P = c[:6]
        A, B, C, D = self.pss
        V_s = float((C @ c[6:] + D[:, 0] * w)[0])
        assert abs(V_s) < 0.2  # its limits do not act
        back = (E_fd - behind) / 0.35
        return [
            (V - V_m) / 0.02, (20.0 * (self.V_set + V_s - V_m - 0.063 * back) - V_R) / 0.2,
            (V_R - E_fd - self.b * (E_fd - self.a) ** 2) / 0.314, back,
            (self.P - w / 0.04 - valve) / 0.2, (valve - P) / 2.0, *(A @ c[6:] + B[:, 0] * w),
        ]  # fmt: skip


def stepped(**more: Any) -> dict[tuple[float, float], np.ndarray]:
    """How far the plant is from DOP853, by its step and the time in s since a step of the
    converter's voltage and speed: currents and voltages, speed, power of the turbine, measured
    voltage and excitation."""
    plant, i_0 = make(**more), 0.4 - 0.15j
    u = rest(plant, i_0)
    assert plant.wiring.order == ("a.i_f", "a.v", "a.i_o", "z", "g", "c")
    (one,) = plant.of(SynchronousMachine)
    now, r, w_b, z = plant.now[0], plant.par[0], plant.wiring.omega_b, 0.9**2 + 0.3**2
    s_0, delta, machine = (
        now["w"][:6].copy(),
        float(plant.st["x"][0, DELTA]),
        plant.wiring.fed[0][1],
    )
    assert abs(s_0[4] - 2.0 * i_0) < 1e-12
    windings = Windings(machine, w_b)
    psi_0, angle_0, E_fd_0 = windings.start(i_0, 1.01)
    P_0 = float((np.conj(i_0) * (1.01 + 0.004 * i_0)).real)
    controls: Any
    if machine.avr is not None and machine.avr.kind() in ("ESST3A", "ESST4B"):
        controls = (Gas if "governor" in more else Compound)(machine, E_fd_0, P_0)
        controls.rest(windings.seen(psi_0, 1.0))
    else:
        controls = (Standard if "governor" in more else Simple)(machine, E_fd_0, P_0)
    u[0, 2] += 0.05
    u[0, 1] += 1e-3

    def slope(t: float, s: np.ndarray) -> np.ndarray:
        i_f, v, i_o, i_z, v_m = s[:5]
        psi = s[5:11].real
        angle, omega = s[11:13].real
        seen = windings.seen(psi, omega)
        _, E_fd, P = controls.given(s[13:].real, omega - 1, seen)
        turn = np.exp(1j * angle)
        e = u[0, 2] * np.exp(1j * (delta + w_b * (u[0, 1] - 1) * t))
        i = windings.current(psi)
        out = np.zeros_like(s)
        out[0] = w_b / r["L_f"] * (e - v - r["R_f"] * i_f)
        out[1] = w_b / r["C_f"] * (i_f - i_o)
        out[2] = w_b / r["L_g"] * (v - v_m - r["R_g"] * i_o)
        out[3] = w_b / (0.3 / z) * (v_m - 0.9 / z * i_z)
        out[4] = w_b / 0.06 * (i_o + 2.0 * i * turn - i_z)
        out[:5] -= 1j * w_b * s[:5]
        out[5:11] = windings.slope(psi, v_m / turn, omega, E_fd)
        torque = psi[0] * i.imag - psi[3] * i.real
        out[11] = w_b * (omega - 1)
        out[12] = (P - torque - 0.5 * (omega - 1)) / (2 * 0.8)
        out[13:] = controls.slope(s[13:].real, abs(v_m), omega - 1, seen)
        return out

    start = np.concatenate([s_0[[0, 1, 2, 3, 5]], psi_0, [angle_0, 1.0], controls.start])
    times = (0.1, 0.3)
    ends = solve_ivp(slope, (0, 0.3), start, "DOP853", times, rtol=1e-9, atol=1e-11).y.T
    errors = {}
    for T_s in (1e-4, 2e-4):
        plant = make(T_s, **more)
        rest(plant, i_0)
        now, (one,) = plant.now[0], plant.of(SynchronousMachine)
        for before, time, end in zip((0.0, *times), times, ends, strict=False):
            for _ in range(round((time - before) / T_s)):
                plant_command(plant.records, 0, u[0])
                plant_step(plant.records)
            i = 2.0 * windings.current(end[5:11].real) * np.exp(1j * end[11])
            seen = windings.seen(end[5:11].real, end[12].real)
            V_m, E_fd, P = controls.given(end[13:].real, end[12].real - 1, seen)
            exact = [*end[:4], i, end[4], end[12], P, V_m, E_fd]
            assert abs(end[12] - 1) > 1e-5  # it swings
            assert machine.avr is None or abs(E_fd - E_fd_0) > 1e-3  # and the regulator acts
            assert now["omega_g"] == one["omega"]  # there is no other grid
            turbine = one["P_turbine"] if machine.governor is None else one["turbine"]
            regulator = one["x"][[AVR, AVR + 2]] if machine.avr else [1.01, E_fd_0]
            if isinstance(controls, Compound):  # its E_fd is by the source, which is no state
                regulator = [one["x"][AVR], controls.excitation(one["x"][AVR:], seen)]
            mine = [*now["w"][:6], one["omega"], turbine, *regulator]
            errors[T_s, time] = np.abs(np.subtract(mine, exact))
    return errors


@pytest.mark.full  # compiles the plant for several converters
@pytest.mark.parametrize(
    ("machine", "within"),
    [
        ({"T_gov": 0.2}, 2e-5),
        ({"T_gov": 0.2, "avr": SEXS}, 2e-5),
        (CONTROLLED, 2e-5),
        (SATURATED, 2e-5),
        (COMPOUND, 2e-5),
        (GAS, 2e-5),
        (SALIENT, 5e-5),  # its q axis has one damper, whose flux moves faster
    ],
)
def test_a_step_against_the_windings(machine, within):
    """And the error falls with the square of the step."""
    errors = stepped(**machine)
    error = errors[1e-4, 0.3]
    assert error[:6].max() < within  # currents and voltages
    assert error[6:9].max() < 5e-8 and error[9] < 1e-6
    assert 3.0 < errors[2e-4, 0.1].max() / errors[1e-4, 0.1].max() < 6.0


@pytest.mark.full
def test_a_bolted_short_circuit():
    """The current of an unloaded machine without its DC offset, whose rotor's fluxes decay while
    that of the stator is zero; and the formula of the books, 1/X_d + (1/X_d' - 1/X_d) e^(-t/T_d')
    + (1/X'' - 1/X_d') e^(-t/T_d'') with T_d' = T_d0' X_d'/X_d and T_d'' = T_d0'' X''/X_d', which
    holds for T_d'' << T_d'."""
    plant = make(H=1e4, P=0.0, R=0.0)
    u = rest(plant, 0j)
    fault(plant, None, 1e-4, node="m")
    now, (one,) = plant.now[0], plant.of(SynchronousMachine)
    g, source = plant.wiring.order.index("g"), int(one["source"])
    own = []
    for _ in range(10_000):
        plant_command(plant.records, 0, u[0])
        plant_step(plant.records)
        own.append(now["w"][g] / now["unit"][source] / DATA["S"])
    means = np.abs(np.mean(np.reshape(own, (-1, 200)), axis=1))  # of a cycle each
    t = (np.arange(len(means)) + 0.5) * 0.02
    m: Any = plant.wiring.fed[0][1]
    windings = Windings(m, plant.wiring.omega_b)
    psi, _, E_fd = windings.start(0j, 1.01)
    by_psi, R = np.linalg.inv(windings.L_d), np.diag([windings.R_fd, windings.R_kd])
    A = -windings.omega_b * R @ by_psi[1:, 1:]
    end = -np.linalg.solve(A, [windings.omega_b * windings.R_fd * E_fd / (m.X_d - m.X_l), 0.0])
    left = np.array([end + expm(A * at) @ (psi[1:3] - end) for at in t])
    assert np.abs(means / (left @ by_psi[0, 1:]) - 1)[1:].max() < 2e-3
    T_1, T_2 = m.T_d10 * m.X_d1 / m.X_d, m.T_d20 * m.X_2 / m.X_d1
    steps = 1 / m.X_d, 1 / m.X_d1 - 1 / m.X_d, 1 / m.X_2 - 1 / m.X_d1
    book = 1.01 * (steps[0] + steps[1] * np.exp(-t / T_1) + steps[2] * np.exp(-t / T_2))
    assert np.abs(means / book - 1).max() < 0.02


@pytest.mark.full
def test_a_machine_that_is_lost_runs_up_by_itself():
    plant = make(avr=SEXS)
    u = rest(plant, 0.4 + 0j)
    line_breaker(plant, "g", closed=False, clearing="instant")
    (one,) = plant.of(SynchronousMachine)
    P, E_fd = float(one["P_turbine"]), float(one["x"][AVR + 2])
    for _ in range(200):
        plant_command(plant.records, 0, u[0])
        plant_step(plant.records)
    assert plant.now[0]["w"][plant.wiring.order.index("g")] == 0.0
    assert one["omega"] - 1 == pytest.approx(P * 0.02 / (2 * 0.8), rel=0.1)
    assert (
        one["x"][AVR + 2] < E_fd
    )  # without load its voltage rises, and the regulator takes it back


def test_a_rest_that_the_regulator_cannot_hold():
    plant = make(avr=SEXS | {"E_max": 1.2})
    with pytest.raises(
        NoEquilibrium, match=r"its avr, SEXS, needs E_fd = .*; its limits are 0 and 1.2"
    ):
        rest(plant, 0.4 - 0.15j)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"X_2": 0.4}, r"X_d1 = 0.3: must be above that before it in X_l <= X_2 <= X_d1 <= X_d"),
        ({"X_l": 0.26}, r"X_2 = 0.25: must be above"),
        ({"avr": {"E_min": 6.0}}, r"E_min = 6: must be less than E_max, 5"),
        # the parabola through these would begin below a flux of 0
        ({"S_10": 0.2, "S_12": 0.2}, r"S_10 = 0.2: must be less than S_12 / 1.2 = 0.166667"),
        ({"S_10": 0.1}, r"S_10 = 0.1: must be less than S_12 / 1.2 = 0 \(S_12 = 0\)"),
    ],
)
def test_data_of_no_machine(more, message):
    with pytest.raises(ValidationError, match=message):
        SynchronousMachine.model_validate(DATA | more)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"T_d20": 5e-4}, r"network.synchronous_machines.g: T_d20 = 0.0005: must be >= 0.001 s"),
        ({"avr": {"T_R": 5e-4}}, r"synchronous_machines.g: avr.T_R = 0.0005: must be >="),
        ({"governor": {"T3": 5e-4}}, r"machines.g: governor.T3 = 0.0005: must be >= 0.001 s"),
        ({"avr": {}, "pss": {"T2": 5e-4}}, r"machines.g: pss.T2 = 0.0005: must be >="),
        ({"H": 1e-4}, r"synchronous_machines.g: it swings at .* rad/s; allowed are"),
    ],
)
def test_too_fast_for_the_step(more, message):
    with pytest.raises(ValueError, match=message):
        make(**more)
