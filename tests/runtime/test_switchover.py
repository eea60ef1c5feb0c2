"""A change of law: no bump, the trend continues, the remaining difference decays."""

from dataclasses import replace

import numpy as np
import pytest

from gfm_runtime import BuiltLaw, DiscreteLaw, Limits, change_law, discretise, get_law
from gfm_runtime.elements import IF, PD, PI, Element, I, P
from gfm_runtime.signals import NU

from ..support.laws import LAWS, REF, Running, Vector, slow_but, u_0, wander

T_S = 1e-4
DISCRETE = {name: discretise(law, T_S) for name, law in LAWS.items()}


def running(name: str, seed: int, real: type = np.float64) -> Running:
    """A law that has run for 20 ms on measurements near the operating point."""
    loop = Running.of(DISCRETE[name], real)
    loop.state["u"] = u_0(LAWS[name], REF)
    loop.run(*wander(200, seed=seed, size=0.004))
    return loop


def change(
    old: Running, new: DiscreteLaw, ref: Vector, y: Vector, real: type = np.float64
) -> tuple[Running, Vector, float]:
    """The new law running, u at the change, and the bump."""
    after, u = Running.of(new, real), np.zeros(NU)
    bump = change_law(old.law[0], old.state[0], after.law[0], after.state[0], ref, y, u)
    return after, u, float(bump)


@pytest.mark.parametrize("old", slow_but(("mimo-gfm", "vsg-2", "dvoc"), LAWS))
def test_no_bump_from_any_law_to_any_other(old):
    """At the tick of change the new law's u equals the old law's."""
    for k, new in enumerate(LAWS):
        before = running(old, seed=k)
        ref, y = (a[0] for a in wander(1, seed=100 + k, size=0.004))
        after, u, bump = change(before, DISCRETE[new], ref, y)
        expected = before.step(ref, y)
        limits = LAWS[new].limits
        assert np.all(expected > limits.low) and np.all(expected < limits.high), "a fair test"
        assert bump <= 1e-12, f"to {new}"
        np.testing.assert_allclose(u, expected, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(after.step(ref, y), u)


def test_float32_bump_is_rounding():
    for k, new in enumerate(LAWS):
        before = running("vsg-12", k, np.float32)
        _, _, bump = change(before, DISCRETE[new], REF, REF + 0.003, np.float32)
        law = DISCRETE[new]
        gain = float((np.abs(law.D_r) + np.abs(law.D_y)).sum(axis=1).max())
        assert bump <= max(2e-6, 0.25 * np.finfo(np.float32).eps * gain), new


def test_float32_states_are_those_of_float64():
    """The maps must not lose the state in rounding, as they would from u[k] and u[k+1]."""
    for name in ("vsg-7", "vsg-10", "vsg-12"):
        states = []
        for real in (np.float64, np.float32):
            before = running("vsg-2", 3, real)
            after, _, _ = change(before, DISCRETE[name], REF, REF + 0.003, real)
            states.append(after.state["x"][0])
        np.testing.assert_allclose(states[1], states[0], rtol=2e-3, atol=1e-5)


WITH_TREND = {
    "vsg-7": (1,), "vsg-10": (1,), "vsg-11": (1,), "vsg-12": (1,),
}  # fmt: skip


@pytest.mark.parametrize("name", WITH_TREND)
def test_trend_is_carried_by_rows_with_two_states(name):
    """With constant inputs, u continues its trend."""
    before = running("vsg-2", seed=0)
    ref = y = REF.copy()
    for k in range(3000):  # a steady ramp of p makes a steady ramp of omega_u
        u_before = before.step(ref, y - [0.0, 1e-4 * k, 0.0, 0.0, 0.0])
    y = y - [0.0, 0.3, 0.0, 0.0, 0.0]
    trend = before.state["trend"][0].copy()
    assert abs(trend[1]) > 1e-7
    after, u, bump = change(before, DISCRETE[name], ref, y)
    assert bump <= 1e-12
    first, second = after.step(ref, y), after.step(ref, y)
    np.testing.assert_array_equal(first, u)
    for i in WITH_TREND[name]:
        assert second[i] - first[i] == pytest.approx(trend[i], rel=1e-6)
    assert u[1] == pytest.approx(u_before[1], abs=2e-6)


def test_trend_survives_the_change_itself():
    """A second change right after the first still knows the trend of u."""
    before = running("vsg-2", seed=0)
    for k in range(3000):
        before.step(REF, REF - [0.0, 1e-4 * k, 0.0, 0.0, 0.0])
    trend = before.state["trend"][0].copy()
    after, _, _ = change(before, DISCRETE["vsg-12"], REF, REF - [0.0, 0.3, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(after.state["trend"][0], trend)
    after.step(REF, REF - [0.0, 0.3, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(after.state["trend"][0], trend, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("T_off", [0.05, 0.2])
def test_offset_of_stateless_rows_decays(T_off):
    """matching-2 has no states: the difference that it cannot absorb decays as exp(-t/T_off)."""
    law = replace(get_law("matching-2", k_dc=-1.0, k_31=-2.0), limits=Limits(T_off=T_off))
    before = running("vsg-2", seed=1)
    before.state["x"][0, :3] += [0.2, 1e-3, 0.02]
    ref, y = REF.copy(), REF + np.array([0.01, 0.02, 0.0, 0.01, 0.01])
    after, u, bump = change(before, discretise(law, T_S), ref, y)
    assert bump <= 1e-12
    plain = Running.of(discretise(law, T_S)).step(ref, y)
    us = after.run(np.tile(ref, (4000, 1)), np.tile(y, (4000, 1)))
    t = np.arange(4000) * T_S
    expected = plain + np.exp(-t / T_off)[:, None] * (u - plain)
    np.testing.assert_allclose(us, expected, atol=1e-12)
    assert np.abs(u - plain).min() > 1e-4


def test_a_row_with_states_has_no_offset():
    before = running("droop-5", seed=2)
    after, _, _ = change(before, DISCRETE["vsg-2"], REF, REF + 0.002)
    assert np.abs(after.state["offset"]).max() < 1e-15


def test_tighter_limits_are_reported_as_a_bump():
    before = running("vsg-2", seed=1)
    ref, y = REF, REF - [0.0, 0.0, 0.0, 0.0, 0.001]
    expected = before.step(ref, y)
    law = get_law("vsg-5")
    tight = law.limits.model_copy(update={"E_u": (0.0, float(expected[2]) - 0.01)})
    before = running("vsg-2", seed=1)
    _, u, bump = change(before, discretise(replace(law, limits=tight), T_S), ref, y)
    assert bump == pytest.approx(0.01, abs=1e-3)
    assert u[2] == tight.high[2]
    assert u[:2] == pytest.approx(expected[:2], abs=1e-12)


def test_limited_omega_u_does_not_spoil_the_other_rows():
    """VSG-3 feeds omega_u to E_u: a tighter limit of omega_u makes a bump of omega_u alone."""
    before = running("vsg-2", seed=1)
    expected = running("vsg-2", seed=1).step(REF, REF)
    tight = Limits(omega_u=(float(expected[1]) + 0.001, 1.1))
    new = discretise(replace(get_law("vsg-3"), limits=tight), T_S)
    _, u, bump = change(before, new, REF, REF)
    assert bump == pytest.approx(0.001)
    assert u[[0, 2]] == pytest.approx(expected[[0, 2]], abs=1e-12)


@pytest.mark.parametrize("name", LAWS)
def test_a_law_at_rest_is_taken_over_at_rest(name):
    """If u is already the new law's resting output, it stays there without a transient."""
    discrete = DISCRETE[name]
    before = Running.of(DISCRETE["matching-2"])
    before.step(REF, REF)
    before.state["offset"] = 0.0
    target = settled(discrete)
    # an old law with exactly this constant u
    before.law["u_0"], before.law["D_u0"], before.law["D_r"], before.law["D_y"] = target, 0, 0, 0
    before.state["u"], before.state["trend"] = target, 0.0
    after, _, bump = change(before, discrete, REF, REF)
    assert bump <= 1e-12
    for _ in range(10):
        np.testing.assert_allclose(after.settle(300), target, atol=1e-9)


def settled(discrete: DiscreteLaw) -> Vector:
    """u of a law after a long time at its references, all errors zero."""
    return Running.of(discrete).settle(20_000)


def custom(element: Element, u_start: float = 1.0) -> DiscreteLaw:
    return discretise(BuiltLaw("c", "", "", {(2, 4): element}, u_0=(0.0, 1.0, u_start)), T_S)


@pytest.mark.parametrize(
    "element",
    [
        I(0.5) * IF(1.0, 0.1),
        PI(0.5, 0.2) * IF(1.0, 0.05) * IF(1.0, 0.01),
        I(1.0) * Element.of((1.0,), ((1.0, 0.06, 0.0009),)),  # a double pole beside the integrator
        PD(1.0, 0.01) * IF(1.0, 0.1) * IF(2.0, 1e-4) * IF(1.0, 3.0),
        P(2.0) * IF(1.0, 1e-6),
    ],
    ids=["I-IF", "PI-IF-IF", "I-O", "four", "fast"],
)
def test_rows_of_many_states(element):
    """Integrators, double and spread poles in one row: no bump, and no kick afterwards."""
    before = running("vsg-2", seed=4)
    ref, y = REF, REF + np.array([0.0, 0.0, 0.0, 0.0, 0.01])
    after, u, bump = change(before, custom(element), ref, y)
    assert bump <= 1e-12
    us = after.run(np.tile(ref, (200, 1)), np.tile(y, (200, 1)))
    slow = element.order > 1
    if slow:
        assert np.abs(np.diff(us[:, 2])).max() < 1e-3, "u goes on smoothly"
    np.testing.assert_array_equal(us[0], u)


def test_set_points_that_follow_a_reference():
    """matching-1's i_0 is P_ref, E_0 is V_ref: they count as part of the new law's output."""
    ref = REF + np.array([0.0, 0.3, 0.0, 0.0, 0.02])
    before = running("vsg-2", seed=5)
    after, _, bump = change(before, DISCRETE["matching-1"], ref, ref)
    assert bump <= 1e-12
    # all errors are 0, so that row 3's integrator holds the difference of E_u and E_0
    E_u = after.step(ref, ref)[2]
    np.testing.assert_allclose(u_0(LAWS["matching-1"], ref), [0.8, 1.0, 1.02])
    assert after.state["x"][0, 0] == pytest.approx(E_u - 1.02, abs=1e-12)
