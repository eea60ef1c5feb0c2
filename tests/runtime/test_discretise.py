"""Tustin's discretisation and the kernel against SciPy, and the checks that reject a law."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy import signal
from scipy.integrate import solve_ivp

from gfm_runtime import BuiltLaw, LawError, Limits, discretise, get_law, pack_law, realise
from gfm_runtime.elements import IF, INTEGRATOR, PI, Element, I, O, P
from gfm_runtime.kernel import N_MAX
from gfm_runtime.signals import NU, NY

from ..support.laws import LAWS, REF, Running, Vector, blocks, mapped, repeatable, u_0, wander

T_S = 1e-4


def scipy_bilinear(law: BuiltLaw, refs: Vector, ys: Vector, T_s: float) -> Vector:
    """The law's response by SciPy: loop closed in continuous time, cont2discrete, dlsim."""
    b = blocks(law)
    w = np.array(
        [np.concatenate([*mapped(law, r, y), u_0(law, r)]) for r, y in zip(refs, ys, strict=True)]
    )
    if not len(b.A):
        return w @ b.D.T
    system = signal.cont2discrete((b.A, b.B, b.C, b.D), T_s, method="bilinear")
    return np.asarray(signal.dlsim(system, w)[1])


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("T_s", [T_S, 1e-3])
def test_kernel_is_scipys_bilinear(name, T_s):
    law = LAWS[name]
    refs, ys = wander(400)
    ours = Running.of(discretise(law, T_s)).unlimited().run(refs, ys)
    theirs = scipy_bilinear(law, refs, ys, T_s)
    size = np.abs(theirs).max(axis=0)
    assert np.max(np.abs(ours - theirs) / size) < 1e-12


@pytest.mark.parametrize("phi_23", [P(0.7), P(-0.7), I(0.05), PI(0.3, 0.1), O(2.0, 0.01, 0.2)])
def test_omega_u_loop_of_any_kind(phi_23):
    """Column 3 in all rows, with and without direct feed-through."""
    cells = {(0, 0): PI(9.0, 0.2), (0, 2): P(2.0), (1, 1): IF(0.01, 0.1), (1, 2): phi_23}
    law = BuiltLaw("loop", "", "", {**cells, (2, 2): O(0.1, 0.02, 0.5), (2, 4): I(0.5)})
    refs, ys = wander(300, seed=3)
    ours = Running.of(discretise(law, T_S)).unlimited().run(refs, ys)
    theirs = scipy_bilinear(law, refs, ys, T_S)
    np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("name", LAWS)
def test_closed_matrices_are_what_the_kernel_does(name):
    law = LAWS[name]
    discrete = discretise(law, T_S)
    A, B_r, B_y, C, D_r, D_y = discrete.closed()
    assert not B_y[:, 2].any() and not D_y[:, 2].any()
    loop = Running.of(discrete).unlimited()
    x = np.zeros(discrete.order)
    for ref, y in zip(*wander(50, seed=2), strict=True):
        r, m = mapped(law, ref, y)
        # u_0, which is added to omega_u from outside, passes through the closed loop as well
        gain = 1.0 / (1.0 - discrete.D_y[1, 2])
        extra = u_0(law, ref) + discrete.D_y[:, 2] * gain * u_0(law, ref)[1]
        u = extra + C @ x + D_r @ r + D_y @ m
        x = A @ x + B_r @ r + B_y @ m + discrete.B_y[:, 2] * gain * u_0(law, ref)[1]
        np.testing.assert_allclose(loop.step(ref, y), u, rtol=1e-12, atol=1e-12)


def smooth(t: float) -> tuple[Vector, Vector]:
    """Smooth references and measurements that start in equilibrium."""
    ref = REF + 0.02 * np.sin(np.array([30.0, 50.0, 20.0, 40.0, 60.0]) * t)
    return ref, REF + 0.03 * np.sin(np.array([45.0, 70.0, 0.0, 25.0, 55.0]) * t)


def error_at(law: BuiltLaw, T_s: float, t_end: float) -> Vector:
    """Largest distance of the kernel's u from the continuous law's, per element of u."""
    b = blocks(law)

    def w(t: float) -> Vector:
        ref, y = smooth(t)
        return np.concatenate([*mapped(law, ref, y), u_0(law, ref)])

    t = np.arange(round(t_end / T_s)) * T_s
    exact = np.array([b.D @ w(s) for s in t])
    if len(b.A):
        found = solve_ivp(
            lambda s, x: b.A @ x + b.B @ w(s),
            (0.0, t[-1]),
            np.zeros(len(b.A)),
            method="DOP853",
            t_eval=t,
            rtol=1e-12,
            atol=1e-14,
        )
        exact += found.y.T @ b.C.T
    discrete = discretise(law, T_s)
    loop = Running.of(discrete).unlimited()
    # The continuous law starts at x = 0; the same start in the coordinates of the discrete one.
    r, y = mapped(law, *smooth(0.0))
    y[2] = exact[0, 1]
    ss = realise(law)
    loop.state["x"][0, : ss.order] = -T_s / 2 * (ss.B_r @ r + ss.B_y @ y)
    ours = loop.run(*map(np.array, zip(*map(smooth, t), strict=True)))
    return np.asarray(np.max(np.abs(ours - exact), axis=0))


@pytest.mark.parametrize("name", LAWS)
def test_error_falls_as_T_s_squared(name):
    law = LAWS[name]
    errors = np.array([error_at(law, T_s, 0.08) for T_s in (8e-4, 4e-4, 2e-4)])
    rows = set(realise(law).rows)
    rows |= {i for i in (0, 2) if 1 in rows and not law.element("phi", (i, 2)).is_zero}
    for i in range(NU):
        if i in rows:
            ratios = errors[:-1, i] / errors[1:, i]
            np.testing.assert_allclose(ratios, 4.0, rtol=0.08, err_msg=f"row {i + 1}")
        else:
            assert errors[:, i].max() < 1e-13, f"row {i + 1} has no states, so no error"


@pytest.mark.parametrize("T_s", [0.0, -1e-4, math.nan, math.inf])
def test_sampling_time(T_s):
    with pytest.raises(LawError, match=r"T_s: .* must be > 0"):
        discretise(get_law("vsg-2"), T_s)


def law_of(**cells: Element) -> BuiltLaw:
    """A law from cells by name, e.g. phi_22."""
    grids: dict[str, dict[tuple[int, int], Element]] = {"phi": {}, "psi": {}}
    for name, element in cells.items():
        matrix, cell = name.split("_")
        grids[matrix][int(cell[0]) - 1, int(cell[1]) - 1] = element
    return BuiltLaw("a", "", "", grids["phi"], grids["psi"])


@pytest.mark.parametrize(
    ("cells", "says"),
    [
        ({"phi_23": P(-1.0)}, "phi_23: the omega_u loop gain 1 must be < 1"),
        ({"phi_23": PI(-2.0, 1.0)}, "phi_23: the omega_u loop gain 2"),
        ({"psi_23": P(-1.5)}, "psi_23: the omega_u loop gain 1.5"),
        ({"phi_23": P(-1.0), "psi_23": P(-1.0)}, "phi_23 and psi_23: the omega_u loop gain 2"),
        ({"phi_23": IF(-2.0, 0.1)}, "phi_23: unstable at T_s = 0.0001 s, spectral radius 1.001"),
        ({"phi_23": I(1.0) * P(-1.0)}, "phi_23: unstable"),
        ({"phi_22": I(1.0), "phi_33": I(1.0)}, "phi_33: integrates omega_u, itself an integral"),
        ({"psi_25": I(1.0), "psi_13": PI(1.0, 1.0)}, "psi_13: integrates omega_u"),
    ],
)
def test_loops_without_a_stable_solution(cells, says):
    with pytest.raises(LawError) as caught:
        discretise(law_of(**cells), T_S)
    assert says in str(caught.value)


def test_integrators_that_only_look_in_series():
    """phi_23's integrator closes its own loop, so omega_u is not an integral."""
    discretise(law_of(phi_22=I(1.0), phi_23=I(1.0), phi_33=I(1.0)), T_S)
    discretise(law_of(phi_22=I(1.0), phi_34=I(1.0), phi_11=I(1.0)), T_S)
    discretise(law_of(phi_22=IF(1.0, 1.0), phi_33=I(1.0)), T_S)


def test_slow_fast_and_repeated_poles_pass():
    three = IF(1.0, 10.0) * IF(1.0, 10.0) * IF(1.0, 10.0)
    discretise(law_of(phi_22=three, phi_34=I(1.0) * three), T_S)
    discretise(law_of(phi_22=IF(1.0, 1e-9), phi_34=IF(1.0, 1e6), phi_11=I(1e6)), T_S)
    discretise(law_of(phi_22=I(1.0) * O(1.0, 0.03, 1.0), phi_11=O(1.0, 1.0, 0.001)), T_S)


def test_coefficients_that_are_not_finite():
    huge = Element((1e300,), ((1.0, 1e-9),))
    with pytest.raises(LawError, match=r"^phi_22: together they give .* not finite"):
        discretise(law_of(phi_22=huge), T_S)
    with pytest.raises(LawError, match=r"^phi_34: B_r is not finite in float32"):
        pack_law(discretise(law_of(phi_34=Element((1e45,), (INTEGRATOR,))), T_S), np.float32)


def test_too_many_states_for_the_kernel():
    cells = {(0, j): IF(1.0, 0.1 + j) * O(1.0, 0.2 + j, 0.5) for j in range(NY)}
    with pytest.raises(LawError, match=r"a: 15 states; the kernel holds 12"):
        pack_law(discretise(BuiltLaw("a", "", "", cells), T_S))


gains = st.floats(-20.0, 20.0).map(lambda k: round(k, 3))
times = st.floats(1e-4, 10.0)
proper = st.one_of(
    st.builds(P, gains),
    st.builds(PI, gains, times),
    st.builds(IF, gains, times),
    st.builds(O, gains, times, st.floats(0.05, 2.0)),
    st.builds(lambda a, b, c: IF(a, b) * IF(1.0, c), gains, times, times),
)
where = st.tuples(st.integers(0, NU - 1), st.sampled_from([0, 1, 3, 4]))


@repeatable
@given(st.dictionaries(where, proper, max_size=4), st.dictionaries(where, proper, max_size=2))
def test_any_stable_law_is_scipys_bilinear(phi, psi):
    law = BuiltLaw("any", "", "", phi, psi)
    refs, ys = wander(60, seed=5)
    discrete = discretise(law, 1e-3)
    assume(discrete.order <= N_MAX)
    ours = Running.of(discrete).unlimited().run(refs, ys)
    theirs = scipy_bilinear(law, refs, ys, 1e-3)
    size = 1.0 + sum(abs(c) for e in (*phi.values(), *psi.values()) for c in e.num)
    assert np.max(np.abs(ours - theirs)) < 1e-10 * size


def test_anti_windup_is_never_faster_than_a_tick():
    """T_t below T_s: the state follows the limit at once, and does not overshoot."""
    law = BuiltLaw("a", "", "", {(0, 0): PI(1.0, 1.0)}, limits=Limits(T_t=1e-6))
    discrete = discretise(law, T_S)
    assert discrete.C @ discrete.W[:, [0]] == pytest.approx(np.array([[1.0], [0.0], [0.0]]))
