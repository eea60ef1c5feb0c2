#include "@P@.h"

#include <float.h>
#include <limits.h>
#include <math.h>
#include <stdbool.h>
#include <string.h>

@GUARDS@
#if DBL_MANT_DIG != 53
#error "double is not the IEEE 754 type of 64 bits, in which the stage is chosen"
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

@FUNCTIONS@
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
    /* @if by_X@ */
    s->grid.X = @X_0@;
    /* @end@ */
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
        static const double above[] = {@ABOVE@}, below[] = {@BELOW@};
        /* @if by_X@ */
        const double at = estimate(&s->grid, (double)y[1], (double)y[2], (double)y[4]);
        /* @else@ */
        const double at = (double)y[4];
        /* @end@ */
        const int stage = choose(s, s->active, at, above, below);
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
