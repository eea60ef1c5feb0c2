#include "@P@.h"

/* C99 leaves it open how a negative number is shifted to the right: here its sign must stay. */
typedef char @P@_shifts_keep_the_sign[(-1 >> 1) == -1 ? 1 : -1];

/* What a tick works on beside the state. */
typedef struct {
@TICK@    int64_t raw[@GUARD@_NU];    /* u before the limits, each row at its own exponent */
    int32_t excess[@GUARD@_NU]; /* what the limits add to it, for the anti-windup */
    int32_t u[@GUARD@_NU];
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

/* 0, or the reason to refuse these inputs: the state, or the ranges of the signal table. */
static int refused(const @P@_t *s, const int32_t ref[], const int32_t y[], int *channel)
{
    if (s->reason != @GUARD@_OK) {
        *channel = s->channel;
        return s->reason;
    }
@CHECKS@
    *channel = -1;
    return @GUARD@_OK;
}

@MAP@@FUNCTIONS@
/* A rest begins in the middle of what it can be. */
static void begin_rests(@P@_t *s)
{
    static const int64_t half[] = {
        @HALVES@};
    int i;
    for (i = 0; i < @GUARD@_NREST; i++) {
        s->rest[i] = half[i];
    }
}

void @P@_init(@P@_t *s)
{
    static const int32_t u[] = {@U_DEFAULT@};
    int i;
    @P@_reset(s);
    for (i = 0; i < @GUARD@_NU; i++) {
        s->u[i] = u[i];
    }
}

void @P@_reset(@P@_t *s)
{
    int i;
    for (i = 0; i < @GUARD@_NX; i++) {
        s->x[i] = 0;
    }
    for (i = 0; i < @GUARD@_NU; i++) {
        s->offset[i] = 0;
        s->trend[i] = 0;
    }
    begin_rests(s);
    s->reason = @GUARD@_OK;
    s->channel = -1;
}

int @P@_step(@P@_t *s, const int32_t ref[], const int32_t y[], int32_t u[])
{
    tick_t t;
    int i;
    int reason = refused(s, ref, y, &s->channel);
    if (reason != @GUARD@_OK) {
        s->reason = reason;
        return reason;
    }
    set_inputs(&t, ref, y);
    output(s, &t);
    advance(s, &t);
    for (i = 0; i < @GUARD@_NU; i++) {
        s->u[i] = t.u[i];
        u[i] = t.u[i];
    }
    return @GUARD@_OK;
}

int @P@_look(const @P@_t *s, const int32_t ref[], const int32_t y[], int32_t u[])
{
    tick_t t;
    int i, channel, reason = refused(s, ref, y, &channel);
    if (reason != @GUARD@_OK) {
        return reason;
    }
    set_inputs(&t, ref, y);
    output(s, &t);
    for (i = 0; i < @GUARD@_NU; i++) {
        u[i] = t.u[i];
    }
    return @GUARD@_OK;
}

int @P@_settle(@P@_t *s, const int32_t ref[], const int32_t y[], int32_t u[], const int32_t trend[])
{
    tick_t t;
    int32_t wanted[@GUARD@_NU];
    int i, channel, reason = refused(s, ref, y, &channel);
    if (reason != @GUARD@_OK) {
        return reason;
    }
    for (i = 0; i < @GUARD@_NU; i++) {
        s->offset[i] = 0;
    }
    begin_rests(s);
@WANTED@
    set_inputs(&t, ref, y);
    set_states(s, &t);
    /* the offset takes the rest: all of it in a row without states, rounding in the others */
@OFFSETS@
    output(s, &t);
    for (i = 0; i < @GUARD@_NU; i++) {
        u[i] = t.u[i];
    }
    return @GUARD@_OK;
}

int @P@_switch(@P@_t *s, const int32_t ref[], const int32_t y[], int32_t u[], const int32_t trend[],
    int32_t *bump)
{
    int32_t old[@GUARD@_NU];
    int i, reason;
    for (i = 0; i < @GUARD@_NU; i++) {
        old[i] = u[i];
    }
    reason = @P@_settle(s, ref, y, u, trend);
    *bump = 0;
@BUMPS@
    return reason;
}
