"""The line of travelling waves: the lattice of its ends, the chain matrix, delay equations."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gfm_plant import Network, NetworkParts, Plant, make_network, plant_command, plant_step
from gfm_plant.components import BergeronLine, bergeron_line
from gfm_plant.model import DELTA, V_DC
from gfm_plant.names import TRIPS

OFF = {name: {"enabled": False} for name, *_ in TRIPS}
OMEGA_B = 100 * np.pi
TAU = 5e-4
C_M, C_N = 0.05, 0.02


def line(Z_c: float = 1.0, tau: float = TAU, **more: Any) -> dict[str, Any]:
    """One of this impedance, p.u., and delay, s."""
    size = OMEGA_B * tau
    return {"start": "m", "end": "n", "L": Z_c * size, "B": size / Z_c} | more


def make(data: dict[str, Any], load: float = 0.0, T_s: float = 1e-4) -> Network:
    """A converter at m, and a resistor, or none, at n."""
    parts = {
        "bergeron_lines": {"x": data},
        "capacitors": {"c": {"node": "m", "Q": C_M}, "d": {"node": "n", "Q": C_N}},
        "loads": {"z": {"node": "n", "P": load}} if load else {},
    }
    plant = Plant.model_validate({"protection": OFF, "dc_source": {"mode": "regulated"}})
    given = NetworkParts.model_validate(parts)
    return make_network({"a": (plant, "m")}, T_s, Plant().grid, given)


def stepped(plant: Network, e: complex, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """The states after each tick from a start without any voltage, and the time, s."""
    x, u = np.zeros((1, 8)), np.array([[0.0, 1.0, 0.0, 0.0]])
    x[0, V_DC], x[0, DELTA] = 1.0, 0.0
    plant.start(x, u)
    u[0, 2:] = e.real, e.imag
    n, T_s = len(plant.wiring.order), float(plant.net[0]["T_s"])
    rows = [plant.now[0]["w"][:n].copy()]
    for _ in range(round(duration / T_s)):
        plant_command(plant.records, 0, u[0])
        plant_step(plant.records)
        rows.append(plant.now[0]["w"][:n].copy())
    return np.array(rows), T_s * np.arange(len(rows))


def exact(plant: Network, e: complex, duration: float, load: float) -> np.ndarray:
    """The same end by DOP853 of the delay equations, one delay after the other."""
    r, (_, one) = plant.par[0], plant.wiring.fed[0]
    w_b, Z, h, tau = OMEGA_B, one.Z, one.h, one.delay(OMEGA_B)
    past = lambda t: np.zeros(2, complex)  # noqa: E731  the waves of the last delay
    turn = np.exp(-1j * w_b * tau)
    x = np.zeros(5, complex)

    def E_at(past: Any, t: float) -> np.ndarray:
        a = past(t - tau) * turn
        return 0.5 * np.array([(1 + h) * a[1] + (1 - h) * a[0], (1 + h) * a[0] + (1 - h) * a[1]])

    times = [*np.arange(0.0, duration - 1e-12, tau), duration]
    for a, b in pairwise(times):

        def slope(t: float, x: np.ndarray, past: Any = past) -> np.ndarray:
            i_f, v, i_o, v_m, v_n = x
            E = E_at(past, t)
            return w_b * np.array([
                (e - v - r["R_f"] * i_f) / r["L_f"], (i_f - i_o) / r["C_f"],
                (v - v_m - r["R_g"] * i_o) / r["L_g"], (i_o - (v_m - E[0]) / Z) / C_M,
                (-load * v_n - (v_n - E[1]) / Z) / C_N,
            ]) - 1j * w_b * x  # fmt: skip

        found = solve_ivp(slope, (a, b), x, "DOP853", rtol=1e-8, atol=1e-10, dense_output=True)
        x = found.y[:, -1]

        def past(t: float, sol: Any = found.sol, before: Any = past) -> np.ndarray:
            return (1 + h) * sol(t)[3:5] - h * E_at(before, t)

    return x


@pytest.mark.full  # compiles the plant for several converters
@pytest.mark.parametrize(("load", "R"), [(0.0, 0.0), (1.0, 0.0), (20.0, 0.0), (0.8, 0.1)])
def test_against_the_delay_equations(load, R):
    """An open end, a matched one, one that is nearly shorted, and a lossy line; filter and banks
    ring at 0.6 to 1.3 kHz with the size of 1 to 4 p.u."""
    plants = [make(line(tau=5.3e-4, R=R), load, T_s) for T_s in (1e-4, 2.5e-5)]
    end = exact(plants[0], 1.0, 0.01, load)
    errors = [np.abs(stepped(plant, 1.0, 0.01)[0][-1] - end).max() for plant in plants]
    assert errors[0] < 0.1 and 3.0 < errors[0] / errors[1] < 6.0


@pytest.mark.full
def test_nothing_arrives_before_the_delay():
    rows, t = stepped(make(line()), 1.0, 0.002)
    assert (np.abs(rows[t < TAU + 5e-5, 4]) < 1e-15).all() and abs(rows[t > TAU, 4]).max() > 1.0


@pytest.mark.full
@pytest.mark.parametrize("R", [0.0, 0.1])
def test_its_steady_state_is_that_of_the_chain_matrix(R):
    """Of a quarter of R, half a line, half of R, half a line and a quarter of R."""
    plant, tau = make(line(tau=5.3e-4, R=R), 0.8), 5.3e-4
    w = stepped(plant, 1.0, 1.0)[0][-1]
    r = np.array([[1, R / 4], [0, 1]])
    c, s = np.cos(OMEGA_B * tau / 2), np.sin(OMEGA_B * tau / 2)
    half = np.array([[c, 1j * s], [1j * s, c]])
    chain = r @ half @ r @ r @ half @ r
    V, i = chain @ [w[4], w[4] * complex(0.8, C_N)]
    assert w[3] == pytest.approx(V, abs=1e-10)
    assert w[2] == pytest.approx(i + 1j * C_M * V, abs=1e-10)
    assert abs(w[4]) > 0.5


@pytest.mark.full
@pytest.mark.parametrize("tau", [5e-4, 5.3e-4])
def test_an_open_end_without_loss_does_not_grow(tau):
    """Only the filter's resistance takes energy out; a scheme that adds any would ring up."""
    size = np.abs(np.diff(stepped(make(line(tau=tau)), 1.0, 1.0)[0][:, 4]))
    assert size[-300:].max() < 0.01 * size[:300].max()


def waves(tau: float, R: float = 0.0) -> Any:
    """A record of a line on which nothing is yet, in a frame that stands still."""
    one = np.zeros(1, BergeronLine.record).view(np.recarray)[0]
    data = BergeronLine.model_validate(line(tau=tau, R=R))
    data.pack(one, "x", 1e-4, OMEGA_B)
    data.settle(one, np.zeros(2), 1.0, OMEGA_B, np.zeros(0))
    one.turn = 1.0
    return one


@pytest.mark.parametrize("G", [0.0, 1.0, 1e12, 0.5])
def test_the_lattice_of_a_step(G):
    """A step behind 0.25 p.u.: open, matched, shorted and any end against Bewley's lattice; what
    the ends have put into the line and taken from it is what its waves hold."""
    tau, h, R_s = 5e-4, 1e-4, 0.25
    one, energy, seen = waves(tau), 0.0, []
    for _ in range(60):
        for which in range(3):
            bergeron_line._arrive.py_func(one, one.t + which * h / 2, which)
        E = one.E[:, 1].copy()  # constant along a piece, but for its ends, where it may jump
        one.E[:] = E[:, None]
        one.v[0] = (1 / R_s + E[0]) / (1 / R_s + 1)
        one.v[1] = E[1] / (1 + G)
        energy += h * sum((one.v[k, 1] * (one.v[k, 1] - E[k])).real for k in range(2))
        bergeron_line._leave.py_func(one, h)
        seen.append(one.v[:, 1].copy())
    at = h * (np.arange(60) + 0.5)
    r_s, r_n = (R_s - 1) / (R_s + 1), (1 - G) / (1 + G)
    first = 1 / (1 + R_s)
    v_n = sum((1 + r_n) * first * (r_s * r_n) ** k * (at > (2 * k + 1) * tau) for k in range(8))
    v_m = first + sum(
        (1 + r_s) * r_n * first * (r_s * r_n) ** k * (at > (2 * k + 2) * tau) for k in range(8)
    )
    np.testing.assert_allclose(np.array(seen), np.stack([v_m, v_n], axis=1), atol=1e-12)
    last = [(one.count[0] - 1 - k) % bergeron_line.PIECES for k in range(round(tau / h))]
    held = h / 4 * (np.abs(one.a[last, :, 1]) ** 2).sum()
    assert energy == pytest.approx(held, abs=1e-15)


def test_its_linear_model_delays():
    """From a voltage at one end to the current at the other: the two-port up to 300 Hz."""
    (one,) = make(line(R=0.1)).of(BergeronLine)
    data = BergeronLine.model_validate(line(R=0.1))
    part = data.linear(one, np.zeros(2), None, 0.0, OMEGA_B)
    m = len(part.A)
    for f in (0.0, 50.0, 300.0):
        s = 2j * np.pi * f
        found = part.source @ np.linalg.solve(s * np.eye(m) - part.A, part.by_seen)
        mixed = data._mixed(1.0 + 2 * np.pi * f / OMEGA_B, OMEGA_B)
        E = np.linalg.solve(np.eye(2) + data.h * mixed, (1 + data.h) * mixed)
        by_v = -E / data.Z
        wave = found[:, :2] @ [1, 0] - 1j * found[:, 2:] @ [1, 0]  # of e^(s t): turns forwards
        np.testing.assert_allclose(wave[:2], by_v[:, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"tau": 5e-5}, r"bergeron_lines.x: L = .*a wave takes 5e-05 s; allowed is at least T_s ="),
        ({"tau": 0.1}, r"x: its waves take .* pieces of .* s; allowed are 1000"),
        ({"R": -1.0}, r"bergeron_lines.x.R\n.*greater than or equal to 0"),
    ],
)
def test_data_of_no_line(more, message):
    with pytest.raises(ValueError, match=message):
        make(line(**more))


def test_an_end_without_a_capacitor():
    data = BergeronLine.model_validate(line())
    with pytest.raises(ValueError, match=r"node n: x ends there, so the node needs a bank of"):
        data.sees("x", {"m": "c"})
