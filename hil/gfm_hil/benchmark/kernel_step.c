/* The step of gfm_runtime/kernel.py in C, on the same bytes: same operations in the same order.
 *
 * "law.h" is made by gfm_runtime.c_header: real, law_t, state_t and the constants.
 * Compile with -ffp-contract=off: a fused multiply-add rounds once where the kernel rounds twice.
 */
#include <tgmath.h> /* sqrt and fabs in float where real is float */
#include "law.h"

static real limited(const law_t *law, const state_t *state, int i)
{
    real v = state->raw[i];
    v = law->low[i] > v ? law->low[i] : v; /* a NaN passes, as in the kernel */
    return law->high[i] < v ? law->high[i] : v;
}

static real at_least_v_min(real v)
{
    return (real)V_MIN > v ? (real)V_MIN : v;
}

static real sine_of_half(real x_a, real y_a, real x_b, real y_b)
{
    const real half = 0.5;
    real dot = x_a * x_b + y_a * y_b, cross = y_a * x_b - x_a * y_b;
    real r = sqrt(dot * dot + cross * cross), larger, sine;
    int a_below = y_a < 0, b_below = y_b < 0;
    if (!(r >= (real)R_MIN))
        return 0;
    larger = sqrt(half + half * fabs(dot / r));
    sine = dot >= 0 ? half * fabs(cross / r) / larger : larger;
    return (a_below == b_below ? cross < 0 : a_below) ? -sine : sine;
}

static void map_errors(int64_t code, const real *parameters, real *r, real *y)
{
    const real half = 0.5;
    if (code == ERROR_DC_ENERGY) {
        r[0] = half * r[0] * r[0];
        y[0] = half * y[0] * y[0];
    } else if (code == ERROR_DVOC) {
        real v_ref = at_least_v_min(r[4]), v = at_least_v_min(y[4]);
        r[1] /= v_ref * v_ref;
        r[3] /= v_ref * v_ref;
        y[1] /= v * v;
        y[3] /= v * v;
    } else if (code == ERROR_HYBRID_ANGLE) {
        real R = parameters[0], X = parameters[1];
        r[1] = sine_of_half(r[4] * r[4] - (R * r[1] + X * r[3]), X * r[1] - R * r[3],
                            y[4] * y[4] - (R * y[1] + X * y[3]), X * y[1] - R * y[3]);
        y[1] = 0;
    }
}

static real row(const law_t *law, const state_t *state, int i)
{
    real a = law->u_0[i] + state->offset[i];
    for (int j = 0; j < law->n; j++)
        a += law->C[i][j] * state->x[j];
    for (int j = 0; j < NY; j++)
        a += law->D_u0[i][j] * state->ref[j] + law->D_r[i][j] * state->r[j];
    for (int j = 0; j < NY; j++)
        if (j != 2)
            a += law->D_y[i][j] * state->y[j];
    return a;
}

static void output(const law_t *law, state_t *state, real *u)
{
    state->raw[1] = row(law, state, 1) * law->loop;
    u[1] = state->y[2] = limited(law, state, 1);
    for (int i = 0; i < NU; i += 2) {
        state->raw[i] = row(law, state, i) + law->D_y[i][2] * state->y[2];
        u[i] = limited(law, state, i);
    }
}

static real faded(real value)
{
    return fabs(value) < (real)NEGLIGIBLE ? 0 : value;
}

static void advance(const law_t *law, state_t *state)
{
    for (int i = 0; i < NU; i++) {
        real u = limited(law, state, i);
        real excess = u - state->raw[i];
        if (excess != 0)
            for (int j = 0; j < law->n; j++)
                state->x[j] += law->W[j][i] * excess;
        state->offset[i] = faded(state->offset[i] * law->decay);
        real trend = state->trend[i];
        state->trend[i] = faded(trend + law->follow * (u - state->u[i] - trend));
        state->u[i] = u;
    }
    for (int i = 0; i < law->n; i++) {
        real a = law->B_r[i][0] * state->r[0];
        for (int j = 1; j < NY; j++)
            a += law->B_r[i][j] * state->r[j];
        for (int j = 0; j < NY; j++)
            a += law->B_y[i][j] * state->y[j];
        for (int j = 0; j < law->n; j++)
            a += law->A[i][j] * state->x[j];
        state->x_next[i] = a;
    }
    for (int i = 0; i < law->n; i++)
        state->x[i] = faded(state->x_next[i]);
}

static void step(const law_t *law, state_t *state, const real *ref, const real *y, real *u)
{
    for (int j = 0; j < NY; j++) {
        state->ref[j] = state->r[j] = ref[j];
        state->y[j] = y[j];
    }
    map_errors(law->error_map, law->error_parameters, state->r, state->y);
    output(law, state, u);
    advance(law, state);
}

typedef struct {
    real ref[NY], y[NY], u[NU];
} io_t;

/* As `drive` of gfm_hil/benchmark/kernel.py: `rows` inputs in turn, each changed by the last u. */
void drive(const law_t *law, state_t *state, io_t *io, const real *inputs, real *outputs,
           int64_t rows, int64_t steps, real feedback)
{
    for (int64_t k = 0, m = 0; k < steps; k++, m = m + 1 == rows ? 0 : m + 1) {
        for (int j = 0; j < NY; j++)
            io->y[j] = inputs[m * NY + j] + feedback * io->u[j % NU];
        step(law, state, io->ref, io->y, io->u);
        for (int i = 0; i < NU; i++)
            outputs[m * NU + i] = io->u[i];
    }
}
