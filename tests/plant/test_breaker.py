"""Breakers whose poles open one by one, against the equations of three phases."""

import cmath
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from gfm_plant import NetworkParts, Plant, breaker, fault, make_network, plant_command, plant_step
from gfm_plant.grid import line_breaker
from gfm_plant.model import DELTA, V_DC

from .test_unbalanced_fault import NO_TRIP, STIFF, WEAK, W, phases, vector

LOAD = {**WEAK, "load_R": 72.2, "load_L": 0.05}  # ohm, H
END = 0.03
ZERO_SUM = np.eye(3) - 1 / 3  # three wires: what is common to all phases has no path


class Poles:
    """Three phases on both sides of a breaker.

    Attributes:
        conducting: the phases whose poles still do.
        alone: whether one pole can conduct without the others, by a zero sequence.
    """

    alone = False

    def __init__(self, par: Any, E: float, unit: complex) -> None:
        self.par, self.E, self.unit, self.conducting = par, E, unit, [0, 1, 2]

    def filter(self, t: float, i_f: Any, v: Any, i_o: Any) -> tuple[Any, Any]:
        r, e = self.par, phases(self.E * self.unit * cmath.exp(1j * W * t))
        return (e - v - r["R_f"] * i_f) / r["L_f"], (i_f - i_o) / r["C_f"]

    def run(self, s: NDArray[np.float64]) -> tuple[NDArray[np.complex128], list[float]]:
        """The space vectors at ``END`` in the common frame, and when poles opened."""
        tight = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13}
        t, times = 0.0, []
        while self.conducting:
            events = [lambda t, s, k=k: self.current(s)[k] for k in self.conducting]
            for event in events:
                event.terminal = True
            part = solve_ivp(self.slope, (t, END), s, events=events, **tight)
            first = next(k for k, at in enumerate(part.t_events) if len(at))
            t, s = part.t[-1], part.y[:, -1]
            times.append(t)
            del self.conducting[first]
            if len(self.conducting) == 1 and not self.alone:
                self.conducting = []
        s = solve_ivp(self.slope, (t, END), s, **tight).y[:, -1]
        return np.array([vector(x) for x in s.reshape(-1, 3)]) * cmath.exp(-1j * W * END), times


class GridBreaker(Poles):
    """Between the grid and a line with a local load at its end: i_f, v, i_o, and the load's i."""

    def current(self, s: Any) -> Any:
        return s[9:12] - s[6:9]

    def slope(self, t: float, s: Any) -> Any:
        i_f, v, i_o, i = s.reshape(4, 3)
        r, v_g = self.par, phases(cmath.exp(1j * W * t))
        R, L = self.load.R, self.load.L
        arrives, drawn = (v - r["R_g"] * i_o) / r["L_g"], -R * i / L  # d/dt without the node
        rows, right = np.eye(3), v_g.copy()
        for k in set(range(3)) - set(self.conducting):  # what arrives goes on as the load's current
            rows[k] = ZERO_SUM[k] * (1 / r["L_g"] + 1 / L)
            right[k] = (ZERO_SUM @ arrives - drawn)[k]
        u = np.linalg.lstsq(rows, right, rcond=None)[0]
        rates = *self.filter(t, i_f, v, i_o), ZERO_SUM @ (arrives - u / r["L_g"]), ZERO_SUM @ u / L
        return r["omega_b"] * np.concatenate([*rates[:3], rates[3] + drawn])


def test_the_poles_of_the_grid_s_breaker_open_where_their_currents_pass_zero(rest):
    plant = rest(P=0.3, grid=LOAD, protection=NO_TRIP, dc_source=STIFF)
    order = plant.plant.wiring.order
    s = np.concatenate([phases(x) for x in plant.now["w"][0, : len(order)]])
    breaker(plant.plant, closed=False)
    model = GridBreaker(plant.par[0], plant.u[2], complex(plant.now["unit"][0, 0]))
    model.load = plant.plant.wiring.branches[0]
    exact, times = model.run(s)
    assert len(times) == 2 and times[1] - times[0] == pytest.approx(5e-3, abs=1e-3)
    at = {"contact": [], "clearing": []}
    for _ in range(round(END / 1e-4)):
        for name, seen in at.items():
            seen.append(int(plant.now[name][0]))
        plant.advance()
    assert at["clearing"].count(1) == math.ceil(times[1] / 1e-4)
    assert sorted(set(at["contact"])) == [0, 1, max(at["contact"])]
    assert plant.now["w"][0, : len(order)] == pytest.approx(exact, abs=1e-8)


class OneOfTwoLines(Poles):
    """The breaker of one of two lines to the grid: i_f, v, i_o, and both lines' currents. A zero
    sequence circulates through both lines."""

    alone = True
    L, R = np.array([0.2, 0.1]), np.array([0.03, 0.01])

    def current(self, s: Any) -> Any:
        return s[9:12]

    def slope(self, t: float, s: Any) -> Any:
        i_f, v, i_o, i_1, i_2 = s.reshape(5, 3)
        r, v_g = self.par, phases(cmath.exp(1j * W * t))
        (L_1, L_2), (R_1, R_2) = self.L, self.R
        conducts = np.isin(range(3), self.conducting)
        # d/dt of i_o = i_1 + i_2 gives the voltages u of the node
        rows = ZERO_SUM / r["L_g"] + np.diag(conducts / L_1 + 1 / L_2)
        right = ZERO_SUM @ (v - r["R_g"] * i_o) / r["L_g"]
        right += conducts * (v_g + R_1 * i_1) / L_1 + (v_g + R_2 * i_2) / L_2
        u = np.linalg.solve(rows, right)
        rates = (
            *self.filter(t, i_f, v, i_o),
            ZERO_SUM @ (v - u - r["R_g"] * i_o) / r["L_g"],
            conducts * (u - v_g - R_1 * i_1) / L_1,
            (u - v_g - R_2 * i_2) / L_2,
        )
        return r["omega_b"] * np.concatenate(rates)


def test_a_zero_sequence_keeps_the_last_pole_of_a_line_conducting():
    one = OneOfTwoLines
    options = Plant.model_validate({"protection": NO_TRIP, "dc_source": STIFF})
    lines = {
        name: {"start": "bus", "end": "far", "L": one.L[k], "R": one.R[k]}
        for k, name in enumerate(("first", "second"))
    }
    parts = NetworkParts.model_validate({"grid": "far", "lines": lines})
    plant = make_network({"a": (options, "bus")}, 1e-4, Plant().grid, parts)
    x, u = np.zeros((1, 8)), np.array([[0.0, 1.0, 1.03, 0.0]])
    x[0, DELTA], x[0, V_DC] = 0.3, 1.0
    modes, _ = plant.wiring.modes(frozenset(), None)
    unit = cmath.exp(0.3j)
    w = modes.states @ (modes.drive @ [1.03 * unit, 1.0] / -modes.rates)
    x[0, 0:6:2], x[0, 1:6:2] = (w[:3] / unit).real, (w[:3] / unit).imag
    u[0, 0] = 1.03 * x[0, 0]
    plant.start(x, u)
    order = plant.wiring.order
    assert plant.now["w"][0, : len(order)] == pytest.approx(w, abs=1e-12)
    exact, times = OneOfTwoLines(plant.par[0], 1.03, unit).run(
        np.concatenate([phases(one) for one in w])
    )
    line_breaker(plant, "first", closed=False)
    for _ in range(round(END / 1e-4)):
        plant_command(plant.records, 0, u[0])
        plant_step(plant.records)
    assert len(times) == 3 and plant.now["contact"][0] == plant.now["clearing"][0] == 0
    found = plant.now["w"][0, : len(order)]
    assert found[:3] == pytest.approx(exact[:3], abs=1e-8)
    assert found[4] == pytest.approx(exact[4], abs=1e-8)


def test_no_such_clearing(rest):
    plant = rest(grid=LOAD, protection=NO_TRIP)
    with pytest.raises(ValueError, match="clearing = 'soon': must be one of"):
        breaker(plant.plant, closed=False, clearing="soon")


def test_what_comes_while_poles_open(rest):
    plant = rest(grid=LOAD, protection=NO_TRIP)
    breaker(plant.plant, closed=False)
    plant.advance(3)
    assert plant.now["contact"][0] > 0
    breaker(plant.plant, closed=True)  # closes again what has opened
    assert plant.plant.wiring.opening == ()
    assert plant.now["contact"][0] == plant.now["clearing"][0] == 0
    breaker(plant.plant, closed=False)
    fault(plant.plant, 0.5, 0.1, duration=0.01)
    assert len(plant.plant.wiring.opening) == 1 and plant.now["contact"][0] == 1
    plant.advance(400)
    assert plant.now["contact"][0] == 0
