"""Loads of constant power, against SciPy's DOP853 and against their own derivatives."""

import cmath
import math
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gfm_plant import Network, NetworkParts, Plant, make_network
from gfm_plant.components import ConstantPowerLoad
from gfm_plant.components.constant_power import drawn
from gfm_plant.grid import line_breaker
from gfm_plant.names import TRIPS

from .test_network import go, start

pytestmark = pytest.mark.full  # compiles the plant for several converters

OFF = {name: {"enabled": False} for name, *_ in TRIPS}
W_B = 100 * math.pi
LINE = {"start": "m", "end": "n", "L": 0.1, "R": 0.03}
POWER = {"node": "n", "P": 0.5, "Q": 0.1}


def make(T_s: float = 1e-4, count: int = 1, **changes: Any) -> Network:
    """Two converters, a line, and at its end loads of constant power on a capacitor bank."""
    power = {**POWER, "P": 0.5 / count, "Q": 0.1 / count, **changes}
    parts: dict[str, Any] = {
        "lines": {"l": LINE}, "capacitors": {"c": {"node": "n", "Q": 0.3}},
        "loads": {"r": {"node": "n", "P": 0.3}},
        "constant_power": {"p" * k: power for k in range(1, count + 1)},
    }  # fmt: skip
    plant = Plant.model_validate({"protection": OFF})
    return make_network(
        {"a": (plant, "m"), "b": (plant, "m")}, T_s, Plant().grid,
        NetworkParts.model_validate(parts),
    )  # fmt: skip


def exact(plant: Network, u: np.ndarray, seconds: float) -> np.ndarray:
    """w and v_f by DOP853 of the equations written anew."""
    r = plant.par[0]
    (load,) = plant.of(ConstantPowerLoad)
    S, tau, least = complex(load["S"]), float(load["tau"]), math.sqrt(load["least_v2"])
    a_I, a_Z = float(load["a_I"]), float(load["a_Z"])
    opened = "p" in plant.wiring.opened
    delta = [cmath.phase(plant.now["unit"][0, k]) for k in range(2)]

    def slope(t: float, s: np.ndarray) -> np.ndarray:
        i_f, v, i_o = s[0:6:3], s[1:6:3], s[2:6:3]
        i_l, v_n, f = s[6], s[7], s[8]
        e = np.array(
            [u[k, 2] * np.exp(1j * (delta[k] + W_B * (u[k, 1] - 1) * t)) for k in range(2)]
        )
        V = max(abs(f), least)
        power = (1 - a_I - a_Z) + a_I * V + a_Z * V**2
        i = 0.0 if opened else S.conjugate() * power * f / V**2
        # i_l is the sum of both i_o: their node has no capacitor, and its voltage follows
        a, b = r["L_g"], 0.1
        v_m = (
            ((v - r["R_g"] * i_o) / a).sum() + (v_n + 0.03 * i_l) / b
        ) / (2 / a + 1 / b)  # fmt: skip
        out = np.empty_like(s)
        out[0:6:3] = W_B / r["L_f"] * (e - v - r["R_f"] * i_f)
        out[1:6:3] = W_B / r["C_f"] * (i_f - i_o)
        out[2:6:3] = W_B / a * (v - v_m - r["R_g"] * i_o)
        out[6] = W_B / b * (v_m - v_n - 0.03 * i_l)
        out[7] = W_B / 0.3 * (i_l - 0.3 * v_n - i)
        out[:8] -= 1j * W_B * s[:8]
        out[8] = (v_n - f) / tau
        return out

    now = plant.now[0]
    s0 = np.concatenate([now["w"][:8], plant.of(ConstantPowerLoad)["v_f"]])
    return solve_ivp(slope, (0, seconds), s0, "DOP853", rtol=1e-11, atol=1e-12).y[:, -1]


def error(plant: Network, u: np.ndarray, seconds: float, T_s: float) -> float:
    there = exact(plant, u, seconds)
    go(plant, u, round(seconds / T_s))
    now = plant.now[0]
    found = np.concatenate([now["w"][:8], plant.of(ConstantPowerLoad)["v_f"]])
    return float(np.abs(found - there).max())


@pytest.mark.parametrize("slip", [0.0, 2e-3])
def test_a_rest_is_one(slip):
    """At the start the load draws its power, at its own voltage and at any speed."""
    plant = make()
    u = start_at(plant, [1.02, 1.02], 1 + slip)
    now, order = plant.now[0], plant.wiring.order
    v = complex(now["w"][order.index("c")])
    f = complex(plant.of(ConstantPowerLoad)["v_f"][0])
    assert f == pytest.approx(v / (1 + 1j * W_B * slip * 0.005), abs=1e-12)
    i = complex(0.5, -0.1) / f.conjugate()
    i_l = complex(now["w"][order.index("l")])
    assert i_l == pytest.approx(i + (0.3 + 1j * (1 + slip) * 0.3) * v, abs=1e-9)
    before = abs(v)
    go(plant, u, 100)
    assert abs(complex(plant.now["w"][0, order.index("c")])) == pytest.approx(before, abs=1e-7)


def start_at(plant: Network, E: Any, omega: float) -> np.ndarray:
    """As ``start`` of the other tests, but twice: the load's current is known after the first."""
    N = len(plant.par)
    u = np.zeros((N, 4))
    u[:, 1], u[:, 2] = omega, E
    x = np.zeros((N, 8))
    x[:, 7] = 1.0
    for _ in range(2):
        plant.start(x, u, [((), omega)] * len(plant.wiring.fed))
        w = plant.now["w"][0]
        modes, sources = plant.wiring.modes(frozenset(), None)
        slip = W_B * (omega - 1)
        v = complex(w[plant.wiring.order.index("c")])
        names, loads = zip(*plant.wiring.fed, strict=True)
        volts = [u[k, 2] for k in range(N)] + [load.current(v, slip)[1] for load in loads]
        assert tuple(sources[N:]) == names
        whole = modes.states @ (modes.drive @ volts / (1j * slip - modes.rates))
        for k in range(N):
            own = whole[3 * k : 3 * k + 3]
            x[k, 0:6:2], x[k, 1:6:2] = own.real, own.imag
            u[k, 0] = u[k, 2] * own[0].real
    plant.start(x, u, [((), omega)] * len(plant.wiring.fed))
    return u


def test_a_step_against_an_adaptive_integrator_of_second_order():
    """Half a piece, which is a period here, a quarter of the error."""
    errors = []
    for T_s in (1e-4, 5e-5, 2.5e-5):
        plant = make(T_s)
        u = start_at(plant, [1.02, 1.02], 1.0)
        u[0] += [0.0, 2e-3, 0.04, 0.0]
        assert plant.net[0]["pieces"][0] == 1
        errors.append(error(plant, u, 0.01, T_s))
    assert errors[0] < 1e-6
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.05)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.05)


def test_it_comes_on_and_goes_off():
    plant = make(closed=False)
    u = start(plant, [1.02, 1.02], [0.0, 0.0])
    assert error(plant, u, 0.01, 1e-4) < 1e-8
    line_breaker(plant, "p", True)
    assert error(plant, u, 0.03, 1e-4) < 1e-4
    v = complex(plant.now["w"][0, plant.wiring.order.index("c")])
    assert abs(v) < 1.05
    line_breaker(plant, "p", False)
    assert error(plant, u, 0.01, 1e-4) < 1e-8


def test_below_its_least_voltage_it_is_an_impedance():
    """Which draws P and Q at that voltage."""
    plant = make(V_least=2.0)
    u = start_at(plant, [1.02, 1.02], 1.0)
    u[0] += [0.0, 2e-3, 0.04, 0.0]
    assert error(plant, u, 0.02, 1e-4) < 1e-4
    i, _ = drawn(plant.of(ConstantPowerLoad)[0], 1.0 + 0j, 0j)
    assert i == pytest.approx(complex(0.5, -0.1) / 4)


def test_six_of_a_sixth_are_one():
    found = []
    for count in (1, 6):
        plant = make(count=count)
        u = start_at(plant, [1.02, 1.02], 1.0)
        u[0] += [0.0, 2e-3, 0.04, 0.0]
        go(plant, u, 300)
        found.append(plant.st["x"])
    assert found[0] == pytest.approx(found[1], abs=1e-11)


def test_shares_of_a_zip_load_against_dop853():
    plant = make(share_I=0.3, share_Z=0.2)
    u = start_at(plant, [1.02, 1.02], 1.0)
    u[0] += [0.0, 2e-3, 0.04, 0.0]
    assert error(plant, u, 0.02, 1e-4) < 1e-5


@pytest.mark.parametrize(
    ("shares", "exponent"), [({}, 0), ({"share_I": 1.0}, 1), ({"share_Z": 1.0}, 2)]
)
def test_power_goes_with_the_voltage_as_its_share_says(shares, exponent):
    load = ConstantPowerLoad(node="n", P=0.5, Q=0.1, **shares)
    for V in (0.8, 1.0, 1.2):
        i = load.current(V * np.exp(0.3j), 0.0)[1]
        power = V * np.exp(0.3j) * np.conj(i)
        assert power == pytest.approx((0.5 + 0.1j) * V**exponent, rel=1e-12)


@pytest.mark.parametrize("V", [1.03, 0.6])
@pytest.mark.parametrize("shares", [{}, {"share_I": 0.4, "share_Z": 0.1}])
def test_the_admittance_is_the_derivative(V, shares):
    load = ConstantPowerLoad(node="n", P=0.5, Q=0.1, **shares)
    Y = load.admittance(V, 0.0)
    step = 1e-6
    for k, nudge in enumerate((step, 1j * step)):
        up, down = (load.current(V + sign * nudge, 0.0)[1] for sign in (1, -1))
        change = (up - down) / (2 * step)
        assert Y[:, k] == pytest.approx([change.real, change.imag], abs=1e-8)
    assert (Y[0, 0].real < 0) == (V > 0.7)  # the negative resistance
    fast = load.admittance(V, np.array([0.0, 200j, 1e6j]))
    assert fast.shape == (3, 2, 2)
    assert fast[1] == pytest.approx(Y / (1 + 1j)) and np.abs(fast[2]).max() < 1e-3


def test_its_slope_is_that_of_its_current():
    f, d, step = 0.9 + 0.2j, -3.0 + 5.0j, 1e-6
    plant = make(share_I=0.4, share_Z=0.1)
    (one,) = plant.of(ConstantPowerLoad)
    _, slope = drawn(one, f, d)
    load = plant.wiring.fed[0][1]
    up, down = (load.current(f + sign * step * d, 0.0)[1] for sign in (1, -1))
    assert slope == pytest.approx((up - down) / (2 * step), rel=1e-8)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"node": "m"}, "node m: p draws constant power, so the node needs a bank of"),
        ({"node": "x"}, "p is at node 'x', which has no path"),
        ({"share_I": 0.7, "share_Z": 0.4}, "share_I = 0.7, share_Z = 0.4: at most 1 together"),
        ({"tau_s": 1e-4}, "network.constant_power.p: tau_s = 0.0001: must be >= 0.0005 s"),
    ],
)
def test_impossible_loads(change, message):
    with pytest.raises(ValueError, match=message):
        make(**change)
