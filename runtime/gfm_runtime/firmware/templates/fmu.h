/* What an FMU of @LAW_NAME@ does, without the interface around it. @MADE@ */
#ifndef FMU_H
#define FMU_H

#include "@P@.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

typedef @P@_t law_t;
typedef @P@_real real;

#define TOKEN "@TOKEN@"
#define T_S @T_S@

/* Value references: 0 is the time; then the inputs (references, measurements), the outputs, the result
 * of the last tick, and where the outputs begin. */
enum { NREF = @GUARD@_NREF, NY = @GUARD@_NY, NU = @GUARD@_NU, NIN = NREF + NY };
enum { TIME, IN, OUT = IN + NIN, REASON = OUT + NU, START, END = START + NU };
enum { MADE_READY, INITIALISES, STEPS };

/* All that changes in an instance. It is copied as a whole, and holds no pointer. */
typedef struct {
    char token[sizeof TOKEN]; /* so that another FMU's state is refused */
    law_t law;
    real u[NU];
    double in[NIN], start[NU];
    double begin, ticks; /* time of tick 0, s, and ticks since */
    int reason, started, mode;
} state_t;

static const double start_low[] = {@U_LOW@}, start_high[] = {@U_HIGH@};

static void make_ready(state_t *s)
{
    static const double in[] = {@IN_START@}, start[] = {@U_START@};
    int i;
    memset(s, 0, sizeof *s); /* also what lies between the members */
    memcpy(s->token, TOKEN, sizeof TOKEN);
    memcpy(s->in, in, sizeof in);
    memcpy(s->start, start, sizeof start);
    for (i = 0; i < NU; i++)
        s->u[i] = (real)start[i];
    @P@_init(&s->law);
}

static double time_of(const state_t *s)
{
    return s->begin + s->ticks * T_S;
}

/* One tick. The first one whose inputs are accepted sets the states so that the outputs begin where
 * they were told to; until then they stay there, and the reason says what is wrong. */
static void tick(state_t *s)
{
    static const real trend[@N_ROWS@] = {0};
    real ref[NREF], y[NY], own[@N_ROWS@];
    int i;
    for (i = 0; i < NREF; i++)
        ref[i] = (real)s->in[i];
    for (i = 0; i < NY; i++)
        y[i] = (real)s->in[NREF + i];
    s->ticks += 1;
    if (!s->started) {
        for (i = 0; i < @N_ROWS@; i++)
            own[i] = s->u[i];
        s->reason = @P@_settle(&s->law, ref, y, own, trend@E_IN_USE@);
        if (s->reason != @GUARD@_OK)
            return;
        s->started = 1;
    }
    s->reason = @P@_step(&s->law, ref, y, s->u);
}

/* The ticks of a communication step of h seconds at time t; NULL, or why there are none. */
static const char *step(state_t *s, double t, double h)
{
    double n = floor(h / T_S + 0.5);
    if (s->mode != STEPS)
        return "a step comes after the initialisation";
    if (!(n >= 1 && fabs(h - n * T_S) <= 1e-3 * T_S))
        return "the communication step is not a whole number of ticks of @T_S@ s";
    if (!(fabs(t - time_of(s)) <= 0.5 * T_S))
        return "the communication step does not begin where the last one ended";
    for (; n > 0; n -= 1)
        tick(s);
    return NULL;
}

static const char *begin(state_t *s, double t)
{
    if (s->mode != MADE_READY)
        return "the initialisation comes first, and once";
    s->begin = t;
    s->mode = INITIALISES;
    return NULL;
}

static const char *begun(state_t *s)
{
    if (s->mode != INITIALISES)
        return "there is no initialisation to leave";
    s->mode = STEPS;
    return NULL;
}

/* The value of a number; NULL, or why there is none. */
static const char *get_number(const state_t *s, unsigned k, double *value)
{
    if (k >= END || k == REASON)
        return "no real variable has this value reference";
    if (k >= START)
        *value = s->start[k - START];
    else if (k >= OUT)
        *value = s->mode == STEPS ? (double)s->u[k - OUT] : s->start[k - OUT];
    else
        *value = k >= IN ? s->in[k - IN] : time_of(s);
    return NULL;
}

static const char *set_number(state_t *s, unsigned k, double value)
{
    if (k >= IN && k < OUT) {
        s->in[k - IN] = value;
        return NULL;
    }
    if (k < START || k >= END)
        return "no input and no parameter has this value reference";
    k -= START;
    if (s->mode == STEPS)
        return "a parameter is set before the end of the initialisation";
    if (!(value >= start_low[k] && value <= start_high[k]))
        return "a parameter is out of its range";
    s->start[k] = value;
    s->u[k] = (real)value;
    return NULL;
}

#endif
