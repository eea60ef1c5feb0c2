"""Free gains: valid choices, ties, and laws affine in them."""

import numpy as np
import pytest

from gfm_design.tuning.gains import Encoding, FreeGain, free_gains
from gfm_design.tuning.paper import PaperProblem
from gfm_design.tuning.synthesis import UNSTABLE
from gfm_runtime import LawError, law_file
from gfm_runtime.lawfile import parse_law, tied

from ..support.files import text_of
from ..support.laws import every_law


def test_ties_follow():
    assert tied(law_file("mimo-gfm"), {"k_34": 2.0})["k_35"] == pytest.approx(40.0)


@pytest.mark.parametrize(
    ("start", "only", "words"),
    [
        ({"k_99": 1.0}, None, "k_99"),
        ({"D_p": 1.0}, None, "D_p"),
        ({"k_22": 1e9}, None, "outside"),
        (None, ["nothing"], "nothing"),
        ({"k_22": 5.0}, ["k_34"], "not among those to move"),
    ],
)
def test_gains_that_cannot_be(start, only, words):
    with pytest.raises(LawError, match=words):
        free_gains(law_file("mimo-gfm"), start, only)


@pytest.mark.parametrize("law", every_law())
def test_every_law_declares_its_gains(law):
    file = law_file(law)
    assert free_gains(file)  # its defaults lie within its own bounds
    assert not {"D_p", "D_q", "R", "X"} & {n for n, p in file.parameters.items() if p.free}


@pytest.mark.parametrize("law", every_law())
def test_a_law_as_a_function_of_its_gains(law):
    """Many at once against one at a time from the file, by T(s)."""
    gains = free_gains(law_file(law))
    problem = PaperProblem(law_file(law), gains)
    code = Encoding(gains)
    random = np.random.default_rng(1)
    points = code.start + 0.3 * random.normal(size=(3, len(gains)))
    values = code.values(np.vstack([code.start, points]))
    quick = [*zip(*problem.loops(values), strict=True)]
    assert len(quick) == len(values)
    for row, loop in zip(values, quick, strict=True):
        for s in 1j * np.logspace(-1, 4, 12):
            exact, many = (
                C @ np.linalg.solve(s * np.eye(len(A)) - A, B.astype(complex)) + D
                for A, B, C, D in (problem.closed_loop(row).performance(), loop)
            )
            np.testing.assert_allclose(many, exact, rtol=1e-9, atol=1e-9 * np.abs(exact).max())


@pytest.mark.parametrize(("law", "affine"), [("mimo-gfm", True), ("vsg-11", False)])
def test_affine_or_not(law, affine):
    gains = free_gains(law_file(law))
    assert PaperProblem(law_file(law), gains).law.is_affine is affine


OWN = text_of("own_law.toml")


@pytest.mark.parametrize("bounds", ["[5.0, 1.0]", "[1.0, 1.0]", "[nan, 5.0]", "[0.1, inf]"])
def test_bounds_that_are_none(bounds):
    with pytest.raises(LawError, match="must be finite and ascending"):
        free_gains(parse_law(OWN.replace("[-5.0, 5.0]", bounds)))


def test_gains_in_the_error_map_cancelling_factors_and_gains_that_make_no_law():
    file = parse_law(OWN)
    problem = PaperProblem(file, free_gains(file))
    values = np.array([[0.02, 0.004, 2.0], [0.05, 0.006, -1.0], [0.05, 0.02, 1.0]])
    A, B, C, D = problem.loops(values)
    for k in (0, 1):
        a, b, c, d = problem.closed_loop(values[k]).performance()
        assert len(a) == A.shape[1]
        exact = c @ np.linalg.solve(10j * np.eye(len(a)) - a, b.astype(complex)) + d
        many = C[k] @ np.linalg.solve(10j * np.eye(len(a)) - A[k], B[k].astype(complex)) + D[k]
        np.testing.assert_allclose(many, exact, rtol=1e-9, atol=1e-12)
    with pytest.raises(LawError, match=r"T = -0\.01"):
        problem.closed_loop(values[2])  # T_f = -0.01 s
    assert np.isnan(A[2]).any()
    assert problem(values[2]) > UNSTABLE


def test_coordinates():
    gains = (FreeGain("a", 2.0, 0.1, 100.0), FreeGain("b", -0.3, -10.0, 10.0))
    code = Encoding(gains)
    np.testing.assert_allclose(code.values(code.start), [2.0, -0.3])
    np.testing.assert_allclose(code.values(code.low), [0.1, -10.0])
    np.testing.assert_allclose(code.values(code.high + 5.0), [100.0, 10.0])
    many = code.values(np.array([code.start, code.low - 1e6]))
    np.testing.assert_allclose(many, [[2.0, -0.3], [0.1, -10.0]])
