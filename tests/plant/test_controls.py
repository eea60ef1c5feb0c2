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
from gfm_plant.components.controls.control import Control
from gfm_plant.components.controls.ieeet1 import Ieeet1
from gfm_plant.components.controls.pss1a import Pss1a
from gfm_plant.components.controls.sexs import Sexs
from gfm_plant.components.controls.tgov1 import Tgov1

MACHINE = {"node": "m", "S": 1.0, "H": 3.0, "P": 0.5}
Polynomials = tuple[np.ndarray, np.ndarray]


def product(*blocks: tuple[list[float], list[float]]) -> Polynomials:
    """Numerator and denominator of blocks in series, highest power first."""
    num, den = np.ones(1), np.ones(1)
    for a, b in blocks:
        num, den = np.polymul(num, a), np.polymul(den, b)
    return num, den


def stepped(one: Control, output: float, seen: float, by: float, t: np.ndarray) -> np.ndarray:
    """Its output after a step of what it sees, from a rest."""
    states, asked = one.rest(output, seen)
    p, rates = np.array(one.numbers()), type(one).rates.py_func

    def slope(_: float, x: np.ndarray) -> np.ndarray:
        out = np.zeros(len(x))
        rates(p, x, 0, seen + by, asked, out)
        return out

    assert rates(p, np.array(states), 0, seen, asked, np.zeros(len(states))) == pytest.approx(
        output
    )
    way = solve_ivp(slope, (0, t[-1]), states, "DOP853", t, rtol=1e-10, atol=1e-12)
    return np.array([rates(p, x, 0, seen + by, asked, np.zeros(len(x))) - output for x in way.y.T])


SEXS = Sexs(K=50.0, T_A=0.4, T_B=1.5, E_min=-5.0)
IEEET1 = Ieeet1(V_Rmin=-8.0, V_Rmax=8.0)
TGOV1 = Tgov1(D_t=0.3)
PSS1A = Pss1a(T6=0.02, A1=0.05, A2=0.001, V_STmin=-9.0, V_STmax=9.0)
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
        (Pss1a(T6=0.0, A1=0.0, A2=0.0), 0.0, 0.0, [
            ([200.0, 0], [10.0, 1]), ([0.05, 1], [0.02, 1]), ([3.0, 1], [5.4, 1]),
        ]),
        (PSS1A, 0.0, 1e-3, [
            ([1], [0.02, 1]), ([200.0, 0], [10.0, 1]), ([1], [0.001, 0.05, 1]),
            ([0.05, 1], [0.02, 1]), ([3.0, 1], [5.4, 1]),
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


def test_the_saturation_passes_both_points():
    one = Ieeet1(E_1=2.8, S_E1=0.04, E_2=3.73, S_E2=0.33)
    for E, S_E in ((2.8, 0.04), (3.73, 0.33)):
        assert one.field(E) == pytest.approx(E * (1.0 + S_E))
    a, _ = one.saturation()
    assert 0 < a < 2.8 and one.field(0.9 * a) == pytest.approx(0.9 * a)


def test_a_rest_does_not_move():
    saturated = Ieeet1(E_1=2.8, S_E1=0.04, E_2=3.73, S_E2=0.33)
    for one in (SEXS, IEEET1, saturated, TGOV1, PSS1A, PLAIN):
        output, seen = (0.0, 0.01) if isinstance(one, Pss1a) else (3.0, 0.01)
        states, asked = one.rest(output, seen)
        out = np.zeros(len(states))
        found = type(one).rates.py_func(np.array(one.numbers()), states, 0, seen, asked, out)
        assert found == pytest.approx(output, abs=1e-14) and np.abs(out).max() < 1e-12


def test_the_output_of_a_stabiliser_is_limited():
    t = np.linspace(0.0, 5.0, 200)
    assert stepped(Pss1a(), 0.0, 0.0, 0.05, t).max() == 0.2
    assert stepped(Pss1a(), 0.0, 0.0, -0.05, t).min() == -0.2


def test_every_control_is_complete():
    for kind in (*EXCITERS, *GOVERNORS, *STABILISERS):
        one = kind()
        assert one.lags() and all(lag > 0 for lag in one.lags().values())
        assert set(one.limits()) <= set(range(len(one.rest(1.0, 1.0)[0])))
        named = {"avr": {}, kind_of(one): {"type": kind.kind()}}
        assert kind_of(one) in dict(SynchronousMachine(**MACHINE, **named))


def kind_of(one: Control) -> str:
    each = {"avr": EXCITERS, "governor": GOVERNORS, "pss": STABILISERS}
    return next(role for role, kinds in each.items() if type(one) in kinds)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"avr": {"type": "IEEET2"}}, "'SEXS', 'IEEET1'"),
        ({"governor": {"type": "HYGOV"}}, "'TGOV1'"),
        ({"governor": {"T1": -0.5}}, "greater than 0"),
        ({"governor": {"V_min": 1.5}}, "V_min = 1.5: must be less than V_max, 1.2"),
        ({"governor": {}, "droop": 0.04}, "droop = 0.04: leave it out, the governor has its own"),
        ({"avr": {"type": "IEEET1", "V_Rmin": 9.0}}, "V_Rmin = 9: must be less than V_Rmax, 5"),
        ({"avr": {"type": "IEEET1", "S_E1": 0.1}}, "S_E1 = 0.1: S_E2 must be above 0, too"),
        ({"avr": {"type": "IEEET1", "S_E2": 0.1, "E_1": 3.0, "E_2": 2.0}}, "E_1 = 3: must be less"),
        ({"avr": {"type": "IEEET1", "S_E1": 0.2, "S_E2": 0.1, "E_2": 2.0}}, "must be at most S_E2"),
        ({"pss": {}}, "pss: acts on a voltage regulator; give the machine an avr, too"),
        ({"avr": {}, "pss": {"T2": 0.0}}, "T2 = 0: must be above 0 with T1 = 0.05"),
        ({"avr": {}, "pss": {"A2": 0.1}}, "A1 = 0: must be above 0 with A2 = 0.1"),
    ],
)
def test_data_of_no_control(more: dict[str, Any], message):
    with pytest.raises(ValidationError, match=message):
        SynchronousMachine.model_validate(MACHINE | more)
