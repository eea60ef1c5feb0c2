#include "@P@.h"

#include <float.h>
#include <limits.h>
#include <math.h>
#include <stdbool.h>
#include <string.h>

@GUARDS@
#if DBL_MANT_DIG != 53
#error "double is not the IEEE 754 type of 64 bits, in which the estimate is made"
#endif

typedef @P@_real real;

/* Whether a stage would accept these inputs. */
static bool accepted(const real ref[], const real y[])
{
    int channel = @Y_CHECKS@
                : -1;
    if (channel < 0) {
        channel = @REF_CHECKS@
                : -1;
    }
    return channel < 0;
}

/* One tick of the estimate, in the order of the bench (gfm_runtime.impedance). */
static void estimate(@P@_estimate_t *g, double p, double omega_u, double V)
{
    double p_fast;
    if (g->age == 0) {
        g->p_slow = p;
        g->omega_slow = omega_u;
        g->p_smooth = p;
        g->omega_smooth = omega_u;
    }
    if (g->age < @SETTLED@) {
        g->age++;
    }
    g->p_smooth += @b@ * (p - g->p_smooth);
    g->omega_smooth += @b@ * (omega_u - g->omega_smooth);
    g->omega_slow += @a@ * (g->omega_smooth - g->omega_slow);
    g->theta += @T_omega@ * (g->omega_smooth - g->omega_slow) - @a@ * g->theta;
    g->p_slow += @a@ * (g->p_smooth - g->p_slow);
    g->p_slower += @a@ * (g->p_smooth - g->p_slow - g->p_slower);
    p_fast = g->p_smooth - g->p_slow - g->p_slower;
    g->s_pt += @forget@ * (p_fast * g->theta - g->s_pt);
    g->s_tt += @forget@ * (g->theta * g->theta - g->s_tt);
    g->s_pp += @forget@ * (p_fast * p_fast - g->s_pp);
    if (g->age >= @SETTLED@ && g->s_tt > @EXCITATION@ && g->s_pt > 0.0
        && g->s_pt * g->s_pt > @COHERENT@ * g->s_pp * g->s_tt) {
        double K = g->s_pt / g->s_tt;
        double X = V / sqrt(K * K + g->p_slow * g->p_slow) - @X_f@;
        g->X = X > @X_MIN@ ? X : @X_MIN@;
    }
}

/* The stage for the estimate, with hysteresis and a least time between two changes. */
static int wanted(@P@_t *s)
{
    static const double above[] = {@ABOVE@}, below[] = {@BELOW@};
    int stage = s->active;
    if (s->since <= @DWELL@) {
        s->since++;
    }
    if (s->since > @DWELL@) {
        while (stage + 1 < @COUNT@ && above[stage] < s->grid.X) {
            stage++;
        }
        while (stage > 0 && below[stage - 1] > s->grid.X) {
            stage--;
        }
    }
    return stage;
}

/* What the stage in force would give, and with what slope it would go on. */
static void look(const @P@_t *s, const real ref[], const real y[], real u[], real trend[]@E_OUT@)
{
    switch (s->active) {
@LOOK@
    default:
        break;
    }
}

int @P@_settle(@P@_t *s, const real ref[], const real y[], real u[], const real trend[]@E@)
{
    int reason = @GUARD@_OK;
    switch (s->active) {
@SETTLE@
    default:
        break;
    }
    return reason;
}

void @P@_init(@P@_t *s)
{
    (void)memset(s, 0, sizeof *s);
@INIT@
    s->grid.X = @X_0@;
    s->active = @START@;
}

void @P@_reset(@P@_t *s)
{
    switch (s->active) {
@RESET@
    default:
        break;
    }
    s->reason = @GUARD@_OK;
}

int @P@_step(@P@_t *s, const real ref[], const real y[], real u[])
{
    if (s->reason == @GUARD@_OK && accepted(ref, y)) {
        int stage;
        estimate(&s->grid, (double)y[1], (double)y[2], (double)y[4]);
        stage = wanted(s);
        if (stage != s->active) {
            real own[@N_ROWS@] = {0}, trend[@N_ROWS@] = {0}@E_MEMORY@;
            look(s, ref, y, own, trend@e@);
            s->active = stage;
            s->since = 0;
            s->changes++;
            (void)@P@_settle(s, ref, y, own, trend@e@);
        }
    }
    switch (s->active) {
@STEP@
    default:
        break;
    }
    return s->reason;
}
