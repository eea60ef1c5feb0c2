"""Free gains: what may be asked for, ties, and laws affine in them."""

from __future__ import annotations

import numpy as np
import pytest

from gfm_design.encoding import Encoding
from gfm_design.gains import FreeGain, free_gains, tied
from gfm_design.paper_problem import PaperProblem
from gfm_runtime import LawError, law_file, law_names


def test_ties_follow() -> None:
    assert tied(law_file("mimo-gfm"), {"k_34": 2.0})["k_35"] == pytest.approx(40.0)


@pytest.mark.parametrize(
    ("start", "only", "words"),
    [
        ({"k_99": 1.0}, None, "k_99"),
        ({"D_p": 1.0}, None, "D_p"),
        ({"k_22": 1e9}, None, "outside"),
        (None, ["nothing"], "nothing"),
    ],
)
def test_gains_that_cannot_be(
    start: dict[str, float] | None, only: list[str] | None, words: str
) -> None:
    with pytest.raises(LawError, match=words):
        free_gains(law_file("mimo-gfm"), start, only)


@pytest.mark.parametrize("law", law_names())
def test_every_law_declares_its_gains(law: str) -> None:
    file = law_file(law)
    assert free_gains(file)  # its defaults lie within its own bounds
    assert not {"D_p", "D_q", "R", "X"} & {n for n, p in file.parameters.items() if p.free}


@pytest.mark.parametrize(("law", "affine"), [("mimo-gfm", True), ("vsg-11", False)])
def test_a_law_as_a_function_of_its_gains(law: str, affine: bool) -> None:
    gains = free_gains(law_file(law))
    problem = PaperProblem(law_file(law), gains)
    assert problem.law.is_affine is affine
    values = np.array([g.start for g in gains]) * 1.1
    built, quick = problem.law._build(values), problem.law(values)
    for name in "ABCD":
        np.testing.assert_allclose(getattr(quick, name), getattr(built, name), atol=1e-9)


def test_coordinates() -> None:
    gains = (FreeGain("a", 2.0, 0.1, 100.0), FreeGain("b", -0.3, -10.0, 10.0))
    code = Encoding(gains)
    np.testing.assert_allclose(code.values(code.start), [2.0, -0.3])
    np.testing.assert_allclose(code.values(code.low), [0.1, -10.0])
    np.testing.assert_allclose(code.values(code.high + 5.0), [100.0, 10.0])
    many = code.values(np.array([code.start, code.low - 1e6]))
    np.testing.assert_allclose(many, [[2.0, -0.3], [0.1, -10.0]])
