"""The box of real loops, and the gains that must be stable in it."""

from dataclasses import replace

import numpy as np
import pytest

from deployable.bench import step_run
from deployable.box import Box, Point, Source
from deployable.robust import Loops, RobustProblem, Wanted, paper_problem
from deployable.search import Round, deploy, steps
from gfm_design.margins.delays import overall_delay
from gfm_design.model.closed_loop import T_S
from gfm_design.model.linear import linearise_law, linearise_plant
from gfm_design.model.operating_point import operating_point
from gfm_design.tuning.gains import FreeGain, free_gains
from gfm_design.tuning.paper import PaperProblem
from gfm_design.tuning.synthesis import UNSTABLE
from gfm_plant import make_plant
from gfm_runtime import discretise, get_law, law_file

from ..support.loops import reference_loop

pytestmark = pytest.mark.full

LAW = "mimo-gfm-deployable"
CONTROLLED, RIG = Box(dc=("controlled",)), Box(dc=("regulated",))
RIG_LAW = "mimo-gfm-deployable-rig"
THIRD = (0.33, 1.0, 3.0)  # resistances for which it is tuned


def gains(law: str = LAW) -> tuple[FreeGain, ...]:
    return free_gains(law_file(law))


def start(law: str = LAW) -> np.ndarray:
    return np.array([g.start for g in gains(law)])


def sigma(points: list[Point], law: str = LAW) -> np.ndarray:
    return Loops(law_file(law), gains(law), points).sigma(start(law))


def delay_margin(law: str, dc: Source = "controlled") -> float:
    return overall_delay(Point(dc=dc).loop(law)).seconds


@pytest.mark.parametrize(
    "point",
    [
        Point(),
        Point(0.1, 3.0, 20.0, 5.0, 1.0),
        Point(3.0, 0.1, 0.8, 2.37, 0.0),
        Point(0.5, 0.5, 10.0, 1.5, 0.7, "regulated"),
    ],
)
def test_stack_is_the_sampled_loop(point):
    """An independent computation: the runtime discretises the law, support.py gives the matrix."""
    par = make_plant(point.plant(), T_S).par
    # the printed k_35 is k_34/D_q to four digits; a search ties it exactly
    law = discretise(get_law("mimo-gfm", k_35=1.0844 / 0.05), T_S)
    op = operating_point(par, law, point.references())
    linear = linearise_law(law.law, law, op, point.references(), point.dc == "controlled")
    loop = reference_loop(par, linearise_plant(par, op), linear)
    expected = np.log(np.abs(np.linalg.eigvals(loop)).max()) / T_S
    # with other points, so that stacks of several shapes must return it in its place
    found = sigma([Point(delay=3.0), point, Point(L_g=5.0)], "mimo-gfm")
    assert found[1] == pytest.approx(expected, abs=1e-5)


def test_overshoot_is_that_of_the_loop_stepped_tick_by_tick():
    point = Point(0.1, 1.0, 20.0, 5.0)
    par = make_plant(point.plant(), T_S).par
    law = discretise(get_law(LAW), T_S)
    op = operating_point(par, law, point.references())
    plant = linearise_plant(par, op)
    linear = linearise_law(law.law, law, op, point.references(), True)
    loop = reference_loop(par, plant, linear)
    n, m = len(plant.A), len(linear.A)
    x, by_ref = np.zeros(len(loop)), np.zeros(len(loop))
    by_ref[n : n + m], by_ref[n + m : n + m + 3] = linear.B_r[:, 1], linear.D_r[:, 1]
    p = np.empty(30000)
    for k in range(len(p)):
        p[k] = plant.C[1] @ x[:n]  # behind its sensor, which is 0.5 ms late
        x = loop @ x + by_ref
    found = Loops(law_file(LAW), gains(), [point]).overshoot(start())[0]
    assert found == pytest.approx(max(p.max() - 1.0, 0.0), abs=2e-3)


def test_corners_are_all_combinations_and_random_points_lie_inside():
    box = Box()
    assert len(box.corners()) == len(set(box.corners())) == 3 * 3 * 4 * 5 * 3 * 2
    inside = box.random(200, seed=3)
    assert inside == box.random(200, seed=3) != box.random(200, seed=4)
    for p in inside:
        assert 0.1 <= p.R_f <= 3.0 and 0.1 <= p.R_g <= 3.0 and 0.8 <= p.L_g <= 20.0
        assert 1.0 <= p.delay <= 5.0 and 0.0 <= p.P_ref <= 1.0


def test_gamma_and_delay_margin():
    channels = PaperProblem(law_file(LAW), gains()).channels(start())
    assert max(c.norm for c in channels) <= 1.5
    assert delay_margin(LAW) >= 1e-3


def test_every_corner_decays():
    assert sigma(CONTROLLED.corners()).max() <= -1.0
    assert sigma(RIG.corners()).max() < 0.0  # stable, but slower: see docs/deployable.md


def test_random_points_decay():
    assert sigma(CONTROLLED.random(250, seed=11)).max() <= -1.0
    assert sigma(RIG.random(100, seed=12)).max() < 0.0


def test_the_rigs_law_holds_beside_its_source():
    box = replace(RIG, R_f=THIRD, R_g=THIRD)
    assert sigma(box.corners(), RIG_LAW).max() <= -1.0
    assert sigma(box.random(100, seed=13), RIG_LAW).max() <= -1.0
    stepped = steps(box)
    beyond = Loops(law_file(RIG_LAW), gains(RIG_LAW), stepped).overshoot(start(RIG_LAW))
    assert max(o for p, o in zip(stepped, beyond, strict=True) if p.L_g <= 3.0) <= 0.05
    assert beyond.max() <= 0.20
    assert delay_margin(RIG_LAW, "regulated") >= 1e-3
    # its price: gamma, and chokes of a tenth of their resistance
    rig = paper_problem(law_file(RIG_LAW), gains(RIG_LAW), "regulated")
    assert 1.5 < max(c.norm for c in rig.channels(start(RIG_LAW))) <= 3.6
    assert sigma(RIG.corners(), RIG_LAW).max() > 0.0


def test_the_rigs_problem_is_that_of_row_1_in_its_source():
    """With only a PI in row 1, the source does the same as the law would."""
    only_pi = {"k_pdc": 90.0, "k_idc": 400.0, "k_12": 0.0, "k_14": 0.0, "k_15": 0.0}
    file = law_file("mimo-gfm")
    named = free_gains(file, only_pi)
    values = np.array([g.start for g in named])
    own, rig = (paper_problem(file, named, dc).channels(values) for dc in CONTROLLED.dc + RIG.dc)
    assert [c.norm for c in own] == pytest.approx([c.norm for c in rig], rel=1e-4)


def test_printed_gains_do_not_hold():
    assert sigma(CONTROLLED.corners(), "mimo-gfm").max() > 100.0


@pytest.mark.parametrize(
    ("point", "limit"),
    [
        (Point(0.1, 0.1, 0.8, 5.0), 0.05),
        (Point(3.0, 3.0, 3.0, 1.0), 0.05),
        (Point(0.1, 1.0, 20.0, 1.0), 0.20),
    ],
)
def test_nonlinear_step(point, limit):
    found = step_run(point, LAW)
    assert found.ended == ""
    assert found.overshoot <= limit


@pytest.mark.parametrize(
    ("point", "limit"),
    [
        (Point(1.0, 1.0, 0.8, 5.0, dc="regulated"), 0.05),
        (Point(3.0, 1.0, 3.0, 1.0, dc="regulated"), 0.05),
        (Point(0.33, 0.33, 20.0, 1.0, dc="regulated"), 0.20),
    ],
)
def test_nonlinear_step_beside_the_rigs_source(point, limit):
    found = step_run(point, RIG_LAW)
    assert found.ended == ""
    assert 0.0 < found.ripple < found.overshoot <= limit
    assert step_run(point, LAW).overshoot > 0.2  # the law for the other source


def test_nonlinear_bench_tells_a_trip():
    assert "over" in step_run(Point(0.1, 0.1, 0.8, 5.0), "mimo-gfm").ended


def test_search_tells_what_breaks_and_demands_all_of_the_rig_alone():
    box = Box((1.0,), (1.0,), (0.8, 20.0), (1.0, 5.0), (0.5,), ("regulated",))
    rows_2_3 = free_gains(law_file(RIG_LAW), only=["k_21", "k_22", "k_31"])
    hard = Wanted(gamma=np.inf, alpha=30.0, rig_alpha=None)
    told: list[Round] = []
    found = deploy(law_file(RIG_LAW), rows_2_3, box, hard, 1, 2, 64, 1, told.append)
    assert told[-1] is found
    assert found.slow == pytest.approx(found.sigma + 30.0) and found.slow > 0.0
    assert found.beyond >= found.overshoot - hard.weak
    assert hard.overshoot(Point(dc="regulated")) == hard.strong
    assert np.isinf(Wanted().overshoot(Point(dc="regulated")))


def test_cost_is_gamma_where_all_holds():
    paper = PaperProblem(law_file(LAW), gains())
    corner = [Point(0.1, 0.1, 20.0, 5.0)]
    easy = Wanted(gamma=2.0, alpha=1.0, strong=0.05, weak=0.2)
    assert RobustProblem(paper, corner, corner, easy)(start()) == pytest.approx(paper(start()))
    hard = Wanted(gamma=2.0, alpha=50.0)
    assert RobustProblem(paper, corner, corner, hard)(start()) > 100.0
    lost = start() * np.where([g.name == "k_21" for g in gains()], -5.0, 1.0)
    assert RobustProblem(paper, corner, corner, easy)(lost) >= UNSTABLE
