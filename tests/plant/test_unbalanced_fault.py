"""Faults of one and two phases, against the equations of three phases and sequence networks."""

import cmath
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from gfm_plant import clear_fault, fault, grid_impedance, grid_unbalance, phase_jump
from gfm_plant.grid import breaker
from gfm_plant.records import I_F, I_O, V

from ..support.laws import slow_but

WEAK = {"scr": 3.0, "x_over_r": 6.0}
NO_TRIP = {
    name: {"enabled": False}
    for name in ("over_current", "over_voltage", "under_voltage", "dc_over_voltage")
}
STIFF = {"mode": "regulated", "k_p": 200.0}
W = 100 * math.pi
TURN = cmath.exp(2j * math.pi / 3)
AXES = np.array([1, TURN, TURN.conjugate()])  # of the phases a, b, c
SHORTED = {"abc": [0, 1, 2], "a": [0], "b": [1], "bc": [1, 2], "ca": [2, 0], "ab": [0, 1]}


def phases(vector: Any) -> NDArray[np.float64]:
    """The phases of a space vector."""
    return np.real(vector * AXES.conj())


def vector(abc: Any) -> complex:
    """The space vector of three phases."""
    return complex(2 / 3 * np.dot(abc, AXES))


class Phases:
    """The rig with a fault, phase by phase: i_f, v and i_o of three wires, i_g of four.

    Between the place of the fault and the grid each phase has an L and an R of its own, so that
    the zero sequence meets what the positive one does.
    """

    def __init__(self, plant: Any, at: float, R: float, kind: str, which: str) -> None:
        self.r, self.E, self.unit = plant.par[0], plant.u[2], complex(plant.now["unit"][0, 0])
        self.at, self.R, self.kind, self.shorted = at, R, kind, SHORTED[which]

    def sources(self, t: float) -> tuple[Any, Any]:
        turn = cmath.exp(1j * W * t)
        return phases(self.E * self.unit * turn), phases(turn)

    def node(self, known: Any, slope: Any) -> Any:
        """The voltages of the place to ground, from 3 linear equations.

        Args:
            known: the fault's current in each phase.
            slope: its d/dt, as a constant and a matrix that multiplies the voltages.
        """
        rows, right = np.zeros((3, 3)), np.zeros(3)
        constant, matrix = slope
        for k in range(3):
            if k not in self.shorted:  # its current stays zero
                rows[k], right[k] = matrix[k], -constant[k]
            elif self.kind != "LL":
                rows[k, k], right[k] = 1.0, self.R * known[k]
        if self.kind == "LL" and self.shorted:
            one, two = self.shorted
            rows[one] = matrix[one] + matrix[two]
            right[one] = -constant[one] - constant[two]
            rows[two, one], rows[two, two], right[two] = 1.0, -1.0, self.R * known[one]
        return np.linalg.solve(rows, right)

    def slope(self, t: float, s: Any) -> Any:
        i_f, v, i_o, i_g = s.reshape(4, 3)
        e, v_g = self.sources(t)
        r, at = self.r, self.at
        three = np.eye(3) - 1 / 3  # three wires: what is common to all phases has no path
        a, b = at * r["L_g"], (1 - at) * r["L_g"]
        constant = three @ (v - at * r["R_g"] * i_o) / a + (v_g + (1 - at) * r["R_g"] * i_g) / b
        u = self.node(i_o - i_g, (constant, -three / a - np.eye(3) / b))
        rates = [
            (e - v - r["R_f"] * i_f) / r["L_f"],
            (i_f - i_o) / r["C_f"],
            three @ (v - u - at * r["R_g"] * i_o) / a,
            (u - v_g - (1 - at) * r["R_g"] * i_g) / b,
        ]
        return r["omega_b"] * np.concatenate(rates)


class AtCapacitor(Phases):
    """The same with the fault at the filter capacitor; i_g is the line's, i_o is not used."""

    def slope(self, t: float, s: Any) -> Any:
        i_f, v, _, i_g = s.reshape(4, 3)
        e, v_g = self.sources(t)
        r, R, zero = self.r, self.R, i_g.mean()
        earthed = {"LG": lambda: -3 * R * zero - v[self.shorted[0]],
                   "LLG": lambda: (-v[self.shorted].sum() - 3 * R * zero) / 2,
                   "LL": lambda: 0.0}  # fmt: skip
        u = v + earthed[self.kind]()
        leak = np.zeros(3)
        if self.kind == "LL":
            one, two = self.shorted
            leak[one] = (v[one] - v[two]) / R
            leak[two] = -leak[one]
        else:
            leak[self.shorted] = u[self.shorted] / R
        rates = [
            (e - v - r["R_f"] * i_f) / r["L_f"],
            (np.eye(3) - 1 / 3) @ (i_f - i_g - leak) / r["C_f"],
            np.zeros(3),
            (u - v_g - r["R_g"] * i_g) / r["L_g"],
        ]
        return r["omega_b"] * np.concatenate(rates)


@pytest.mark.parametrize(
    ("at", "R", "kind", "which"),
    [
        (0.4, 0.0, "LG", "a"), (0.7, 0.1, "LG", "b"), (0.4, 0.05, "LL", "bc"),
        (0.6, 0.0, "LL", "ca"), (0.5, 0.03, "LLG", "bc"), (0.3, 0.0, "LLG", "ab"),
        (0.0, 0.3, "LG", "b"), (0.0, 0.4, "LL", "ab"), (0.0, 0.3, "LLG", "bc"),
    ],
)  # fmt: skip
def test_fault_and_clearing_against_three_phases(rest, at, R, kind, which):
    plant = rest(grid=WEAK, protection=NO_TRIP, dc_source=STIFF)
    plant.advance(37)
    t = 37 * 1e-4
    w = plant.now["w"][0, [I_F, V, I_O, I_O]]
    model = (Phases if at else AtCapacitor)(plant, at, R, kind, which)
    s = np.concatenate([phases(x * cmath.exp(1j * W * t)) for x in w])
    fault(plant.plant, at, R, duration=0.02, kind=kind, phases=which, clearing="instant")
    plant.advance(100)
    s = solve_ivp(model.slope, (t, t + 0.01), s, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    back = cmath.exp(-1j * W * (t + 0.01))
    exact = np.array([vector(x) * back for x in s.reshape(4, 3)])
    found = plant.now["w"][0, [I_F, V, I_O]]
    assert found == pytest.approx(exact[[0, 1, 2 if at else 3]], abs=1e-9)
    plant.advance(100)
    s = solve_ivp(model.slope, (t + 0.01, t + 0.02), s, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    back = cmath.exp(-1j * W * (t + 0.02))
    exact = np.array([vector(x) * back for x in s.reshape(4, 3)])
    exact[2] = at * exact[2] + (1 - at) * exact[3]  # the line keeps its flux
    found = plant.now["w"][0, [I_F, V, I_O]]
    assert plant.now["contact"][0] == 0
    assert found == pytest.approx(exact[:3], abs=1e-9)


def through_fault(k: int) -> Any:
    """The current of a phase through a fault on the line, for `solve_ivp` to find its zero."""
    return lambda t, s: s[6 + k] - s[9 + k]


@pytest.mark.parametrize("scr", slow_but([3.0], [3.0, 10.0]))
@pytest.mark.parametrize(
    ("at", "R", "kind", "which"),
    [
        (0.5, 0.0, "3ph", "abc"), (0.4, 0.05, "3ph", "abc"), (0.4, 0.0, "LG", "b"),
        (0.6, 0.02, "LL", "ca"), (0.5, 0.03, "LLG", "bc"), (0.3, 0.0, "LLG", "ab"),
    ],
)  # fmt: skip
def test_each_phase_opens_where_its_current_passes_zero(rest, at, R, kind, which, scr):
    """Against the equations of three phases, whose events are the zeros."""
    plant = rest(grid={**WEAK, "scr": scr}, protection=NO_TRIP, dc_source=STIFF)
    t, end = 0.0, 0.06
    w = plant.now["w"][0, [I_F, V, I_O, I_O]]
    model = Phases(plant, at, R, kind, which)
    fault(plant.plant, at, R, duration=0.0123, kind=kind, phases=which)
    plant.advance(600)
    assert plant.now["contact"][0] == plant.now["clearing"][0] == 0
    s = np.concatenate([phases(x) for x in w])
    tight = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13}
    s = solve_ivp(model.slope, (t, 0.0123), s, **tight).y[:, -1]
    t, opened = 0.0123, []
    while model.shorted:
        events = [through_fault(k) for k in model.shorted]
        for event in events:
            event.terminal = True
        part = solve_ivp(model.slope, (t, end), s, events=events, **tight)
        (first,) = (k for k, times in enumerate(part.t_events) if len(times))
        t, s = part.t[-1], part.y[:, -1]
        opened.append(t)
        model.shorted = (
            [] if kind == "LL" else [k for k in model.shorted if k != model.shorted[first]]
        )
    assert len(opened) == (1 if kind == "LL" else len(which))
    s = solve_ivp(model.slope, (t, end), s, **tight).y[:, -1]
    back = cmath.exp(-1j * W * end)
    exact = np.array([vector(x) * back for x in s.reshape(4, 3)])
    assert plant.now["w"][0, [I_F, V, I_O]] == pytest.approx(exact[:3], abs=1e-8)


@pytest.mark.parametrize(
    ("kind", "which", "Z_0"),
    [("LG", "a", None), ("LG", "c", 0.5 + 1.1j), ("LL", "bc", None), ("LLG", "ca", 0.02 + 0.3j)],
)
def test_steady_state_by_sequence_networks(rest, kind, which, Z_0):
    """In series for one phase, in parallel for two: v and i_o by phasors at the place."""
    plant = rest(grid=WEAK, protection=NO_TRIP, dc_source=STIFF)
    at, R, r = 0.4, 0.05, plant.par[0]
    fault(plant.plant, at, R, kind=kind, phases=which, Z_0=Z_0)
    plant.advance(30_000)
    cycle = np.empty((200, 2), complex)
    for k in range(200):
        cycle[k] = plant.now["w"][0, [V, I_O]]
        plant.advance()
    t = (30_000 + np.arange(200)) * 1e-4
    Z_f, Z_g = complex(r["R_f"], r["L_f"]), complex(r["R_g"], r["L_g"])
    E = plant.u[2] * np.exp(1j * plant.x[6])
    Y_c = 1j * r["C_f"]
    Z_conv = 1 / (1 / Z_f + Y_c) + at * Z_g  # from the place to the bridge, a short circuit
    E_conv, Z_grid = E / (1 + Z_f * Y_c), (1 - at) * Z_g
    Z_1 = Z_conv * Z_grid / (Z_conv + Z_grid)
    U = Z_1 * (E_conv / Z_conv + 1 / Z_grid)
    zero = Z_grid if Z_0 is None else Z_0
    # what the textbook says of phase a holds for the phase that differs
    on = AXES[{"a": 0, "c": 2, "bc": 0, "ca": 1}[which]].conjugate()
    if kind == "LG":
        I_1 = U / (2 * Z_1 + zero + 3 * R)
        I_2 = I_1 * on**2
    elif kind == "LL":
        I_1 = U / (2 * Z_1 + R)
        I_2 = -I_1
    else:
        parallel = (Z_1 + R) * (zero + R) / (Z_1 + zero + 2 * R)
        I_1 = U / (Z_1 + R + parallel)
        I_2 = -I_1 * (zero + R) / (Z_1 + zero + 2 * R) * on**2
    if kind == "LL":
        I_2 = I_2 * on**2
    u_1, u_2 = U - Z_1 * I_1, -Z_1 * I_2  # at the place
    i_1, i_2 = (E_conv - u_1) / Z_conv, -u_2 / Z_conv  # of the converter's line
    v_1, v_2 = u_1 + at * Z_g * i_1, u_2 + at * Z_g * i_2
    assert cycle.mean(axis=0) == pytest.approx([v_1, i_1], abs=1e-6)
    # of the space vector v = v+ e^(j omega t) + conj(v-) e^(-j omega t)
    backwards = (cycle * np.exp(2j * W * t)[:, None]).mean(axis=0)
    assert backwards.conj() == pytest.approx([v_2, i_2], abs=1e-6)


def test_the_sources_give_what_the_resistances_take(rest):
    plant = rest(grid=WEAK, protection=NO_TRIP, dc_source=STIFF)
    at, R, Z_0, r = 0.3, 0.04, 0.1 + 0.4j, plant.par[0]
    fault(plant.plant, at, R, kind="LLG", phases="ca", Z_0=Z_0)
    plant.advance(40_000)
    given, taken = np.empty(200), np.empty(200)
    for k in range(200):
        i_f, i_o, i_g, through = (
            plant.phasor(name) for name in ("converter.i_f", "converter.i_o", "beyond", "contact")
        )
        v_g = np.exp(-1j * plant.st["x"][0, 6])
        turn = cmath.exp(1j * (W * (40_000 + k) * 1e-4 + plant.x[6])) / AXES[1]
        leak = (i_o - i_g) * turn  # alpha on phase b, which no fault touches
        assert (through * turn).real == pytest.approx(leak.real, abs=1e-10)
        given[k] = plant.u[2] * i_f.real - (v_g * i_g.conjugate()).real
        line = at * abs(i_o) ** 2 + (1 - at) * abs(i_g) ** 2
        taken[k] = r["R_f"] * abs(i_f) ** 2 + r["R_g"] * line + R * leak.imag**2
        taken[k] += (3 * R + 2 * Z_0.real) * leak.real**2
        plant.advance()
    assert given.mean() == pytest.approx(taken.mean(), abs=1e-9)
    assert np.ptp(given) > 0.1


def test_two_phases_to_an_ideal_ground_are_all_three(rest):
    """Bolted and with Z_0 = 0 the third phase is at ground potential too."""
    found = []
    for more in ({"kind": "LLG", "phases": "ab", "Z_0": 0j}, {}):
        plant = rest(grid=WEAK, protection=NO_TRIP, dc_source=STIFF)
        plant.advance(13)
        fault(plant.plant, 0.4, 0.0, duration=0.015, clearing="instant", **more)
        plant.advance(50)
        grid_unbalance(plant.plant, (1.0, 0.6, 0.8j), duration=0.008)
        plant.advance(50)
        phase_jump(plant.plant, 15.0)
        plant.advance(200)
        found.append(plant.st["x"][0].copy())
    assert found[0] == pytest.approx(found[1], abs=1e-11)


def test_protection_sees_it_and_the_grid_goes_on_feeding_it(rest):
    """The bridge trips; line and filter then ring as the equations with no bridge do."""
    plant = rest(grid=WEAK)
    fault(plant.plant, 0.1, 0.0, kind="LL")
    plant.advance(200)
    assert plant.truth()["trip"] == 1
    plant.advance(30_000)
    r, Z_g = plant.par[0], complex(plant.par[0]["R_g"], plant.par[0]["L_g"])
    Z_c, Z_grid = 1 / (1j * r["C_f"]) + 0.1 * Z_g, 0.9 * Z_g
    Z_1 = Z_c * Z_grid / (Z_c + Z_grid)
    U = Z_c / (Z_c + Z_grid)
    i_g = [plant.now["w"][0, plant.plant.wiring.order.index("beyond")]]
    for _ in range(199):
        plant.advance()
        i_g.append(plant.now["w"][0, plant.plant.wiring.order.index("beyond")])
    I_1 = U / (2 * Z_1)
    assert np.mean(i_g) == pytest.approx((U - Z_1 * I_1 - 1) / Z_grid, abs=1e-6)


def test_a_line_that_changes_takes_the_path_of_the_zero_sequence_with_it(rest):
    """During the fault, against a plant that had that line and fault at once."""
    plant, other = (rest(grid=WEAK, protection=NO_TRIP, dc_source=STIFF) for _ in range(2))
    L, R = (2 * plant.par[0][f"{x}_g"] / plant.par[0][f"{x}_line_n"] for x in "LR")
    fault(plant.plant, 0.4, 0.02, kind="LG")
    grid_impedance(plant.plant, L, R)
    grid_impedance(other.plant, L, R)
    fault(other.plant, 0.4, 0.02, kind="LG")
    for one in (plant, other):
        one.advance(150)
    assert plant.st["x"][0] == pytest.approx(other.st["x"][0], abs=1e-12)
    clear_fault(plant.plant)
    plant.advance(20_000)
    assert plant.now["w"][0, plant.plant.wiring.order.index("contact")] == 0.0


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"kind": "LLL"}, r"kind = 'LLL': must be one of \['3ph', 'LG', 'LL', 'LLG'\]"),
        ({"kind": "LG", "phases": "ab"}, r"phases = 'ab': must be one of \['a', 'b', 'c'\] for"),
        ({"kind": "LL", "phases": "a"}, r"phases = 'a': must be one of \['bc', 'ca', 'ab'\] for"),
        ({"kind": "LL", "Z_0": 1j}, "X_0, R_0: no current of kind 'LL' goes to ground"),
        ({"kind": "LG", "Z_0": -1j}, "X_0 = -1.0: must be >= 0 p.u."),
        ({"kind": "LG", "Z_0": -1 + 1j}, "R_0 = -1.0: must be >= 0 p.u."),
        ({"kind": "LG", "R": -1.0}, "R = -1.0: must be >= 0 p.u. at position 0.5"),
    ],
)
def test_impossible_faults_change_nothing(rest, more, message):
    plant = rest()
    before = [r.tobytes() for r in plant.plant.memory]
    with pytest.raises(ValueError, match=message):
        fault(plant.plant, 0.5, **{"R": 0.1, **more})
    assert [r.tobytes() for r in plant.plant.memory] == before


def test_an_island_needs_a_path_to_ground(rest):
    plant = rest(grid={"load_R": 50.0, "load_L": 0.05})
    breaker(plant.plant, closed=False, clearing="instant")
    with pytest.raises(ValueError, match="X_0: not set, and no closed line leads from position"):
        fault(plant.plant, 0.5, 0.1, kind="LG")
    fault(plant.plant, 0.5, 0.1, kind="LG", Z_0=0.3j)
    plant.advance(100)
    assert abs(plant.phasor("contact")) > 0.1
