"""The fast estimate and the polish against the guaranteed norm."""

import numpy as np
import pytest

from gfm_design.model.closed_loop import least_stable
from gfm_design.norms.peaks import model, peaks
from gfm_design.norms.performance import StateSpace
from gfm_design.tuning.gains import Encoding, free_gains
from gfm_design.tuning.paper import PaperProblem, polish
from gfm_design.tuning.synthesis import UNSTABLE
from gfm_runtime import law_file

FILE = law_file("mimo-gfm")
GAINS = free_gains(FILE)
PRINTED = np.array([g.start for g in GAINS])
PROBLEM = PaperProblem(FILE, GAINS)


def gamma(values: np.ndarray) -> float:
    return max(c.norm for c in PROBLEM.channels(values))


def test_close_below_the_norm():
    random = np.random.default_rng(0)
    values = PRINTED * (1 + 0.05 * random.normal(size=(12, len(PRINTED))))
    costs = PROBLEM.many(values)
    stable = costs < UNSTABLE
    assert stable.sum() > 5
    for row, cost in zip(values[stable], costs[stable], strict=True):
        norm = gamma(row)
        assert 0.97 * norm <= cost <= norm * (1 + 1e-9)
    for row, cost in zip(values, costs, strict=True):
        assert PROBLEM(row) == pytest.approx(cost, rel=1e-12)


def test_unstable_points_are_ranked_by_their_growth():
    values = np.repeat(PRINTED[None], 3, axis=0)
    values[:, [g.name for g in GAINS].index("k_34")] = (50.0, 70.0, 90.0)
    costs = PROBLEM.many(values)
    assert (costs > UNSTABLE).all()
    assert np.argmax(costs) == np.argmax(
        [least_stable(PROBLEM.closed_loop(v)).mode.sigma for v in values]
    )


def test_slopes_of_peaks_against_differences():
    code = Encoding(GAINS)
    at, h = code.start, 1e-5

    def highest(x: np.ndarray) -> float:
        return gamma(code.values(x))

    def loops(x: np.ndarray) -> StateSpace:
        return PROBLEM.loops(code.values(x))

    found = peaks(loops(at), PROBLEM.weights)
    assert found is not None
    nearby = model(loops, PROBLEM.weights, at, found)
    assert found.height[0] == pytest.approx(highest(at), rel=1e-6)
    assert nearby.base[0] == pytest.approx(1 / highest(at), rel=1e-6)
    for k in range(len(at)):
        e = np.eye(len(at))[k] * h
        slope = (1 / highest(at + e) - 1 / highest(at - e)) / (2 * h)
        assert nearby.slope[0, k] == pytest.approx(slope, rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("law", ["mimo-gfm", "vsg-12"])
def test_curvature_of_peaks(law):
    """A peak moves in frequency: its model is compared with peaks found by search."""
    gains = free_gains(law_file(law))
    problem, code = PaperProblem(law_file(law), gains), Encoding(gains)

    def loops(x: np.ndarray) -> StateSpace:
        return problem.loops(code.values(x))

    at = problem.polish(code, code.start)  # where several peaks are equal
    found = peaks(loops(at), problem.weights)
    assert found is not None
    nearby = model(loops, problem.weights, at, found)
    steepest = np.abs(nearby.slope).max(axis=0)
    random = np.random.default_rng(0)
    for _ in range(5):
        step = 0.01 * random.normal(size=len(at)) / (1 + 10 * steepest)
        there = peaks(loops(at + step), problem.weights)
        assert there is not None
        true = 1 / there.height[0]
        curved, flat = nearby(step).min(), (nearby.base + nearby.slope @ step).min()
        assert abs(curved - true) < 0.1 * abs(flat - true) + 1e-8


def test_polish_lowers_gamma_within_the_bounds():
    code = Encoding(GAINS)
    found = polish(
        lambda x: PROBLEM.loops(code.values(x)), PROBLEM.weights, code.start, code.low, code.high
    )
    assert ((found >= code.low) & (found <= code.high)).all()
    assert gamma(code.values(found)) < 1.45  # from 2.02
