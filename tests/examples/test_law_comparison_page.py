"""The page's tables match the shipped laws."""

from pathlib import Path

import numpy as np
import pytest

from gfm_design.model.closed_loop import LeastStable
from gfm_design.tuning.gains import free_gains
from gfm_design.tuning.paper import PaperProblem
from gfm_runtime import law_file, law_names, tuned_names
from law_comparison.row import LEFT_OUT, as_shipped
from law_comparison.search import ALPHA, LateProblem, as_it_is, gamma

TABLES = Path(__file__).resolve().parents[2] / "docs" / "tables"


def rows(name: str) -> dict[str, list[str]]:
    lines = (TABLES / f"{name}.md").read_text(encoding="utf-8").splitlines()[2:]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {row[0]: row[1:] for row in cells}


def test_every_law_has_a_row():
    rated, not_rated = set(rows("law_comparison_gamma")), set(rows("law_comparison_unstable"))
    assert rated | not_rated | set(LEFT_OUT) == set(law_names())
    assert not rated & not_rated
    searched = {name for name in rated if not as_shipped(name)}
    assert {f"{name}-tuned" for name in searched} == set(tuned_names())
    assert set(rows("law_comparison_loop")) == set(rows("law_comparison_bench")) == rated


@pytest.mark.parametrize("name", tuned_names())
def test_gamma_of_a_tuned_law_is_the_page_s(name):
    found = as_it_is(law_file(name))
    assert not isinstance(found.after, LeastStable)
    own, late = (rows("law_comparison_gamma")[name.removesuffix("-tuned")][k] for k in (2, 4))
    # at the operating point of the tuned gains, to the page's four digits
    assert float(late.strip("*")) == pytest.approx(gamma(found.after), rel=1e-3)
    assert own == "unstable" or float(own) >= 0.999 * gamma(found.after)


@pytest.mark.parametrize("name", tuned_names())
def test_a_tuned_law_holds_one_sample_late(name):
    file = law_file(name)
    problem = PaperProblem(file, free_gains(file))
    at = np.array([[g.start for g in problem.gains]])
    assert LateProblem(problem).sigma(at)[0] < -0.98 * ALPHA
