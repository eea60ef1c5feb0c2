"""Elements TF, SS and sum: the bits of named elements, SciPy's answers, and what is refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from gfm_design.tuning.gains import realise_each
from gfm_runtime import LawError, build_law, discretise, pack_law, parse_law, realise
from gfm_runtime.elements import SS, TF, Element, stable
from gfm_runtime.lawfile import LawFile

from ..support.laws import repeatable

HEAD = """
name = "x"
title = ""
source = ""
[parameters]
k = 0.03
T = 0.2
[phi]
11 = { type = "PI", k = 90.0, k_i = 400.0 }
35 = { type = "I", k_i = 20.0 }
"""
W = np.geomspace(1e-2, 1e5, 29)


def law_of(cell: str) -> LawFile:
    return parse_law(f"{HEAD}22 = {cell}\n")


def element(cell: str) -> Element:
    return build_law(law_of(cell)).phi[1, 1]


def record(cell: str) -> bytes:
    return pack_law(discretise(build_law(law_of(cell)), 1e-4)).tobytes()


@pytest.mark.parametrize(
    ("fraction", "named"),
    [
        ("num = [0.01], den = [0.167, 1]", '{ type = "IF", k = 0.01, T = 0.167 }'),
        ('num = ["k"], den = ["T", 1]', '{ type = "IF", k = "k", T = "T" }'),
        ('k = "k", num = [1], den = ["T", 1]', '{ type = "IF", k = "k", T = "T" }'),
        ("num = [4], den = [1, 4]", '{ type = "IF", k = 1.0, T = 0.25 }'),
        ("num = [0.3, 7.0], den = [1, 0]", '{ type = "PI", k = 0.3, k_i = 7.0 }'),
        ("num = [7.0], den = [1, 0]", '{ type = "I", k_i = 7.0 }'),
        ("num = [5], den = [1]", '{ type = "P", k = 5.0 }'),
        ("num = [5], den = [0.25, 0.5, 1]", '{ type = "O", k = 5.0, T = 0.5, xi = 0.5 }'),
        ("num = [0.02, 0.5], den = [0.3, 1]",
         '[{ type = "IF", k = 0.5, T = 0.3 }, { type = "PD", k = 1.0, T = 0.04 }]'),
        ("num = [5], den = [1], T_f = 0.1", '{ type = "IF", k = 5.0, T = 0.1 }'),
    ],
)  # fmt: skip
def test_a_fraction_has_the_bits_of_the_named_element(fraction, named):
    assert record(f'{{ type = "TF", {fraction} }}') == record(named)


def test_a_sum_has_the_bits_of_its_fraction():
    terms = '{ type = "P", k = 0.01 }, [{ type = "IF", k = 0.5, T = 0.25 }, { type = "P", k = 2 }]'
    whole = '{ type = "TF", num = [0.0025, 1.01], den = [0.25, 1] }'
    assert record(f'{{ type = "sum", terms = [{terms}] }}') == record(whole)


def test_a_fraction_of_any_order_is_scipys():
    num, den = [3.0, 2.0, 900.0], [1e-6, 3e-4, 0.02, 1.0, 0.0]
    made = TF(tuple(num), tuple(den))
    theirs = signal.freqresp(signal.TransferFunction(num, den), W)[1]
    np.testing.assert_allclose([made(1j * w) for w in W], theirs, rtol=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_a_state_space_is_scipys(seed):
    """Stable, with an integrator in every second one."""
    random = np.random.default_rng(seed)
    n = int(random.integers(1, 7))
    T = random.normal(size=(n, n)) + 3 * np.eye(n)
    poles = -(10.0 ** random.uniform(-1, 3, n))
    poles[0] *= seed % 2
    A = T @ np.diag(poles) @ np.linalg.inv(T)
    B, C, D = T @ random.normal(size=n), random.normal(size=n) @ np.linalg.inv(T), random.normal()
    made = SS(tuple(map(tuple, A)), tuple(B), tuple(C), D)
    theirs = signal.freqresp(signal.StateSpace(A, B[:, None], C[None], [[D]]), W)[1]
    np.testing.assert_allclose([made(1j * w) for w in W], theirs, rtol=1e-6)


def test_states_that_do_not_act_are_left_out():
    """With them an unstable one."""
    made = element('{ type = "SS", A = [[-10, 0], [0, 3]], B = [1, 0], C = [1, 1], D = 0 }')
    assert made.order == 1
    assert [made(s) for s in (0.0, 1j, 30j)] == pytest.approx([0.1, 1 / (10 + 1j), 1 / (10 + 30j)])
    assert SS((), (), (), 2.0) == TF((2.0,), (1.0,))


def test_relative_degree_is_that_of_the_state_space():
    """A chain of three lags has no zeros, which rounding would bring in."""
    A = "[[-3, 0, 0], [7, -11, 0], [0, 13, -17]]"
    made = element(f'{{ type = "SS", A = {A}, B = [1, 0, 0], C = [0, 0, 1], D = 0 }}')
    assert len(made.num) == 1
    assert made(0.0) == pytest.approx(7 * 13 / (3 * 11 * 17), rel=1e-12)


def test_a_state_space_over_several_cells_is_scipys_and_shares_its_states():
    A, B = np.array([[0.0, 1], [-400, -30]]), np.array([[0.0, 1], [1, 0]])
    C, D = np.array([[400.0, 0], [1, 2]]), np.array([[0.0, 0.1], [0, 0]])
    parts = ", ".join(f"{k} = {v.tolist()}" for k, v in zip("ABCD", (A, B, C, D), strict=True))
    law = build_law(parse_law(f'{HEAD}23x24 = {{ type = "SS", {parts} }}\n'))
    for i, j in np.ndindex(2, 2):
        theirs = [C[i] @ np.linalg.solve(1j * w * np.eye(2) - A, B[:, j]) + D[i, j] for w in W]
        made = law.phi[1 + i, (1, 3)[j]]
        np.testing.assert_allclose([made(1j * w) for w in W], theirs, rtol=1e-9)
    assert realise(law).order == 1 + 2 + 2 + 1  # that of PI, two in each row, that of I


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("24x4 = 3", "phi: 24x4: must be an object with type, A, B, C, D, not 3"),
        ("24x4 = {S, B = [[1]], C = [[1], [1]], D = [[0], [0]] }", "phi: 24x4: must be rows x "
         "columns, each once, e.g. 12x45"),
        ("12x4 = {S, B = [[1]], C = [[1]], D = [[0], [0]] }", "phi: 12x4.C: must be 2 x 1, as A "
         "is 1 x 1"),
        ("3x45 = {S, B = [[1, 1]], C = [[1]], D = [[0, 0]] }", "phi: 3x45: has cell 35, which "
         "stands beside it"),
    ],
)  # fmt: skip
def test_what_is_no_state_space_over_several_cells_has_one_line(line, message):
    with pytest.raises(LawError) as problem:
        parse_law(HEAD + line.replace("{S", '{ type = "SS", A = [[-1]]'))
    assert str(problem.value) == f"law file: {message}"


@pytest.mark.parametrize(
    ("cell", "message"),
    [
        ('type = "TF", num = [1], den = [1, 0, 0]', "phi_22: unstable: a double integrator 1/s^2"),
        ('type = "SS", A = [[0, 1], [0, 0]], B = [0, 1], C = [1, 0], D = 0',
         "phi_22: unstable: a double integrator 1/s^2"),
        ('type = "TF", num = [1, 0, 0], den = [1, 1]',
         "phi_22: improper: its numerator has degree 2, its denominator 1; "
         "give it a pole (den of a TF, T_f of a D or PD, or an IF)"),
        ('type = "TF", num = [1], den = [1, -2]',
         "phi_22, TF: unstable: a pole at s = 2 rad/s"),
        ('type = "TF", num = [1], den = [1, 1, 4, 30]',
         "phi_22, TF: unstable: a pole at s = 1+3j rad/s"),
        ('type = "TF", num = [1], den = [1, 0, 4]',
         "phi_22, TF: undamped: poles at s = ±2j rad/s"),
        ('type = "SS", A = [[3]], B = [1], C = [1], D = 0',
         "phi_22, SS: unstable: a pole at s = 3 rad/s"),
        ('type = "TF", num = [1], den = [0]', "phi_22, TF: den is 0"),
        ('type = "TF", num = [1]', "phi_22: TF takes ['den', 'k', 'num'] or ['den', 'num'], not "
         "['num']"),
        ('type = "TF", num = ["q"], den = [1]',
         "phi_22.num: unknown parameter 'q'; known: ['T', 'k']"),
        ('type = "SS", A = [[-1, 0]], B = [1], C = [1], D = 0',
         "phi_22, SS: A has 1 rows, so that each of them, B and C must have 1 numbers"),
        ('type = "sum", k = 1', "phi_22: sum takes ['terms'] alone, not ['k']"),
        ('type = "P", k = 1, terms = [{ type = "P", k = 1 }]',
         "phi_22: terms belongs to sum, not to P"),
        ('type = "TF", num = [1], den = [1e-20, 1]',
         "phi_22, TF: den has a pole out of 1e-09 to 1e+09 rad/s"),
        ('type = "SS", A = [[-1e50, 1e-50], [1e50, -1e50]], B = [1, 1], C = [1, 1], D = 0',
         "phi_22, SS: its poles are too far apart for one element; split it"),
        ('type = "TF", num = [1e200], den = [1]',
         "phi_22, TF: num = 1e+200 must be from -1e+60 to 1e+60"),
    ],
)  # fmt: skip
def test_what_is_refused_has_one_line(cell, message):
    with pytest.raises(LawError) as problem:
        element(f"{{ {cell} }}")
    assert str(problem.value) == message


def test_many_products_end_soon():
    """Before their polynomials grow without end."""
    lags = ", ".join(f'{{ type = "O", k = 1, T = {{0}}.{k}, xi = 1 }}' for k in range(1, 9))
    products = ", ".join(f"[{lags.replace('{0}', str(k))}]" for k in range(1, 9))
    products = products.replace("{{", "{").replace("}}", "}")
    with pytest.raises(LawError, match="phi_22: its order is above 48"):
        element(f'{{ type = "sum", terms = [{products}] }}')


def test_a_search_sees_the_same_law_and_leaves_out_what_is_unstable():
    file = law_of('{ type = "TF", num = ["k"], den = [0.001, "T", 0.7, 1] }')
    T = np.array([0.2, 0.3, -0.1])
    many = realise_each(file, {"k": np.full(3, 0.03), "T": T})
    for i in (0, 1):
        one = realise(build_law(file, {"T": T[i]}))
        for s in (1j, 100j):
            inside = np.linalg.solve(s * np.eye(one.order) - many.A[i], many.B_r[i])
            ours = many.C[i] @ inside + many.D_r[i]
            np.testing.assert_allclose(ours, one(s)[0], rtol=1e-9, atol=1e-15)
    assert np.isnan(many.A[2]).all()


ODD = st.sampled_from([0.0, 1.0, -1.0, 1e-300, 1e59, -1e59, 1e-50, 3.5, -20.0, 1e-9, 1e9, 5e-324])


@pytest.mark.filterwarnings("error")
@given(num=st.lists(ODD, min_size=1, max_size=4), den=st.lists(ODD, min_size=1, max_size=5))
@repeatable
def test_absurd_fractions_make_a_law_or_a_message(num, den):
    try:
        record(f'{{ type = "TF", num = {num}, den = {den} }}')
    except LawError as problem:
        assert str(problem).count("phi_22") == 1 and "\n" not in str(problem)


@pytest.mark.filterwarnings("error")
@given(data=st.data(), n=st.integers(0, 3))
@repeatable
def test_absurd_state_spaces_make_a_law_or_a_message(data, n):
    vector = st.lists(ODD, min_size=n, max_size=n)
    A = data.draw(st.lists(vector, min_size=n, max_size=n))
    B, C, D = data.draw(vector), data.draw(vector), data.draw(ODD)
    try:
        record(f'{{ type = "SS", A = {A}, B = {B}, C = {C}, D = {D} }}')
    except LawError as problem:
        assert str(problem).count("phi_22") == 1 and "\n" not in str(problem)


@pytest.mark.parametrize("zeros", [(-1.0, -2.0, -3.0), (-1.0, -2.0, 1e-6), (-1e-3, -1e4, -1e4)])
def test_stability_is_that_of_the_zeros(zeros):
    assert stable(tuple(np.poly(zeros)[::-1])) == (max(zeros) < 0)
