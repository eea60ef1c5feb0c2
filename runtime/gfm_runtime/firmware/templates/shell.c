#include "@P@.h"

/* @if fixed@ */
#include <stdbool.h>

/* C99 leaves it open how a negative number is shifted to the right: here its sign must stay. */
typedef char @P@_shifts_keep_the_sign[(-1 >> 1) == -1 ? 1 : -1];
/* @else@ */
#include <float.h>
#include <limits.h>
#include <math.h> /* fabs, which is no call, and sqrt */
#include <stdbool.h>
/* @if tuned@ */
#include <string.h>
/* @end@ */

@GUARDS@
/* @if tuned@ */
#if DBL_MANT_DIG != 53
#error "double is not the IEEE 754 type of 64 bits, in which gains become coefficients"
#endif
/* @end@ */
/* @end@ */

typedef @P@_real real;
@IDENTIFICATION@
/* What a tick works on beside the state. */
/* @if fixed@ */
typedef struct {
    const int32_t *ref, *y;
/* @if mapped@ */
    int32_t r[5], m[5]; /* what the error map makes of ref and of y */
/* @end@ */
/* @if angle@ */
    int64_t a[2], b[2], turn[2]; /* directions of vectors */
/* @end@ */
    int64_t raw[3];    /* u before the limits, each row at its own exponent */
    int32_t excess[3]; /* what the limits add to it, for the anti-windup */
    int32_t u[3];
/* @if states@ */
    int32_t x_next[@N@];
/* @end@ */
} tick_t;

static int64_t product(int32_t a, int32_t b)
{
    return (int64_t)a * b;
}

static int32_t between(int64_t value, int32_t low, int32_t high)
{
    return value < low ? low : value > high ? high : (int32_t)value;
}

/* To the nearest. */
static int64_t rounded(int64_t value, int shift)
{
    return (value + (INT64_C(1) << (shift - 1))) >> shift;
}

/* @if angle@ */
/* The integer below the square root of a number below 2^62. */
static int32_t root(int64_t square)
{
    int32_t below = 0;
    int bit;
    for (bit = 30; bit >= 0; bit--) {
        const int32_t next = below + (INT32_C(1) << bit);
        if (product(next, next) <= square) {
            below = next;
        }
    }
    return below;
}

/* @else@ */

/* @end@ */
/* @else@ */
@TICK@
/* @if own@ */
/* A step is compiled in one: calls and the way through memory cost more than the sums. */
#ifdef __GNUC__
#define IN_PLACE __attribute__((flatten))
#define APART __attribute__((noinline))
#else
#define IN_PLACE
#define APART
#endif

/* @end@ */
/* @end@ */
@FUNCTIONS@
/* @if counts@ */
static int bad_ref(const real ref[], int *channel)
{
    *channel = @REF_CHECKS@
             : -1;
    return *channel >= 0 ? @GUARD@_BAD_REF : @GUARD@_OK;
}

/* @end@ */
/* 0, or the reason to refuse these inputs: the state, or the ranges of the signal table. */
/* @if own@ */
APART
/* @end@ */
static int refused(const @P@_t *s, const real ref[], const real y[], int *channel)
{
    if (s->reason != @GUARD@_OK) {
        *channel = s->channel;
        return s->reason;
    }
    *channel = @Y_CHECKS@
             : -1;
    if (*channel >= 0) {
        return @GUARD@_BAD_Y;
    }
/* @if counts@ */
    return bad_ref(ref, channel);
}

/* @if own@ */
/* Of what an A/D in its range gives, p and q alone can be out of theirs: the others are not checked. */
APART
/* @end@ */
static int out_of_range(const real ref[], const real y[], int *channel)
{
    *channel = @PIN_CHECKS@
             : -1;
    return *channel >= 0 ? @GUARD@_BAD_Y : bad_ref(ref, channel);
}
/* @else@ */
    *channel = @REF_CHECKS@
             : -1;
    return *channel >= 0 ? @GUARD@_BAD_REF : @GUARD@_OK;
}
/* @end@ */

/* @if tuned@ */
const @P@_gains_t @P@_gains = @GAINS@;

static uint32_t crc_of(const real c[])
{
    const uint32_t none = 0U, polynomial = 0xEDB88320U;
    uint32_t crc = ~none, words[sizeof(real) / sizeof(uint32_t)];
    unsigned i, k, bit;
    for (i = 0; i < @GUARD@_NCOEFFICIENTS; i++) {
        (void)memcpy((void *)words, (const void *)&c[i], sizeof words);
        for (k = 0; k < sizeof words / sizeof words[0]; k++) {
            crc ^= words[k];
            for (bit = 0; bit < 32U; bit++) {
                crc = (crc >> 1) ^ ((crc & 1U) != 0U ? polynomial : none);
            }
        }
    }
    return ~crc;
}

/* In double, whatever the step has; 0, or what is wrong. */
static int coefficients(const @P@_gains_t *gains, real c[])
{
    int i;
@GAIN_RANGES@
@GAIN_STEPS@
    if (!(@GAINS_HOLD@)) {
        return @GUARD@_NGAINS + 1;
    }
@COEFFICIENTS@
    for (i = 0; i < @GUARD@_NCOEFFICIENTS; i++) {
        if (!(c[i] - c[i] == @0@)) {
            return @GUARD@_NGAINS + 1;
        }
    }
    return 0;
}

int @P@_tune(@P@_t *s, const @P@_gains_t *gains)
{
    real c[@GUARD@_NCOEFFICIENTS];
    const int why = coefficients(gains, c);
    if (why == 0) {
        volatile @P@_set_t *set;
        int i;
        s->ready = 0; /* from here on no step changes the set in use */
        set = &s->set[1 - s->active];
        for (i = 0; i < @GUARD@_NCOEFFICIENTS; i++) {
            set->c[i] = c[i];
        }
        set->crc = crc_of(c);
        s->ready = 1;
    }
    return why;
}

int @P@_intact(const @P@_t *s)
{
    const @P@_set_t *set = &s->set[s->active];
    return crc_of(set->c) == set->crc;
}

/* As a change to another law: to u[k] under the old gains, and on from there. */
APART
static void take_gains(@P@_t *s, const real ref[], const real y[])
{
    tick_t t;
    real u[@N_ROWS@];
    const real *trend = s->trend;
/* @if stages@ */
    const real e[2] = {s->stage.e[0], s->stage.e[1]};
/* @end@ */
    t.c = s->set[s->active].c;
    @LOOK@;
    s->active = 1 - s->active;
    s->ready = 0;
    t.c = s->set[s->active].c;
    @SETTLE@;
}

/* @end@ */
void @P@_init(@P@_t *s)
{
    static const real start[] = {@U_DEFAULT@};
/* @if tuned@ */
    static const real first[] = {@FIRST@};
/* @end@ */
    int i;
/* @if tuned@ */
    for (i = 0; i < @GUARD@_NCOEFFICIENTS; i++) {
        s->set[0].c[i] = first[i];
    }
    s->set[0].crc = crc_of(first);
    s->active = 0;
    s->ready = 0;
/* @end@ */
/* @if stages@ */
    s->stage.e[0] = start[2];
    s->stage.e[1] = @0@;
/* @end@ */
    @P@_reset(s);
    for (i = 0; i < @N_ROWS@; i++) {
        s->u[i] = start[i];
    }
}

void @P@_reset(@P@_t *s)
{
    int i;
    for (i = 0; i < @GUARD@_NX; i++) {
        s->x[i] = @0@;
    }
    for (i = 0; i < @N_ROWS@; i++) {
        s->offset[i] = @0@;
        s->trend[i] = @0@;
    }
/* @if stages@ */
    {
        const @P@_stage_t rest = {
            .e = {s->stage.e[0], s->stage.e[1]}, .pll = {@1@, @0@}, .omega_pll = @OMEGA_DEFAULT@};
        s->stage = rest;
    }
    s->limited = 0;
/* @end@ */
/* @if counts@ */
    {
        const @P@_counts_t rest = {
            .angle = {@1@, @0@}, .sensed = {@AT_REST@}, .speed = @OMEGA_DEFAULT@};
        s->counts = rest;
    }
/* @end@ */
/* @if fixed@ */
    @RESET@;
/* @end@ */
    s->reason = @GUARD@_OK;
    s->channel = -1;
}

/* @if counts@ */
/* The part of a tick that is in p.u., if there is no reason to refuse it. */
static int ticked(@LAW@@P@_t *s, const real ref[], const real y[], real u[], tick_t *t, int reason)
{
/* @elif own@ */
IN_PLACE int @P@_step(@LAW@@P@_t *s, const real ref[], const real y[], real u[])
{
    tick_t t;
/* @else@ */
int @P@_step(@LAW@@P@_t *s, const real ref[], const real y[], real u[])
{
    tick_t t;
/* @end@ */
/* @if fixed@ */
    const real *out = t.u;
/* @else@ */
    real out[@GUARD@_NU];
/* @end@ */
/* @if counts@ */
    int i;
/* @else@ */
    int i, reason = refused(s, ref, y, &s->channel);
/* @end@ */
    if (reason != @GUARD@_OK) {
        s->reason = reason;
        return reason;
    }
/* @if fixed@ */
    t.ref = ref;
    t.y = y;
/* @elif tuned@ */
    if (s->ready != 0) {
        take_gains(s, ref, y);
    }
/* @if counts@ */
    t->c = s->set[s->active].c;
/* @else@ */
    t.c = s->set[s->active].c;
/* @end@ */
/* @end@ */
    @OUTPUT@;
/* @if fixed@ */
/* @else@ */
/* @if stages@ */
    if (!((out[0] - out[0]) + (out[1] - out[1]) + (out[2] - out[2]) + (out[3] - out[3]) == @0@)) {
/* @else@ */
    if (!((out[0] - out[0]) + (out[1] - out[1]) + (out[2] - out[2]) == @0@)) {
/* @end@ */
        /* omega_u first: column 3 takes it to the others */
        s->channel = !(out[1] - out[1] == @0@) ? 1
            : !(out[0] - out[0] == @0@)        ? 0
/* @if stages@ */
            : !(out[2] - out[2] == @0@)        ? 2
                                               : 3;
/* @else@ */
                                               : 2;
/* @end@ */
        s->reason = @GUARD@_BAD_U;
        return s->reason;
    }
/* @end@ */
    @ADVANCE@;
    for (i = 0; i < @GUARD@_NU; i++) {
        u[i] = out[i];
    }
    return @GUARD@_OK;
}

int @P@_look(@LAW@const @P@_t *s, const real ref[], const real y[], real u[])
{
    tick_t t;
    int channel, reason = refused(s, ref, y, &channel);
    if (reason == @GUARD@_OK) {
/* @if fixed@ */
        t.ref = ref;
        t.y = y;
/* @elif tuned@ */
        t.c = s->set[s->active].c;
/* @end@ */
        @LOOK@;
    }
    return reason;
}

int @P@_settle(@LAW@@P@_t *s, const real ref[], const real y[], real u[], const real trend[]@E@)
{
    tick_t t;
/* @if fixed@ */
    int channel, reason = refused(s, ref, y, &channel);
/* @else@ */
    real rest = @0@;
    int i, channel, reason = refused(s, ref, y, &channel);
    for (i = 0; i < @N_ROWS@; i++) {
        rest += (u[i] - u[i]) + (trend[i] - trend[i]);
    }
/* @if stages@ */
    rest += (e[0] - e[0]) + (e[1] - e[1]);
/* @end@ */
    if (reason == @GUARD@_OK && !(rest == @0@)) {
        reason = @GUARD@_BAD_U;
    }
/* @end@ */
    if (reason == @GUARD@_OK) {
/* @if fixed@ */
        t.ref = ref;
        t.y = y;
/* @elif tuned@ */
        if (s->ready != 0) {
            s->active = 1 - s->active;
            s->ready = 0;
        }
        t.c = s->set[s->active].c;
/* @end@ */
        @SETTLE@;
    }
    return reason;
}

int @P@_switch(@LAW@@P@_t *s, const real ref[], const real y[], real u[], const real trend[]@E@,
    real *bump)
{
/* @if fixed@ */
    real old[@N_ROWS@];
/* @else@ */
    real old[@N_ROWS@], change;
/* @end@ */
    int i, reason;
    for (i = 0; i < @N_ROWS@; i++) {
        old[i] = u[i];
    }
    reason = @P@_settle(@law@s, ref, y, u, trend@e@);
/* @if fixed@ */
    *bump = @BUMP@;
/* @else@ */
    *bump = @0@;
    for (i = 0; i < @N_ROWS@; i++) {
        change = u[i] < old[i] ? old[i] - u[i] : u[i] - old[i];
        *bump = change > *bump ? change : *bump;
    }
/* @end@ */
    return reason;
}
