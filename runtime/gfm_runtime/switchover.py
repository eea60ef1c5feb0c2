"""A change of law without a bump: one njit call at one tick.

The new law's states are set from linear maps that were prepared when it was discretised (E_r,
E_y, F, G): nearest to its own rest state, with u[k] and, where a row has two or more states, the
trend of u carried over. A row without states cannot absorb the difference between the two laws;
there it goes into ``state.offset``, which decays with the law's T_off.
"""

from gfm_runtime.compiled import compiled
from gfm_runtime.inner import settle_inner, take_measurements
from gfm_runtime.kernel import look, output, set_inputs
from gfm_runtime.signals import NU, NY


@compiled
def settle_into(law, state, ref, y, u, trend):
    """The state with which the output at ref and y is u, p.u., and goes on with the slope trend,
    p.u. per tick.

    If u lies outside the law's limits the output is the limit, and the difference is a bump.

    Args:
        law, state: records of ``law_dtype`` and ``state_dtype``.
        ref, y: shape (5,), p.u.
        u: shape (3,), p.u.; on return what comes out of the law.
        trend: shape (3,), p.u. per tick.
    """
    set_inputs(law, state, ref, y)
    for i in range(NU):
        state.raw[i] = u[i]  # output writes raw anew below
        state.offset[i] = 0
        state.trend[i] = trend[i]
        state.u[i] = state.raw[i] - state.trend[i]
    i_u, omega_u, E_u = state.raw[0], state.raw[1], state.raw[2]
    state.y[2] = omega_u
    for i in range(NU):  # raw is now what the states and the trend have to give
        state.raw[i] -= law.u_0[i]
        for j in range(NY):
            state.raw[i] -= law.D_u0[i, j] * state.ref[j]
    for i in range(law.n):
        a = law.E_r[i, 0] * state.r[0]
        for j in range(1, NY):
            a += law.E_r[i, j] * state.r[j]
        for j in range(NY):
            a += law.E_y[i, j] * state.y[j]
        for j in range(NU):
            a += law.F[i, j] * state.raw[j] + law.G[i, j] * state.trend[j]
        state.x[i] = a + 0  # never -0, as after a step: code that leaves out zeros gives +0
    # the offset takes the rest: all of it in a row without states, rounding in the others
    output(law, state)
    state.offset[1] = (omega_u - state.raw[1]) / law.loop
    output(law, state)
    state.offset[0] = i_u - state.raw[0]
    state.offset[2] = E_u - state.raw[2]
    output(law, state)
    for i in range(NU):
        u[i] = state.now[i]


@compiled
def settle_with_inner(law, state, ref, y, u, trend, e_d, e_q):
    """As settle_into; and the inner stage goes on with the bridge's voltage e, p.u."""
    settle_into(law, state, ref, y, u, trend)
    take_measurements(state, y)
    settle_inner(law, state, e_d, e_q)


@compiled
def change_law(old, old_state, new, new_state, ref, y, u):
    """u[k] under the new law, prepared so that it equals the old law's u[k]; returns the bump.

    Args:
        old, new: records of ``law_dtype``; old_state, new_state of ``state_dtype``.
        ref, y: this tick's references and measurements, shape (5,), p.u.
        u: output, shape (3,), p.u.

    Returns:
        max |u_new - u_old| in p.u.: rounding, unless the new law's limits are tighter.
    """
    look(old, old_state, ref, y, u)
    i_u, omega_u, E_u = u[0], u[1], u[2]
    settle_into(new, new_state, ref, y, u, old_state.trend)
    return max(abs(u[0] - i_u), abs(u[1] - omega_u), abs(u[2] - E_u))
