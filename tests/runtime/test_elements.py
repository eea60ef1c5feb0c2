"""The elements of Table II and their algebra."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gfm_runtime.elements import (
    IF,
    INTEGRATOR,
    PD,
    PI,
    ZERO,
    D,
    Element,
    I,
    I_gain,
    O,
    P,
    over,
    union,
    usable,
)
from gfm_runtime.errors import LawError

from ..support.laws import repeatable

POINTS = (0.3 + 0j, 2j, 100j * math.pi, -0.4 + 7j, 1e4 + 1e3j)

FORMULAE: list[tuple[Element, Callable[[complex], complex]]] = [
    (P(-3.0), lambda s: -3.0),
    (I(0.02), lambda s: 1 / (0.02 * s)),
    (D(0.5), lambda s: 0.5 * s),
    (PI(4.0, 0.1), lambda s: 4.0 * (1 + 1 / (0.1 * s))),
    (PD(2.0, 0.03), lambda s: 2.0 * (1 + 0.03 * s)),
    (IF(0.01, 0.16), lambda s: 0.01 / (0.16 * s + 1)),
    (O(5.0, 0.03, 0.4), lambda s: 5.0 / (0.03**2 * s**2 + 2 * 0.03 * 0.4 * s + 1)),
]


@pytest.mark.parametrize(("element", "formula"), FORMULAE)
@pytest.mark.parametrize("s", POINTS)
def test_value_is_the_formula(element, formula, s):
    assert element(s) == pytest.approx(formula(s), rel=1e-13)


@pytest.mark.parametrize(
    ("element", "order", "proper"),
    [
        (P(2.0), 0, True),
        (I(1.0), 1, True),
        (D(1.0), 0, False),
        (PI(1.0, 1.0), 1, True),
        (PD(1.0, 1.0), 0, False),
        (IF(1.0, 1.0), 1, True),
        (O(1.0, 1.0, 0.5), 2, True),
        (D(1.0) * IF(1.0, 2.0), 1, True),
        (PD(1.0, 3.0) * PD(1.0, 4.0) * IF(1.0, 2.0), 1, False),
        (O(1.0, 1.0, 0.5) * IF(1.0, 2.0) * PD(1.0, 5.0) * D(1.0), 3, True),
        (ZERO, 0, True),
    ],
)
def test_order_and_properness(element, order, proper):
    assert (element.order, element.is_proper) == (order, proper)


@pytest.mark.parametrize(
    ("product", "left"),
    [
        (PD(3.0, 0.2) * IF(2.0, 0.2), P(6.0)),
        (D(0.5) * I(0.25), P(2.0)),
        (PI(2.0, 0.1) * D(0.1) * IF(1.0, 0.1), P(2.0)),
        (PD(1.0, 1.0) * PD(1.0, 1e-4) * IF(1.0, 1e-4), PD(1.0, 1.0)),
        (PD(1.0, 1e-4) * PD(1.0, 50.0) * IF(1.0, 50.0), PD(1.0, 1e-4)),
        (IF(1.0, 0.1) + -IF(1.0, 0.1), ZERO),
        (PI(1.0, 0.3) + -I(0.3), P(1.0)),
        (O(1.0, 0.1, 0.5) * Element.of((1.0, 0.1, 0.01)), P(1.0)),
        (P(0.0) * O(1.0, 1.0, 1.0), ZERO),
    ],
)
def test_what_cancels_has_no_states(product, left):
    assert product.order == left.order == 0
    assert product.num == pytest.approx(left.num, rel=1e-9)


def test_near_misses_do_not_cancel():
    assert (PD(1.0, 0.2) * IF(1.0, 0.2000001)).order == 1
    assert (PI(1e3, 1e3) * D(1.0)).order == 0
    assert PI(1e3, 1e6).order == 1, "a slow integrator is one"


def test_factors_at_their_highest_multiplicity():
    a, b = (1.0, 0.1), (1.0, 0.2)
    assert union([(a, a), (a, b), ()]) == (a, a, b)
    assert over(IF(2.0, 0.1), (a, b, INTEGRATOR)) == pytest.approx((0.0, 2.0, 0.4))


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: I(0.0), "I: T = 0 must be from 1e-09"),
        (lambda: D(-1.0), "D: T = -1"),
        (lambda: PD(1.0, math.nan), "PD: T = nan"),
        (lambda: IF(1.0, math.inf), "IF: T = inf"),
        (lambda: O(1.0, 1.0, 0.0), "O: xi = 0 must be > 0"),
        (lambda: O(1.0, 1.0, math.inf), "O: xi = inf"),
        (lambda: P(math.nan), "P: k = nan must be from -1e+12 to 1e+12"),
        (lambda: IF(-1e13, 1.0), "IF: k = -1e+13"),
    ],
)
def test_wrong_numbers_are_named(make, named):
    with pytest.raises(LawError) as caught:
        make()
    assert named in str(caught.value)


def test_arrays_of_numbers_are_many_elements():
    """With the first element's cancellations."""
    k, T = np.array([1.0, -2.0, 3.0]), np.array([0.1, 0.2, 0.3])
    many = PI(k, T) * PD(2.0, T) * IF(k, 2 * T) + I_gain(k) * P(-1.0)
    for n in range(3):
        one = PI(k[n], T[n]) * PD(2.0, T[n]) * IF(k[n], 2 * T[n]) + I_gain(k[n]) * P(-1.0)
        for ours, single in ((many.num, one.num), *zip(many.den, one.den, strict=True)):
            assert [np.ravel(c)[n % np.size(c)] for c in ours] == pytest.approx(single, rel=1e-14)
    assert (PD(k, T) * IF(1.0, T)).den == ()
    assert usable({"k": k, "T": T - 0.1}).tolist() == [False, True, True]


gains = st.floats(0.01, 100.0) | st.floats(-100.0, -0.01)
times = st.floats(1e-3, 10.0)
any_element = st.one_of(
    st.builds(P, gains),
    st.builds(I, times),
    st.builds(D, times),
    st.builds(PI, gains, times),
    st.builds(PD, gains, times),
    st.builds(IF, gains, times),
    st.builds(O, gains, times, st.floats(0.1, 3.0)),
)


@repeatable
@given(any_element, any_element, any_element)
def test_sums_and_products(a, b, c):
    for s in (0.7 + 2j, 9j):
        assert (a * b)(s) == pytest.approx(a(s) * b(s), rel=1e-9)
        size = abs(a(s)) + abs(b(s)) + abs(c(s))
        assert abs((a + b)(s) - a(s) - b(s)) <= 1e-9 * size
        assert abs(((a + b) + c)(s) - (a + (b + c))(s)) <= 1e-9 * size
        assert ((a * b) * c)(s) == pytest.approx((a * (b * c))(s), rel=1e-9)
        spread = (a * (b + c))(s) - (a * b + a * c)(s)
        assert abs(spread) <= 1e-9 * abs(a(s)) * size
    assert (a * b).order == (b * a).order and (a * b).den == (b * a).den
    assert (a + b).den == (b + a).den


@repeatable
@given(any_element, any_element)
def test_orders_never_exceed_their_parts(a, b):
    for c in (a * b, a + b):
        assert c.order <= a.order + b.order
    assert (a * P(1.0)).den == (a + ZERO).den == a.den
    assert (a + -a).is_zero
    assert (a * ZERO).is_zero
