"""The controls of machines by themselves: SciPy's responses of their block diagrams, their rests
and limits. In a machine they are in `test_synchronous_machine`."""

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy import signal
from scipy.integrate import solve_ivp

from gfm_plant.components import SynchronousMachine
from gfm_plant.components.controls import EXCITERS, GOVERNORS, STABILISERS
from gfm_plant.components.controls.control import (
    Control,
    Exciter,
    Governor,
    Shaft,
    Stabiliser,
    Terminals,
)
from gfm_plant.components.controls.esst3a import Esst3a
from gfm_plant.components.controls.esst4b import Esst4b
from gfm_plant.components.controls.exdc2 import Exdc2
from gfm_plant.components.controls.exst1 import Exst1
from gfm_plant.components.controls.gast import Gast
from gfm_plant.components.controls.ggov1 import Ggov1
from gfm_plant.components.controls.hygov import Hygov
from gfm_plant.components.controls.ieeeg1 import Ieeeg1
from gfm_plant.components.controls.ieeet1 import Ieeet1
from gfm_plant.components.controls.pss1a import Pss1a
from gfm_plant.components.controls.sexs import Sexs
from gfm_plant.components.controls.st2cut import St2cut
from gfm_plant.components.controls.tgov1 import Tgov1

MACHINE = {"node": "m", "S": 1.0, "H": 3.0, "P": 0.5}
Polynomials = tuple[np.ndarray, np.ndarray]


def product(*blocks: tuple[list[float], list[float]]) -> Polynomials:
    """Numerator and denominator of blocks in series, highest power first."""
    num, den = np.ones(1), np.ones(1)
    for a, b in blocks:
        num, den = np.polymul(num, a), np.polymul(den, b)
    return num, den


def sees(one: Control, seen: float, output: float) -> Any:
    """What a control sees: of an exciter the voltage, its own output as the field's current, and
    phasors; of a governor the speed, and an electric power."""
    if isinstance(one, Governor):
        return Shaft(seen, 0.6)
    return (
        Terminals(seen, output, v=0.3 + 0.97j, i=0.6 + 0.5j) if isinstance(one, Exciter) else seen
    )


def stepped(one: Control, output: float, seen: float, by: float, t: np.ndarray) -> np.ndarray:
    """Its output after a step of what it sees, from a rest."""
    rest, then = sees(one, seen, output), sees(one, seen + by, output)
    states, asked = one.rest(output, rest)
    p, rates = np.array(one.numbers()), type(one).rates.py_func

    def slope(_: float, x: np.ndarray) -> np.ndarray:
        out = np.zeros(len(x))
        rates(p, x, 0, then, asked, out)
        return out

    assert rates(p, np.array(states), 0, rest, asked, np.zeros(len(states))) == pytest.approx(
        output
    )
    way = solve_ivp(slope, (0, t[-1]), states, "DOP853", t, rtol=1e-10, atol=1e-12)
    return np.array([rates(p, x, 0, then, asked, np.zeros(len(x))) - output for x in way.y.T])


SEXS = Sexs(K=50.0, T_A=0.4, T_B=1.5, E_min=-5.0)
IEEET1 = Ieeet1(V_Rmin=-8.0, V_Rmax=8.0)
EXDC2 = Exdc2(T_B=1.2, T_C=0.3, V_Rmin=-8.0, V_Rmax=8.0)
EXST1 = Exst1(T_C=0.3, T_B=1.2, K_F=0.05)
ESST3A = Esst3a(K_C=0.5)
LAGGING = Esst3a(K_C=0.5, T_A=0.05)
# its rectifier, at the phasors of ``sees`` and a field's current of 1.8
SOURCE = 3.67 * np.exp(1j * np.radians(3.33))
V_E = abs(SOURCE * (0.3 + 0.97j) + 1j * (0.435 + 0.0098 * SOURCE) * (0.6 + 0.5j))
V_B = V_E * (1.0 - 0.577 * 0.5 * 1.8 / V_E)
WIDE = {"K_C": 0.5, "V_Rmax": 9.0, "V_Rmin": -9.0, "V_Mmax": 9.0, "V_Mmin": -9.0, "T_A": 0.05}
ESST4B = Esst4b(**WIDE)
PROPORTIONAL = Esst4b(**WIDE, K_IR=0.0, K_IM=0.0, K_G=0.0)
GAST = Gast(T1=0.4, A_T=4.0, D_turb=0.2)
GGOV1 = Ggov1(flag=False, T_rate=0.8, K_dgov=0.5, T_dgov=0.3, T_c=0.05, D_m=0.2)
IEEEG1 = Ieeeg1(T1=0.1, T2=0.05, T6=0.4, K1=0.2, K3=0.3, K5=0.3, K7=0.1)  # T7 left out
HYGOV = Hygov(D_turb=0.0)
TGOV1 = Tgov1(D_t=0.3)
PSS1A = Pss1a(T6=0.02, A1=0.05, A2=0.001, V_STmin=-9.0, V_STmax=9.0)
ST2CUT = St2cut(K2=4.0, T1=0.02, T2=0.1, T4=2.0, T9=0.2, L_Smin=-9.0, L_Smax=9.0)
PLAIN = Pss1a(T1=0.0, T2=0.0, T3=0.0, T4=0.0, V_STmin=-9.0, V_STmax=9.0)


@pytest.mark.parametrize(
    ("one", "output", "seen", "blocks"),
    [
        (SEXS, 1.8, 1.02, [([-50.0], [0.02, 1]), ([0.4, 1], [1.5, 1]), ([1], [0.05, 1])]),
        # the loop of amplifier, exciter and feedback, closed: G / (1 + G F)
        (IEEET1, 1.8, 1.02, [
            ([-1.0], [0.02, 1]),
            (np.polymul([20.0], [0.35, 1]),
             np.polyadd(product(([1], [0.2, 1]), ([1], [0.314, 1]), ([1], [0.35, 1]))[1],
                        [20.0 * 0.063, 0.0])),
        ]),
        # the same with its lead and lag within the loop
        (EXDC2, 1.8, 1.02, [
            ([-1.0], [0.02, 1]),
            (product(([20.0], [1]), ([0.3, 1], [1]), ([0.35, 1], [1]))[0],
             np.polyadd(product(([1], [1.2, 1]), ([1], [0.2, 1]), ([1], [0.314, 1]),
                                ([1], [0.35, 1]))[1],
                        np.polymul([0.3, 1], [20.0 * 0.063, 0.0]))),
        ]),
        # its feedback K_F s/(1 + T_F s) around lead, lag and regulator
        (EXST1, 1.8, 1.02, [
            ([-1.0], [0.02, 1]),
            (product(([50.0], [1]), ([0.3, 1], [1]), ([1.0, 1], [1]))[0],
             np.polyadd(product(([1], [1.2, 1]), ([1], [0.02, 1]), ([1], [1.0, 1]))[1],
                        np.polymul([0.3, 1], [50.0 * 0.05, 0.0]))),
        ]),
        # lead, lag and the outer regulator; the inner one with its feedback, closed
        (ESST3A, 1.8, 1.02, [
            ([-20.0], [0.02, 1]), ([1.0, 1], [5.0, 1]), ([8.0 * V_B], [0.4, 1 + 8.0 * V_B]),
        ]),
        (LAGGING, 1.8, 1.02, [
            ([-20.0], [0.02, 1]), ([1.0, 1], [5.0, 1]), ([1], [0.05, 1]),
            ([8.0 * V_B], [0.4, 1 + 8.0 * V_B]),
        ]),
        # the inner regulator C = K_PM + K_IM/s with its feedback, V_B C/(1 + K_G V_B C)
        (ESST4B, 1.8, 1.02, [
            ([-1.0], [0.02, 1]), ([2.97, 2.97], [1, 0]), ([1], [0.05, 1]),
            ([V_B, 0.2 * V_B], [1 + 0.1 * V_B, 0.1 * 0.2 * V_B]),
        ]),
        (PROPORTIONAL, 1.8, 1.02, [([-2.97 * V_B], [0.02, 1]), ([1], [0.05, 1])]),
        (Pss1a(T6=0.0, A1=0.0, A2=0.0), 0.0, 0.0, [
            ([200.0, 0], [10.0, 1]), ([0.05, 1], [0.02, 1]), ([3.0, 1], [5.4, 1]),
        ]),
        (PSS1A, 0.0, 1e-3, [
            ([1], [0.02, 1]), ([200.0, 0], [10.0, 1]), ([1], [0.001, 0.05, 1]),
            ([0.05, 1], [0.02, 1]), ([3.0, 1], [5.4, 1]),
        ]),
        # 10/(1 + 0.02 s) + 4/(1 + 0.1 s) = (14 + 1.08 s)/((1 + 0.02 s)(1 + 0.1 s))
        (ST2CUT, 0.0, 1e-3, [
            ([1.08, 14.0], [1]), ([1], [0.02, 1]), ([1], [0.1, 1]), ([3.0, 0], [2.0, 1]),
            ([0.15, 1], [0.05, 1]), ([0.15, 1], [0.05, 1]), ([0.2, 1], [0.05, 1]),
        ]),
        (PLAIN, 0.0, 0.0, [([200.0, 0], [10.0, 1])]),
    ],
)  # fmt: skip
def test_a_step_is_that_of_the_block_diagram(one, output, seen, blocks):
    t = np.linspace(0.0, 5.0, 200)
    _, exact = signal.step(product(*blocks), T=t)
    by = 1e-3
    np.testing.assert_allclose(stepped(one, output, seen, by, t), by * exact, atol=1e-7)


def test_a_governor_by_its_block_diagram():
    """And beside it the turbine's own damping, which acts at once."""
    t, by = np.linspace(0.0, 20.0, 200), 1e-3
    _, exact = signal.step(product(([-20.0], [0.5, 1]), ([3.0, 1], [10.0, 1])), T=t)
    found = stepped(TGOV1, 0.6, -2e-3, by, t)
    np.testing.assert_allclose(found, by * (exact - 0.3), atol=1e-8)
    assert found[-1] == pytest.approx(-by * (20.0 + 0.3), rel=0.15)  # its droop, by and by
    assert TGOV1.per_speed() == 20.3


def test_a_governor_of_one_shaft_by_its_block_diagram():
    t, by = np.linspace(0.0, 30.0, 300), 1e-4
    ahead = product(([-20.0], [1]), ([0.05, 1], [0.1, 1]), ([1], [0.1, 1]), ([1], [0.3, 1]))
    behind_5 = product(ahead, ([1], [7.0, 1]))
    behind_6 = product(behind_5, ([1], [0.4, 1]))
    parts = ((0.2, ahead), (0.3, behind_5), (0.4, behind_6))
    exact = sum(share * signal.step(system, T=t)[1] for share, system in parts)
    np.testing.assert_allclose(stepped(IEEEG1, 0.6, 0.0, by, t), by * exact, atol=1e-8)
    assert IEEEG1.per_speed() == pytest.approx(18.0)


def test_a_governor_of_one_shaft_opens_no_faster_than_it_may():
    t = np.linspace(0.0, 1.0, 50)
    one = Ieeeg1(T4=0.0, T5=0.0, K1=1.0, K3=0.0, U_o=0.1)
    found = stepped(one, 0.5, 0.0, -0.05, t)
    np.testing.assert_allclose(found, 0.1 * t, atol=1e-6)


def test_a_hydraulic_governor_by_its_linear_model():
    """Of small steps: the gate by the permanent and the temporary droop, and the water behind it,
    whose inertia acts against it at first."""
    t, by, P = np.linspace(0.0, 400.0, 4001), 1e-6, 0.6
    g = P / 1.2 + 0.08
    error = product(([1], [0.05, 1]), ([5.0, 1], [0.5 * 5.0, 0.0]))  # c by set - w - R c
    gate = error[0], np.polyadd(error[1], 0.05 * error[0])
    # of h (q - q_NL) with h = (q/g)^2: dq/dt = (2/T_W) (dg - dq) / g
    slope = 2.0 * (g - 0.08) / g
    # dP/A_t = dq + slope (dq - dg)
    turbine = 1.2 * np.polysub([0.0, 2.0 / g], [slope, 0.0]), np.array([1.0, 2.0 / g])
    system = product((-gate[0], gate[1]), ([1], [0.2, 1]), turbine)
    _, exact = signal.step(system, T=t)
    found = stepped(HYGOV, P, 0.0, by, t)
    np.testing.assert_allclose(found, by * exact, atol=1e-9)
    assert found[-1] == pytest.approx(-by * 1.2 / 0.05, rel=1e-2)
    assert found[1] > 0


def test_a_gas_turbine_by_its_block_diagram():
    t, by = np.linspace(0.0, 10.0, 200), 1e-3
    _, exact = signal.step(product(([-20.0], [0.4, 1]), ([1], [0.2, 1])), T=t)
    np.testing.assert_allclose(stepped(GAST, 0.6, 1e-3, by, t), by * (exact - 0.2), atol=1e-8)
    assert GAST.per_speed() == 20.2


def test_the_general_governor_by_its_block_diagram():
    """Under a constant power it has no droop: proportion, derivative and the integral of both, the
    valve and the turbine, of 0.8 p.u., and its damping, which acts at once."""
    t, by = np.linspace(0.0, 5.0, 200), 1e-4
    controller = product(([10.0 * 0.3 + 0.5, 10.0], [0.3, 1]), ([1, 2.0 / 10.0], [1, 0]))
    behind = product(([-0.8], [0.5, 1]), ([1.5 * 0.05, 1.5], [0.1, 1]))
    _, exact = signal.step(product(controller, behind), T=t)
    found = stepped(GGOV1, 0.5, 2e-4, by, t)
    np.testing.assert_allclose(found, by * (exact - 0.8 * 0.2), atol=1e-8)
    assert GGOV1.per_speed() == pytest.approx(20.0)


@pytest.mark.parametrize(
    ("one", "by", "power"),
    [
        (Gast(V_max=1.6), -0.05, 1.0),  # A_T, the heat
        (Gast(V_max=0.9), -0.05, 0.9),
        (Ggov1(T_rate=0.9, L_dref=1.02), -0.02, 0.9 * 1.02),  # the heat
        (Ggov1(V_max=0.7), -0.02, 1.5 * (0.7 * 0.98 - 0.2)),  # fuel follows the speed
        (Ggov1(T_rate=0.8, V_min=0.3, flag=False), 0.02, 0.8 * 1.5 * (0.3 - 0.2)),
    ],
)
def test_what_limits_a_gas_turbine(one, by, power):
    """The limits without wind-up of its valve, which its machine applies, are applied here."""
    states, asked = one.rest(0.6, Shaft(0.0, 0.6))
    p, x, out, most = np.array(one.numbers()), np.array(states), np.zeros(8), one.limits()
    for _ in range(20_000):
        found = type(one).rates.py_func(p, x, 0, Shaft(by, 0.6), asked, out)
        x += 5e-3 * out[: len(x)]
        for place, ends in most.items():
            x[place] = np.clip(x[place], *ends)
    assert found == pytest.approx(power, rel=1e-6)


@pytest.mark.parametrize(
    ("more", "by", "expected"),
    [
        ({"R_open": 0.04}, -0.01, 1.5 * 0.04),  # p.u./s, by the valve
        ({"R_close": -0.03, "K_pgov": 20.0}, 0.01, -1.5 * 0.03),
        ({"db": 0.004, "K_igov": 0.0, "R_open": 9.0}, -0.006, 0.0),  # 10 · 0.002 at the end
        ({"maxerr": 0.002, "K_igov": 0.0, "R_open": 9.0}, -0.006, 0.0),
    ],
)
def test_rates_dead_band_and_error_of_the_general_governor(more, by, expected):
    """The rate of its power 1 s after a step; without an integral it comes to 1.5 · 10 · 0.002."""
    one, t = Ggov1(flag=False, T_act=0.05, T_b=0.01, **more), np.array([0.0, 0.9, 1.0])
    found = stepped(one, 0.5, 0.0, by, t)
    assert (found[2] - found[1]) / 0.1 == pytest.approx(expected, rel=1e-6, abs=1e-6)
    if expected == 0.0:
        assert found[2] == pytest.approx(1.5 * 10.0 * 0.002, rel=1e-6)


@pytest.mark.parametrize(("by", "ceiling"), [(-0.3, 1.0), (0.9, -0.87)])
def test_the_integrals_of_an_exciter_do_not_wind_up(by, ceiling):
    """V_M, and so E_fd = V_B V_M, comes to its limit, and leaves it at once with the error."""
    one = Esst4b(K_C=0.0, K_G=0.0, T_A=0.0)
    _, asked = one.rest(1.8, sees(one, 1.0, 1.8))
    p, x, out = (
        np.array(one.numbers()),
        np.array(one.rest(1.8, sees(one, 1.0, 1.8))[0]),
        np.zeros(4),
    )
    low, back = sees(one, 1.0 + by, 1.8), sees(one, 1.0 - 0.1 * np.sign(by), 1.8)
    for seen, ticks in ((low, 40_000), (back, 2_000)):
        at_once = Esst4b.rates.py_func(p, x, 0, seen, asked, out)
        if seen is back:
            assert at_once == pytest.approx(ceiling * min(V_E, 5.48))
        for _ in range(ticks):
            E_fd = Esst4b.rates.py_func(p, x, 0, seen, asked, out)
            x += 1e-3 * out
    assert abs(x[1]) < 2.0 and abs(E_fd) < 5.48 and (E_fd - at_once) * ceiling < 0.0


def test_the_limits_of_a_commutator_exciter_follow_the_voltage():
    one = Exdc2(V_Rmax=2.0, V_Rmin=-2.0)
    _, asked = one.rest(1.5, Terminals(1.0, 1.5, 1j, 0j))
    out, p = np.zeros(5), np.array(one.numbers())
    halved = Terminals(0.5, 1.5, 0.5j, 0j)
    Exdc2.rates.py_func(p, np.array([0.5, 2.0, 1.5, 1.5, 0.1]), 0, halved, asked, out)
    assert out[1] == 0.0  # at 0.5 p.u. it is beyond its limit, and rises no further
    assert out[2] == pytest.approx((0.5 * 2.0 - 1.5) / 0.314)


@pytest.mark.parametrize(
    ("V", "I_fd", "asked", "ceiling"), [(0.9, 1.5, 2.0, 4.35), (0.5, 3.0, 0.0, -2.8)]
)
def test_a_static_exciter_is_at_its_ceiling_without_wind_up(V, I_fd, asked, ceiling):
    """V V_Rmax - K_C I_fd and V V_Rmin - K_C I_fd: it comes there, and leaves it at once."""
    one = Exst1(V_Rmax=5.0, V_Rmin=-5.0, K_C=0.1, T_B=0.0, K_F=0.0)
    p, rates = np.array(one.numbers()), Exst1.rates.py_func
    out, x = np.zeros(4), np.array([V, 0.0, 1.0, 1.0])
    for _ in range(2000):
        E_fd = rates(p, x, 0, Terminals(V, I_fd, V * 1j, 0j), asked, out)
        x += 1e-5 * out
    assert E_fd == pytest.approx(ceiling)
    rates(p, x, 0, Terminals(V, I_fd, V * 1j, 0j), V, out)  # the error is gone
    assert out[2] * ceiling < 0.0 and abs(x[2] - ceiling) < 0.1


def test_the_error_of_a_static_exciter_is_limited():
    one = Exst1(V_Imax=0.03, K_F=0.0)
    t = np.linspace(0.0, 2.0, 20)
    found = stepped(one, 1.0, 1.0, -0.2, t)  # from an error of 1/50 to 0.03
    assert found[-1] == pytest.approx(50.0 * 0.03 - 1.0)


@pytest.mark.parametrize(
    ("load", "keeps"),
    [(0.0, 1.0), (0.2, 0.8846), (0.6, 0.39**0.5), (0.9, 0.1732), (1.2, 0.0), (-0.1, 1.0)],
)
def test_what_a_rectifier_keeps_of_its_voltage(load, keeps):
    """F_EX of IEEE Std 421.5, annex D, and the limit behind it."""
    one = Esst3a(K_P=2.0, K_I=0.0, X_L=0.0, theta_P=0.0, K_C=0.5, V_Bmax=1.9)
    seen = Terminals(1.0, 4.0 * load, 1j, 0j)
    x = np.array([1.0, 0.0, 0.0, 0.7])
    E_fd = Esst3a.rates.py_func(np.array(one.numbers()), x, 0, seen, 1.0, np.zeros(4))
    assert E_fd == pytest.approx(min(2.0 * keeps, 1.9) * 0.7, rel=1e-12)


@pytest.mark.parametrize(
    ("more", "by", "field"),
    [
        ({"V_Imax": 0.1}, -0.5, 0.1 * 20.0),  # the error
        ({"V_Rmax": 1.9}, -0.15, 1.9),  # the outer regulator, without lag
        ({"V_Gmax": 1.82}, -0.005, None),  # the feedback: the inner loop is open beyond it
    ],
)
def test_the_limits_of_a_compound_exciter(more, by, field):
    """At rest the inner regulator makes V_M = K_M (V_R - K_G E_fd), so E_fd = V_R / (K_G + 1 / (K_M
    V_B)), or V_B K_M (V_R - V_Gmax)."""
    one = Esst3a(K_C=0.0, T_B=0.0, T_C=0.0, **more)
    _, asked = one.rest(1.8, sees(one, 1.0, 1.8))
    found = 1.8 + stepped(one, 1.8, 1.0, by, np.linspace(0.0, 30.0, 5))[-1]
    B = min(V_E, 5.48)
    expected = B * 8.0 * (20.0 * (asked - 1.0 - by) - 1.82)
    if field is not None:
        expected = field / (1.0 + 1.0 / (8.0 * B))
    assert found == pytest.approx(expected, rel=1e-6)


def test_the_saturation_passes_both_points():
    one = Ieeet1(E_1=2.8, S_E1=0.04, E_2=3.73, S_E2=0.33)
    for E, S_E in ((2.8, 0.04), (3.73, 0.33)):
        assert one.field(E) == pytest.approx(E * (1.0 + S_E))
    a, _ = one.saturation()
    assert 0 < a < 2.8 and one.field(0.9 * a) == pytest.approx(0.9 * a)


def test_a_rest_does_not_move():
    saturated = Ieeet1(E_1=2.8, S_E1=0.04, E_2=3.73, S_E2=0.33)
    for one in (
        SEXS,
        IEEET1,
        EXDC2,
        EXST1,
        ESST3A,
        LAGGING,
        ESST4B,
        PROPORTIONAL,
        saturated,
        TGOV1,
        IEEEG1,
        HYGOV,
        GAST,
        GGOV1,
        PSS1A,
        PLAIN,
    ):
        output = 0.0 if isinstance(one, Stabiliser) else 0.5 if one is GGOV1 else 3.0
        seen = sees(one, 1.0 if isinstance(one, Exciter) else 0.01, output)
        states, asked = one.rest(output, seen)
        out = np.zeros(len(states))
        found = type(one).rates.py_func(np.array(one.numbers()), states, 0, seen, asked, out)
        assert found == pytest.approx(output, abs=1e-14) and np.abs(out).max() < 1e-12


def test_the_output_of_a_stabiliser_is_limited():
    t = np.linspace(0.0, 5.0, 200)
    assert stepped(Pss1a(), 0.0, 0.0, 0.05, t).max() == 0.2
    assert stepped(Pss1a(), 0.0, 0.0, -0.05, t).min() == -0.2
    found = stepped(St2cut(L_Smin=-0.04), 0.0, 0.0, 0.05, t)
    assert (found.max(), found.min()) == (0.05, -0.04)


def test_every_control_is_complete():
    for kind in (*EXCITERS, *GOVERNORS, *STABILISERS):
        one = kind()
        assert one.lags() and all(lag > 0 for lag in one.lags().values())
        assert set(one.limits()) <= set(range(len(one.rest(1.0, sees(one, 1.0, 1.0))[0])))
        named = {"avr": {}, kind_of(one): {"type": kind.kind()}}
        assert kind_of(one) in dict(SynchronousMachine(**MACHINE, **named))


def kind_of(one: Control) -> str:
    each = {"avr": EXCITERS, "governor": GOVERNORS, "pss": STABILISERS}
    return next(role for role, kinds in each.items() if type(one) in kinds)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"avr": {"type": "IEEET2"}}, "'SEXS', 'IEEET1'"),
        ({"avr": {"type": "ESST4B", "V_Mmin": 1.0}}, "V_Mmin = 1: must be less than V_Mmax, 1"),
        ({"governor": {"type": "GGOV1", "T_sb": 0.0}}, "T_sb = 0: must be above 0 with T_sa = 4"),
        ({"governor": {"type": "GOV"}}, "'TGOV1', 'IEEEG1', 'HYGOV', 'GAST', 'GGOV1'"),
        ({"governor": {"type": "IEEEG1", "K1": 0.0, "K3": 0.0}}, "K1, K3, K5 and K7 are 0"),
        ({"governor": {"type": "IEEEG1", "T2": 0.1}}, "T1 = 0: must be above 0 with T2 = 0.1"),
        ({"governor": {"type": "HYGOV", "G_min": 1.0}}, "G_min = 1: must be less than G_max, 1"),
        ({"avr": {"type": "EXDC2", "T_C": 0.1}}, "T_B = 0: must be above 0 with T_C = 0.1"),
        ({"avr": {"type": "EXST1", "V_Rmin": 1e4}}, "V_Rmin = 10000: must be less than V_Rmax"),
        ({"avr": {"type": "EXST1", "V_Imax": 0.0, "V_Imin": 0.0}}, "V_Imin = 0: must be less than"),
        ({"avr": {"type": "ESST3A", "V_Mmin": 99.0}}, "V_Mmin = 99: must be less than V_Mmax, 99"),
        ({"avr": {"type": "ESST3A", "K_P": 0.0, "K_I": 0.0}}, "K_P and K_I are 0: nothing would"),
        ({"governor": {"T1": -0.5}}, "greater than 0"),
        ({"governor": {"V_min": 1.5}}, "V_min = 1.5: must be less than V_max, 1.2"),
        ({"governor": {}, "droop": 0.04}, "droop = 0.04: leave it out, the governor has its own"),
        ({"avr": {"type": "IEEET1", "V_Rmin": 9.0}}, "V_Rmin = 9: must be less than V_Rmax, 5"),
        ({"avr": {"type": "IEEET1", "S_E1": 0.1}}, "S_E1 = 0.1: S_E2 must be above 0, too"),
        ({"avr": {"type": "IEEET1", "S_E2": 0.1, "E_1": 3.0, "E_2": 2.0}}, "E_1 = 3: must be less"),
        ({"avr": {"type": "IEEET1", "S_E1": 0.2, "S_E2": 0.1, "E_2": 2.0}}, "must be at most S_E2"),
        ({"pss": {}}, "pss: acts on a voltage regulator; give the machine an avr, too"),
        ({"avr": {}, "pss": {"T2": 0.0}}, "T2 = 0: must be above 0 with T1 = 0.05"),
        ({"avr": {}, "pss": {"type": "ST2CUT", "T8": 0.0}}, "T8 = 0: must be above 0 with T7"),
        ({"avr": {}, "pss": {"type": "PSS2B"}}, "'PSS1A', 'ST2CUT'"),
        ({"avr": {}, "pss": {"A2": 0.1}}, "A1 = 0: must be above 0 with A2 = 0.1"),
    ],
)
def test_data_of_no_control(more: dict[str, Any], message):
    with pytest.raises(ValidationError, match=message):
        SynchronousMachine.model_validate(MACHINE | more)
