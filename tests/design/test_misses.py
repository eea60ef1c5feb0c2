"""What a loop bears of ticks without a new u, against closed forms and drawn runs."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gfm_design.margins.all_margins import UnstableLoop
from gfm_design.misses.sequences import Pieces, in_a_row, in_a_window
from gfm_design.misses.statistics import MeanSquare, MissChain, Misses, most_misses
from gfm_design.misses.ticks import MEANWHILE, Ticks, ticks
from gfm_design.misses.tolerance import latency_tolerance
from gfm_design.misses.words import Words
from gfm_design.model.closed_loop import ClosedLoop
from gfm_plant import Plant
from gfm_runtime.catalogue import get_law
from gfm_runtime.inner import VirtualStator

T_S = 1e-4
RIG = {
    "delay": {"samples": 1},
    "factors": {"R_f": 0.5, "R_g": 0.5},
    "dc_source": {"mode": "regulated"},
    "sensors": {"bandwidth_hz": 300.0},
}


@pytest.fixture(scope="module")
def ideal():
    return ClosedLoop.of("mimo-gfm")


@pytest.fixture(scope="module")
def rig():
    return ClosedLoop.of("mimo-gfm", Plant.model_validate(RIG))


def scalar(hit: float, miss: float) -> Ticks:
    one = np.ones((1, 1))
    return Ticks(hit * one, (miss * one,), np.ones(1), np.ones((5, 1)), T_S)


def planar(hit, miss) -> Ticks:
    return Ticks(np.array(hit), (np.array(miss),), np.ones(2), np.ones((5, 2)), T_S)


@pytest.mark.parametrize("case", MEANWHILE)
@pytest.mark.parametrize("on", ["ideal", "rig"])
def test_a_tick_without_a_miss_is_that_of_the_loop(case, on, request):
    loop = request.getfixturevalue(on)
    hit, A = ticks(loop, case).hit, loop.A
    assert np.allclose(hit[: len(A), : len(A)], A, rtol=1e-12, atol=1e-12)
    assert not hit[: len(A), len(A) :].any()  # the last u does not act in a hit


@pytest.mark.parametrize("case", MEANWHILE)
def test_a_miss_holds_u_and_what_stands_still_does(ideal, case):
    of = ticks(ideal, case)
    p, c = ideal.held, ideal.controller
    n, m = len(p.A), len(c.A)
    rng = np.random.default_rng(1)
    x, u = rng.normal(size=n + m), rng.normal(size=3)
    after = of.misses[0] @ np.concatenate([x, u])
    assert np.allclose(after[:n], p.A @ x[:n] + p.B @ u, rtol=1e-12)
    stepped = c.A @ x[n:] + c.B @ p.C @ x[:n]
    assert np.allclose(after[n:-3], x[n:] if case == "stands still" else stepped, rtol=1e-12)
    assert np.array_equal(after[-3:], u)


def test_what_continues_a_trend_meets_a_ramp(ideal):
    """u grows by b - a a tick, whatever x is; after ``extrapolate`` misses it is held."""
    of = ticks(ideal, "steps", extrapolate=2)
    x = np.zeros(len(of.hit))
    a, b = np.array([1.0, 2.0, 3.0]), np.array([1.5, 2.0, 2.0])
    x[-9:] = np.concatenate([b, b, a])
    seen = []
    for i in range(4):
        x = of.miss(i) @ x
        seen.append(x[-9:-6].copy())
    assert np.allclose(seen, [2 * b - a, 3 * b - 2 * a, 3 * b - 2 * a, 3 * b - 2 * a])


def test_words_of_a_loop_of_one_state():
    """hit 1/2, miss 3/2: n misses and one hit are unstable from 1.5^n / 2 > 1 on, n = 2."""
    words = Words(scalar(0.5, 1.5))
    assert words.first_unstable().misses == 2
    assert words.worst(2).hits == 1
    assert words.worst(2).sigma == pytest.approx(np.log(1.5**2 / 2) / (3 * T_S))


def test_the_bounds_enclose_a_published_joint_spectral_radius():
    """That of [[1,1],[0,1]] and its transpose is the golden ratio (Jungers, The Joint Spectral
    Radius, Springer 2009), here at half the size, so that the hit alone is stable."""
    a, b = 0.5 * np.array([[1.0, 1.0], [0.0, 1.0]]), 0.5 * np.array([[1.0, 0.0], [1.0, 1.0]])
    size = float(np.abs(np.linalg.eigvals(a @ b)).max()) ** 0.5
    assert size == pytest.approx((1 + 5**0.5) / 4)
    pieces = Pieces(np.array([a, b]), np.ones(2, int), np.log(size) / T_S, planar(a, b))
    bounds = pieces.bounds()
    assert bounds.lower <= np.log(size) / T_S <= bounds.upper
    # symmetric: the Euclidean norm is extremal
    assert bounds.upper == pytest.approx(bounds.lower, rel=0.06)
    assert bounds.stable


def test_of_one_state_the_bounds_are_exact():
    words = Words(scalar(0.5, 1.5))
    assert in_a_row(words, 1).bounds().stable
    assert in_a_row(words, 2).bounds().stable is False
    window = in_a_window(words.ticks, 3, 5)  # 1.5^3 / 2^2 < 1, though 2 in a row are not borne
    assert window.bounds().lower == pytest.approx(np.log(1.5**3 / 4) / (5 * T_S))
    assert window.proved()


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(0, 3), min_size=1, max_size=12))
def test_every_word_lies_below_the_bound(rig_pieces, row):
    """A word is a list of pieces "i misses, then a hit"."""
    pieces, upper = rig_pieces
    out, length = np.eye(len(pieces[0])), 0
    for i in row:
        out, length = pieces[i] @ out, length + i + 1
    sigma = np.log(np.abs(np.linalg.eigvals(out)).max()) / (length * T_S)
    assert sigma <= upper + 1e-6 * abs(upper)


@pytest.fixture(scope="module")
def rig_pieces(rig):
    found = in_a_row(Words(ticks(rig, "steps")), 3)
    upper = found.bounds().upper
    assert upper < 0.0
    return found.matrices, upper


def test_a_chain_fitted_to_what_it_drew():
    chain = MissChain(0.02, 0.6)
    misses = Misses.of(chain.drawn(400_000, 1, np.random.default_rng(3))[0])
    fitted = misses.chain()
    assert fitted.begins == pytest.approx(0.02, rel=0.05)
    assert fitted.continues == pytest.approx(0.6, rel=0.05)
    assert misses.misses / misses.ticks == pytest.approx(chain.share, rel=0.05)


def test_bursts_and_windows_of_a_sequence():
    where = [0, 1, 1, 0, 1, 0, 0, 0, 0, 0, 0, 0, 1]
    misses = Misses.of(where)
    assert misses.bursts == ((1, 2), (2, 1))
    assert (misses.ticks, misses.misses, misses.longest) == (13, 4, 2)
    assert (misses.most_in(3), misses.most_in(10), misses.most_in(99)) == (2, 3, 4)
    assert misses.mean_age == pytest.approx((1 + 2 + 1 + 1) / 13)
    none = Misses.of(np.zeros(9))
    assert none.chain() == MissChain(0.0, 0.0) and none.longest == 0


def test_mean_square_of_a_loop_of_one_state():
    """The map of the second moments is a matrix of two rows."""
    chain, a, b = MissChain(0.1, 0.5), 0.5, 1.3
    found = MeanSquare(scalar(a, b), chain)
    M = np.array([[0.9 * a * a, 0.5 * a * a], [0.1 * b * b, 0.5 * b * b]])
    assert found.sigma() == pytest.approx(np.log(max(np.linalg.eigvals(M).real)) / (2 * T_S))
    share = 0.1 / 0.6
    Q = np.linalg.solve(np.eye(2) - M, [1 - share, share])
    assert found.variance()[0] == pytest.approx(Q.sum())
    # it decays up to the share of misses at which M has an eigenvalue of 1
    limit = most_misses(scalar(a, 2.0), 0.2)
    begins = 0.8 * limit / (1 - limit)
    M = np.array([[(1 - begins) * 0.25, 0.8 * 0.25], [begins * 4.0, 0.2 * 4.0]])
    assert np.linalg.eigvals(M).real.max() == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("seed", range(20))
def test_the_mean_square_decays_as_the_eigenvalues_of_all_second_moments_say(seed, monkeypatch):
    """Those of whole matrices, symmetric or not."""
    rng = np.random.default_rng(seed)
    hit, miss = 0.5 * rng.normal(size=(2, 4, 4))
    b, on = rng.random(2)
    of = Ticks(hit, (miss,), np.ones(4), np.ones((5, 4)), T_S)
    A, B = np.kron(hit, hit), np.kron(miss, miss)
    moments = np.block([[(1 - b) * A, (1 - on) * A], [b * B, on * B]])
    size = np.abs(np.linalg.eigvals(moments)).max()
    found = MeanSquare(of, MissChain(b, on))
    assert found.stable == (size < 1.0)
    for few in (400, 0):  # all eigenvalues of the map, or the one that counts
        monkeypatch.setattr("gfm_design.misses.statistics._FEW", few)
        assert found.sigma() == pytest.approx(np.log(size) / (2 * T_S), rel=1e-9)


@pytest.mark.full
def test_mean_square_against_a_thousand_drawn_runs(ideal):
    """The variance of p under white noise of the grid's voltage, with one miss in twenty, after a
    second, within four standard deviations of the estimate."""
    of, chain, runs = ticks(ideal, "steps"), MissChain(0.05, 0.1), 1000
    expected = MeanSquare(of, chain).variance()[1]
    plain = MeanSquare(of, MissChain(0.0, 0.0)).variance()[1]
    assert expected > 1.02 * plain
    rng = np.random.default_rng(5)
    missed = chain.drawn(10_000, runs, rng)
    x, seen = np.zeros((runs, len(of.hit))), []
    hit, miss = of.hit.T.copy(), of.misses[0].T.copy()
    for k in range(missed.shape[1]):
        lost = missed[:, k]
        x[~lost], x[lost] = x[~lost] @ hit, x[lost] @ miss
        x += rng.normal(size=(runs, 1)) * of.noise
        if k >= 5_000 and k % 100 == 0:
            seen.append((x @ of.outputs[1]) ** 2)
    each = np.mean(seen, axis=0)
    assert abs(each.mean() - expected) < 4 * each.std() / np.sqrt(runs)


def test_what_the_ideal_loop_bears(ideal):
    """MIMO-GFM on the paper's converter without a delay: every other u may be missing, not two in a
    row; and the verdict follows."""
    shares = list[float]()
    found = latency_tolerance(ideal, progress=shares.append)
    assert shares == [0.25, 0.5, 0.75, 1.0]
    assert (found.bears, found.proved) == (1, 1)
    none = found.used(Misses.of(np.zeros(1000)))
    assert none.light == "green" and none.in_a_row == 0.0 and none.added["p"] == pytest.approx(1.0)
    seldom = np.zeros(1000, bool)
    seldom[[100, 500]] = True
    assert found.used(Misses.of(seldom)).light == "yellow"  # all of the one that is borne
    seldom[101] = True
    assert found.used(Misses.of(seldom)).light == "red"


def test_an_unstable_loop_bears_nothing():
    with pytest.raises(UnstableLoop):
        latency_tolerance(ClosedLoop.of("vsg-2", Plant.model_validate(RIG)))


@pytest.mark.parametrize("case", MEANWHILE)
def test_a_loop_with_an_inner_stage_has_ticks_too(case):
    law = replace(get_law("mimo-gfm-practical"), inner=VirtualStator())
    loop = ClosedLoop.of(law, Plant.model_validate({"delay": {"samples": 1}}))
    of = ticks(loop, case)
    assert np.allclose(of.hit[: len(loop.A), : len(loop.A)], loop.A, rtol=1e-12, atol=1e-12)
    words = [Words(of).worst(n).sigma for n in (1, 2)]
    assert all(np.isfinite(words))


def test_windows_contain_each_sequence_once():
    of = scalar(0.5, 1.5)
    found = in_a_window(of, 2, 5).matrices.ravel()
    expected = [1.5**n * 0.5 ** (5 - n) for n in range(3) for _ in combinations("12345", n)]
    assert np.allclose(np.sort(found), np.sort(expected))
