"""The kernel's step: precision, layout, memory, limits and anti-windup."""

from typing import Any

import numpy as np
import pytest
from numba import njit
from numba.core.runtime import _nrt_python  # type: ignore[attr-defined]
from numba.core.runtime.nrt import rtsys
from numpy.typing import NDArray
from pydantic import ValidationError

from gfm_runtime import BuiltLaw, Limits, discretise, get_law, law_dtype, state_dtype, step
from gfm_runtime.elements import IF, INTEGRATOR, PI, I, P
from gfm_runtime.kernel import N_MAX
from gfm_runtime.law import cell_name
from gfm_runtime.signals import NU, NY, U_NAMES

from ..support.laws import LAWS, REF, Running, Vector, drive, slow_but, wander

T_S = 1e-4
f32 = np.float32


@njit
def ticks_at(law, state, ref, y, u, i, limit, most):
    """Ticks until u_i is no longer at its limit, ``most`` if it still is."""
    for k in range(most):
        step(law[0], state[0], ref, y, u)
        if u[i] != limit:
            return k
    return most


# --- precision ---


@pytest.mark.parametrize("name", slow_but(("droop-1", "dvoc", "mimo-gfm"), LAWS))
def test_float32_stays_close_to_float64(name):
    """Over 0.5 s; the tolerance covers the rounding that an integrator accumulates."""
    discrete = discretise(LAWS[name], T_S)
    refs, ys = wander(5000, seed=4, size=0.01)
    double = Running.of(discrete).run(refs, ys)
    single = Running.of(discrete, f32).run(refs, ys)
    assert np.max(np.abs(single - double)) < 2e-4


def in_float32(discrete: Running, refs: Vector, ys: Vector) -> list[list[np.float32]]:
    """The recursion of a linear law, with NumPy's float32 scalars alone."""
    law, n = discrete.law[0], int(discrete.law[0]["n"])
    x = [f32(0)] * n
    out = []
    for ref64, y64 in zip(refs, ys, strict=True):
        r, y = [f32(v) for v in ref64], [f32(v) for v in y64]

        def row(i: int, x: Any = x, r: Any = r, y: Any = y) -> np.float32:
            a = law["u_0"][i] + f32(0)
            for j in range(n):
                a += law["C"][i, j] * x[j]
            for j in range(NY):
                a += law["D_u0"][i, j] * r[j] + law["D_r"][i, j] * r[j]
            for j in (0, 1, 3, 4):
                a += law["D_y"][i, j] * y[j]
            return f32(a)

        y[2] = omega_u = row(1, x) * law["loop"]
        i_u, E_u = (row(i, x) + law["D_y"][i, 2] * y[2] for i in (0, 2))
        out.append([i_u, omega_u, E_u])
        following = []
        for i in range(n):
            a = law["B_r"][i, 0] * r[0]
            for j in range(1, NY):
                a += law["B_r"][i, j] * r[j]
            for j in range(NY):
                a += law["B_y"][i, j] * y[j]
            for j in range(n):
                a += law["A"][i, j] * x[j]
            following.append(a)
        x = following
    assert all(isinstance(v, np.float32) for u in out for v in u)
    return out


@pytest.mark.parametrize("name", [n for n, law in LAWS.items() if law.error_map == "linear"])
def test_a_float32_law_computes_in_float32(name):
    """Equal bit by bit, although references, measurements and u are float64."""
    loop = Running.of(discretise(LAWS[name], T_S), f32).unlimited()
    refs, ys = wander(40, seed=6)
    np.testing.assert_array_equal(loop.run(refs, ys), np.array(in_float32(loop, refs, ys)))


@pytest.mark.parametrize("name", LAWS)
def test_precision_of_the_arguments_does_not_matter(name):
    discrete = discretise(LAWS[name], T_S)
    refs, ys = (a.astype(f32) for a in wander(40, seed=7))
    wide, narrow = Running.of(discrete, f32), Running.of(discrete, f32)
    u = np.zeros(NU, f32)
    for ref, y in zip(refs, ys, strict=True):
        step(narrow.law[0], narrow.state[0], ref, y, u)
        np.testing.assert_array_equal(u, wide.step(ref.astype(float), y.astype(float)))
    np.testing.assert_array_equal(wide.state["x"], narrow.state["x"])


# --- layout and memory ---


@pytest.mark.parametrize("make", [law_dtype, state_dtype])
@pytest.mark.parametrize("real", [np.float64, np.float32])
def test_records_are_plain_structs(make, real):
    dtype = make(real)
    assert dtype.isalignedstruct and dtype.fields is not None
    end = 0
    for kind, offset, *_ in dtype.fields.values():
        assert kind.base in (np.dtype(real), np.dtype(np.int64))
        assert 0 <= offset - end < kind.base.itemsize, "no gap but what a number needs"
        end = offset + kind.itemsize
    assert dtype.itemsize - end < 8


def test_record_holds_the_matrices():
    discrete = discretise(get_law("vsg-12"), T_S)
    n = discrete.order
    record = Running.of(discrete).law[0]
    assert record["n"] == n == 5
    for name, shape in {"A": (n, n), "B_r": (n, NY), "B_y": (n, NY), "W": (n, NU)}.items():
        held = record[name]
        np.testing.assert_array_equal(held[: shape[0], : shape[1]], getattr(discrete, name))
        assert not held[n:].any()
    np.testing.assert_array_equal(record["C"][:, :n], discrete.C)
    assert not record["C"][:, n:].any() and not record["A"][:, n:].any()
    assert record["A"].shape == (N_MAX, N_MAX)


@pytest.mark.parametrize("real", [np.float64, np.float32])
def test_a_step_allocates_nothing(real):
    loops = [Running.of(discretise(LAWS[n], T_S), real) for n in ("vsg-12", "dvoc", "hybrid-angle")]
    u = np.zeros(NU)
    drive(loops[0].law, loops[0].state, REF, REF, u, 1)
    _nrt_python.memsys_enable_stats()
    before = rtsys.get_allocation_stats()
    for loop in loops:
        drive(loop.law, loop.state, REF, REF, u, 1000)
    after = rtsys.get_allocation_stats()
    # the rest is the boxing of the arguments: once per call from Python, none per tick
    assert after.alloc - before.alloc <= 10 * len(loops)
    assert after.mi_alloc - before.mi_alloc <= 10 * len(loops)


def test_what_decays_ends_at_zero():
    """Subnormal numbers are slow; a decaying filter must not pass through them."""
    law = BuiltLaw("a", "", "", {(1, 1): IF(1.0, 1e-3)})
    loop = Running.of(discretise(law, T_S))
    loop.step(REF, REF + 0.01)
    loop.state["offset"] = 1e-3
    drive(loop.law, loop.state, REF, REF, np.zeros(NU), 400_000)
    for name in ("x", "offset", "trend"):
        assert not loop.state[name].any(), name


# --- limits and anti-windup ---


def test_u_stays_within_its_limits():
    law = get_law("mimo-gfm")
    loop = Running.of(discretise(law, T_S))
    rng = np.random.default_rng(8)
    us = np.array([loop.step(REF, REF + rng.normal(size=NY)) for _ in range(3000)])
    assert np.all(us >= law.limits.low) and np.all(us <= law.limits.high)
    for i in range(NU):
        assert {law.limits.low[i], law.limits.high[i]} & set(us[:, i]), "a limit was reached"


def test_limits_are_exact_and_do_nothing_inside():
    law = get_law("vsg-2")
    refs, ys = wander(200, seed=9, size=0.01)
    free = Running.of(discretise(law, T_S)).unlimited().run(refs, ys)
    np.testing.assert_array_equal(Running.of(discretise(law, T_S)).run(refs, ys), free)


def limited(law: BuiltLaw, **limits: Any) -> BuiltLaw:
    return BuiltLaw(
        law.name, "", "", law.phi, law.psi, law.u_0, law.error_map, law.error_parameters,
        Limits(**limits),
    )  # fmt: skip


INTEGRATORS = [
    (name, matrix, cell)
    for name, law in LAWS.items()
    for matrix, cells in (("phi", law.phi), ("psi", law.psi))
    for cell, element in cells.items()
    if INTEGRATOR in element.den
]


def into_the_limit(
    law: BuiltLaw, cell: tuple[int, int], upper: bool, anti_windup: bool = True
) -> tuple[int, int]:
    """Ticks that u_i stays at its limit once the error is reversed after 3 s, and T_t in ticks.

    The error is large enough to take the integrator from one limit to the other in 0.3 s.
    """
    i, j = cell
    loop = Running.of(discretise(law, T_S))
    if not anti_windup:
        loop.law["W"] = 0.0
    low, high = law.limits.low[i], law.limits.high[i]
    slope = law.element("phi", cell).num[0]  # of u_i per unit of error and second
    away = np.zeros(NY)
    away[j] = (1 if upper else -1) * (high - low) / 0.3 / slope
    u = np.zeros(NU)
    there, back = REF - away, REF + away
    if law.error_map != "linear":
        loop.law["error_map"] = 0  # the errors themselves are driven here
    drive(loop.law, loop.state, REF, there, u, 30_000)
    limit = high if upper else low
    assert u[i] == limit
    stays = ticks_at(loop.law, loop.state, REF, back, u, i, limit, 20_000)
    return stays, round(law.limits.T_t / T_S)


@pytest.mark.parametrize("upper", [True, False], ids=["upper", "lower"])
@pytest.mark.parametrize(
    ("name", "matrix", "cell"),
    INTEGRATORS,
    ids=[f"{n}-{cell_name(m, c)}" for n, m, c in INTEGRATORS],
)
def test_each_integrator_leaves_its_limit(name, matrix, cell, upper):
    """Within T_t; without anti-windup it stays there for seconds."""
    assert matrix == "phi"
    stays, T_t = into_the_limit(LAWS[name], cell, upper)
    assert stays <= T_t
    stays, _ = into_the_limit(LAWS[name], cell, upper, anti_windup=False)
    assert stays == 20_000


def test_there_is_an_integrator_of_each_kind():
    """DC PI, droop-2's two, PSC's I, VSG's q and V, matching's and hybrid angle's PI, dVOC's."""
    found = {(name, cell_name(matrix, cell)) for name, matrix, cell in INTEGRATORS}
    assert found >= {
        ("droop-1", "phi_11"), ("droop-2", "phi_32"), ("droop-2", "phi_35"), ("psc-2", "phi_34"),
        ("vsg-5", "phi_34"), ("vsg-5", "phi_35"), ("matching-1", "phi_35"),
        ("hybrid-angle", "phi_35"), ("dvoc", "phi_34"), ("mimo-gfm", "phi_34"),
    }  # fmt: skip


@pytest.mark.parametrize("T_t", [1e-5, 0.005, 0.1])
@pytest.mark.parametrize("column_3", [None, P(10.0), P(-0.5), IF(5.0, 0.01)])
def test_anti_windup_of_omega_u_with_its_loop(T_t, column_3):
    """The tracking time is T_t for any gain of the loop through column 3."""
    cells = {(1, 1): PI(0.01, 0.05)} | ({(1, 2): column_3} if column_3 else {})
    law = limited(BuiltLaw("a", "", "", cells), T_t=T_t)
    for upper in (True, False):
        stays, ticks = into_the_limit(law, (1, 1), upper)
        assert stays <= max(ticks, 1)


def test_back_calculation_settles_where_it_should():
    """With an error e that holds it at a limit, an I settles k_i e T_t beyond it in a few T_t."""
    law = limited(BuiltLaw("a", "", "", {(2, 4): I(0.5)}, u_0=(0.0, 1.0, 1.0)), T_t=0.02)
    loop = Running.of(discretise(law, T_S))
    e = np.array([0.0, 0.0, 0.0, 0.0, 0.4])
    drive(loop.law, loop.state, REF, REF - e, np.zeros(NU), 20_000)
    beyond = float(loop.state["raw"][0, 2]) - law.limits.high[2]
    assert beyond == pytest.approx(0.4 / 0.5 * 0.02, rel=0.01)


def test_other_rows_do_not_feel_a_limit():
    law = get_law("vsg-2")
    tight = Running.of(discretise(limited(law, i_u=(-0.1, 0.1)), T_S))
    free = Running.of(discretise(law, T_S))
    refs, ys = wander(500, seed=11, size=0.1)
    a, b = tight.run(refs, ys), free.run(refs, ys)
    assert np.abs(a[:, 0] - b[:, 0]).max() > 0.01
    np.testing.assert_array_equal(a[:, 1:], b[:, 1:])


def test_column_3_is_fed_the_omega_u_that_is_applied():
    """VSG-3 feeds omega_u to E_u: at the limit it must be the limited omega_u."""
    law = get_law("vsg-3", k_33=2.0, k_34=0.0, D_p=0.1)
    law = limited(law, omega_u=(0.99, 1.01))
    loop = Running.of(discretise(law, T_S))
    u = np.zeros(NU)
    drive(loop.law, loop.state, REF, REF - [0.0, 1.0, 0.0, 0.0, 0.0], u, 10_000)
    assert u[1] == 1.01
    assert u[2] == pytest.approx(1.0 + 2.0 * (1.0 - 1.01))
    assert loop.state["y"][0, 2] == 1.01


@pytest.mark.parametrize("name", U_NAMES)
def test_limits_that_cannot_be(name):
    with pytest.raises(ValidationError, match=rf"{name}\n.*ascending"):
        Limits(**{name: (9.0, 1.0)})


def test_nan_passes_through_the_limits():
    """It must reach the controller's check, not be clamped to a plausible number."""
    loop = Running.of(discretise(get_law("mimo-gfm"), T_S))
    u: NDArray[np.float64] = loop.step(REF, np.array([np.nan, 0.5, 1.0, 0.0, 1.0]))
    assert np.isnan(u).all()
