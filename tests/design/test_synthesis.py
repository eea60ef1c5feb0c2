"""The search: known optima, the paper's gains, bounds, seeds, and none to be found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from gfm_design.encoding import Encoding
from gfm_design.gains import FreeGain, free_gains
from gfm_design.paper_problem import PAPER_START, PaperProblem
from gfm_design.synthesis import UNSTABLE, NotStabilised, tune, unstable_cost
from gfm_runtime import law_file

pytest.importorskip("cma")


@dataclass
class Valley:
    """Least at a known place, with a kink there; of no use where a > 5."""

    least: tuple[float, ...]

    def __call__(self, values: np.ndarray) -> float:
        return float(self.many(values[None])[0])

    def many(self, values: np.ndarray) -> np.ndarray:
        cost = 1.0 + np.abs(np.log(values / np.array(self.least))).sum(axis=1)
        return np.where(values[:, 0] > 5.0, unstable_cost(values[:, 0]), cost)

    def polish(self, code: Encoding, point: np.ndarray) -> np.ndarray:
        return point


def gains(n: int, start: float = 1.0) -> list[FreeGain]:
    return [FreeGain(f"k_{k}", start, 0.1, 100.0) for k in range(n)]


@pytest.mark.parametrize("start", [1.0, 50.0])  # 50: no use at first
@pytest.mark.parametrize("n", [1, 3])
def test_reaches_a_known_optimum(n: int, start: float) -> None:
    least = (2.0, 30.0, 0.3)[:n]
    found = tune(Valley(least), gains(n, start), evaluations=6000, starts=1)
    np.testing.assert_allclose(found.values, least, rtol=1e-3)


def test_a_least_beyond_a_bound_stops_there() -> None:
    found = tune(Valley((0.01,)), gains(1), evaluations=2000, starts=1)
    assert found.values[0] == pytest.approx(0.1, rel=1e-3)
    assert found.values[0] >= 0.1


def test_none_to_be_found() -> None:
    fixed = [FreeGain("k_0", 50.0, 10.0, 100.0)]
    with pytest.raises(NotStabilised, match="10 1/s") as none:
        tune(Valley((20.0,)), fixed, evaluations=1000, starts=1)
    assert none.value.values[0] == pytest.approx(10.0, rel=1e-3)


def paper(law: str, seed: int, **options: int) -> tuple[float, np.ndarray]:
    file = law_file(law)
    free = free_gains(file, PAPER_START.get(law))
    problem = PaperProblem(file, free)
    found = tune(problem, free, seed, **options)
    assert all(g.low <= v <= g.high for g, v in zip(free, found.values, strict=True))
    return max(c.norm for c in problem.channels(found.values)), found.values


def test_mimo_gfm_from_the_papers_start() -> None:
    gamma, _ = paper("mimo-gfm", 2, starts=1)
    assert gamma <= 1.43  # the printed gains: 2.02


def test_vsg_2_is_no_worse_than_printed() -> None:
    gamma, values = paper("vsg-2", 0, starts=1)
    assert gamma <= 15.975
    assert values == pytest.approx([5.9801, 1.9048], rel=1e-3)  # the printed gains


def test_the_same_for_a_seed() -> None:
    once, again = (paper("vsg-2", 3, starts=2, evaluations=500)[1] for _ in range(2))
    np.testing.assert_array_equal(once, again)


def test_unstable_start_is_stabilised_first() -> None:
    file = law_file("vsg-2")
    free = free_gains(file, {"k_34": 50.0})
    problem = PaperProblem(file, free)
    assert problem(np.array([g.start for g in free])) > UNSTABLE
    assert tune(problem, free, starts=1, evaluations=3000).cost < 16.0
