"""One law of the league: its search, the mode in its way, what its sampled loop stands."""

from __future__ import annotations

import numpy as np
import pytest

from gfm_design.gains import free_gains
from gfm_design.league import as_it_is, gamma, search, stands
from gfm_design.league_modes import Culprit, culprit
from gfm_design.paper_problem import PaperProblem
from gfm_runtime import law_file

SHORT = {"seed": 0, "evaluations": 320, "starts": 1}


def test_a_law_that_nothing_stabilises_names_the_mode_and_its_states() -> None:
    found = search(law_file("droop-1"), **SHORT)
    assert found.gains is None
    assert isinstance(found.before, Culprit)
    assert isinstance(found.after, Culprit)
    assert found.after.mode.sigma > 0.0
    assert found.after.mode.frequency_hz == pytest.approx(50.7, abs=0.5)
    assert {name for name, _ in found.after.states} == {"i_d", "i_q", "i_od", "i_oq"}
    assert "50.7" in found.after.words()


def test_participation_is_how_far_the_mode_moves_with_a_state() -> None:
    # p_k = d lambda / d A_kk, the definition by sensitivity
    file = law_file("droop-1")
    problem = PaperProblem(file, free_gains(file))
    values = np.array([g.start for g in problem.gains])
    found = culprit(problem, values)
    A = problem.loop(values)[0]
    target = found.mode.sigma + 2j * np.pi * found.mode.frequency_hz
    moved = []
    for k in range(len(A)):
        nudged = A.copy()
        nudged[k, k] += 1e-4
        s = np.linalg.eigvals(nudged)
        moved.append(abs(s[np.argmin(abs(s - target))] - target) / 1e-4)
    shares = np.sort(np.array(moved) / np.sum(moved))[::-1]
    np.testing.assert_allclose([share for _, share in found.states], shares[:4], rtol=1e-3)


def test_gains_that_cannot_change_the_droop_are_chosen_for_the_rest() -> None:
    found = search(law_file("droop-2"), **SHORT)
    assert found.droop_fixed
    assert not isinstance(found.before, Culprit)
    assert not isinstance(found.after, Culprit)
    before, after = ({(c.i, c.j): c.norm for c in cs} for cs in (found.before, found.after))
    assert after[4, 1] == pytest.approx(before[4, 1], rel=1e-6)
    assert max(after[c] for c in after if c != (4, 1)) < max(
        before[c] for c in before if c != (4, 1)
    )


def test_a_law_as_it_is() -> None:
    found = as_it_is(law_file("mimo-gfm"))
    assert not isinstance(found.after, Culprit)
    assert gamma(found.after) == pytest.approx(2.0209, rel=5e-5)
    assert found.gains is not None
    assert found.gains["k_pdc"] == law_file("mimo-gfm").parameters["k_pdc"].value


def test_what_a_loop_stands() -> None:
    found = stands(law_file("vsg-2"), {})
    assert found.order == 3
    assert found.sigma < 0.0
    assert found.delay is not None
    assert 1e6 * found.delay.seconds == pytest.approx(1014, abs=2)  # as `design margins` says
    assert found.L_g is not None and not found.L_g.low.bounded
    assert found.R is not None and found.R.low.factor == pytest.approx(0.904, abs=0.01)


def test_a_loop_that_one_sample_is_too_much_for() -> None:
    found = stands(law_file("mimo-gfm"), {})  # as printed: its LC mode is lost after 52 us
    assert found.sigma > 0.0
    assert found.worst.ratio < 0.0
    assert found.L_g is None
    assert found.delay is not None
    assert 1e6 * found.delay.seconds == pytest.approx(52, abs=1)
