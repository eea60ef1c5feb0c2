/* The FMI @FMI@ interface of @LAW_NAME@, for co-simulation. @MADE@ */
#include "@P@.h"
#include "fmi@FMI@Functions.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef @P@_t law_t;
typedef @P@_real real;

#define TOKEN "@TOKEN@"
#define T_S @T_S@

/* Value references: 0 is the time; then the inputs (references, measurements), the outputs, the result
 * of the last tick, where the outputs begin, and the gains. */
enum { NREF = @GUARD@_NREF, NY = @GUARD@_NY, NU = @GUARD@_NU };

@FIRST@
/* @if tuned@ */
enum { NGAINS = @GUARD@_NGAINS };
/* @else@ */
enum { NGAINS = 0 };
/* @end@ */
enum { TIME, IN, OUT = IN + NREF + NIN, REASON = OUT + NOUT, START, GAIN = START + NU, END = GAIN + NGAINS };
enum { INSTANTIATED, INITIALIZATION, STEPPING };

/* All that changes in an instance. It is copied as a whole, and holds no pointer. */
typedef struct {
    char token[sizeof TOKEN]; /* so that another FMU's state is refused */
    law_t law;
    real u[NOUT];
    double in[NREF + NIN], start[NU];
/* @if tuned@ */
    double gains[NGAINS];
    int tunes; /* whether they are new */
/* @end@ */
    double begin, ticks; /* time of tick 0, s, and ticks since */
    int reason, started, mode;
} state_t;

static const double start_low[] = {@U_LOW@}, start_high[] = {@U_HIGH@};

/* @if tuned@ */
static const double gain_low[] = {@GAIN_LOW@}, gain_high[] = {@GAIN_HIGH@};

/* @end@ */
static void reset_state(state_t *s)
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
/* @if tuned@ */
    memcpy(s->gains, &@P@_gains, sizeof s->gains);
/* @end@ */
}

static double time_of(const state_t *s)
{
    return s->begin + s->ticks * T_S;
}

/* One tick. The first one whose inputs are accepted sets the states so that the outputs begin at their
 * start values; until then they stay there, and the reason says what is wrong. */
static void tick(state_t *s)
{
    real ref[NREF], y[NIN];
    int i;
    for (i = 0; i < NREF; i++)
        ref[i] = (real)s->in[i];
    for (i = 0; i < NIN; i++)
        y[i] = (real)s->in[NREF + i];
    s->ticks += 1;
    if (!s->started) {
        s->reason = begin(&s->law, ref, y, s->u);
        if (s->reason != @GUARD@_OK)
            return;
        s->started = 1;
    }
    s->reason = go_on(&s->law, ref, y, s->u);
}

/* The ticks of a communication step of h seconds at time t; NULL, or why there are none. */
static const char *step(state_t *s, double t, double h)
{
    double n = floor(h / T_S + 0.5);
    if (s->mode != STEPPING)
        return "a step comes after the initialisation";
    if (!(n >= 1 && fabs(h - n * T_S) <= 1e-3 * T_S))
        return "the communication step is not a whole number of ticks of @T_S@ s";
    if (!(fabs(t - time_of(s)) <= 0.5 * T_S))
        return "the communication step does not begin where the last one ended";
/* @if tuned@ */
    if (s->tunes) {
        @P@_gains_t gains;
        memcpy(&gains, s->gains, sizeof gains);
        s->tunes = 0;
        if (@P@_tune(&s->law, &gains) != 0)
            return "these gains together give no stable law; the old ones stay";
    }
/* @end@ */
    for (; n > 0; n -= 1)
        tick(s);
    return NULL;
}

/* The value of a number; NULL, or why there is none. */
static const char *get_number(const state_t *s, unsigned k, double *value)
{
    if (k >= END || k == REASON)
        return "no real variable has this value reference";
/* @if tuned@ */
    if (k >= GAIN) {
        *value = s->gains[k - GAIN];
        return NULL;
    }
/* @end@ */
    if (k >= START)
        *value = s->start[k - START];
    else if (k >= OUT)
        *value = s->mode == STEPPING || k >= OUT + NU ? (double)s->u[k - OUT] : s->start[k - OUT];
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
/* @if tuned@ */
    if (k >= GAIN) {
        k -= GAIN;
        if (!(value >= gain_low[k] && value <= gain_high[k]))
            return "a gain is out of its range";
        s->tunes |= value != s->gains[k];
        s->gains[k] = value;
        return NULL;
    }
/* @end@ */
    k -= START;
    if (s->mode == STEPPING)
        return "a parameter is set before the end of the initialisation";
    if (!(value >= start_low[k] && value <= start_high[k]))
        return "a parameter is out of its range";
    s->start[k] = value;
    s->u[k] = (real)value;
    return NULL;
}

/* --- the interface --- */

typedef struct {
    state_t now;
/* @if fmi2@ */
    fmi2CallbackLogger log;
    fmi2ComponentEnvironment environment;
    char name[128];
/* @else@ */
    fmi3LogMessageCallback log;
    fmi3InstanceEnvironment environment;
/* @end@ */
} instance_t;

/* @if xcp@ */
/* The A2L file has the addresses of this one, the first of a process; others are on the heap. */
static instance_t first_instance;
static char taken;

static instance_t *new_instance(void)
{
    if (__sync_lock_test_and_set(&taken, 1))
        return calloc(1, sizeof(instance_t));
    memset(&first_instance, 0, sizeof first_instance);
    return &first_instance;
}

static void free_instance(instance_t *it)
{
    if (it == &first_instance)
        __sync_lock_release(&taken);
    else
        free(it);
}

/* @end@ */
static @F@Status log_message(instance_t *it, @F@Status status, const char *text)
{
    if (it != NULL && it->log != NULL)
        it->log(it->environment@NAME@, status,
            status == @F@Warning ? "logStatusWarning" : "logStatusError", text);
    return status;
}

/* OK, or an error with its cause. */
static @F@Status status_of(instance_t *it, const char *problem)
{
    return problem == NULL ? @F@OK : log_message(it, @F@Error, problem);
}

static @F@Status unsupported(void *it, const char *function)
{
    char text[120];
    (void)snprintf(text, sizeof text, "%s: this FMU has no such variable or function", function);
    return log_message(it, @F@Error, text);
}

const char *@F@GetVersion(void)
{
    return @F@Version;
}

/* @if fmi2@ */
const char *fmi2GetTypesPlatform(void)
{
    return fmi2TypesPlatform;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String token, fmi2String resources,
    const fmi2CallbackFunctions *call, fmi2Boolean visible, fmi2Boolean logging)
{
    instance_t *it = @NEW@;
    (void)resources;
    (void)visible;
    (void)logging; /* there is a message only for a mistake, and for the safe state */
    if (it == NULL)
        return NULL;
    (void)snprintf(it->name, sizeof it->name, "%s", name);
    it->log = call->logger;
    it->environment = call->componentEnvironment;
    if (type != fmi2CoSimulation || strcmp(token, TOKEN) != 0) {
        (void)log_message(it, fmi2Error, "this FMU is for co-simulation, and its GUID is " TOKEN);
        @FREE@(it);
        return NULL;
    }
    reset_state(&it->now);
    return it;
}
/* @else@ */
fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources,
    fmi3Boolean visible, fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early,
    const fmi3ValueReference wanted[], size_t n_wanted, fmi3InstanceEnvironment environment,
    fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update)
{
    instance_t *it = @NEW@;
    (void)name;
    (void)resources;
    (void)visible;
    (void)logging; /* there is a message only for a mistake, and for the safe state */
    (void)events;
    (void)early;
    (void)wanted;
    (void)n_wanted;
    (void)update;
    if (it == NULL)
        return NULL;
    it->log = log;
    it->environment = environment;
    if (strcmp(token, TOKEN) != 0) {
        (void)log_message(it, fmi3Error, "the instantiation token of this FMU is " TOKEN);
        @FREE@(it);
        return NULL;
    }
    reset_state(&it->now);
    return it;
}
/* @end@ */

void @F@FreeInstance(@F@@INSTANCE@ instance)
{
    @FREE@(instance);
}

@F@Status @F@SetDebugLogging(
    @F@@INSTANCE@ instance, @F@Boolean on, size_t n, const @F@String categories[])
{
    (void)instance;
    (void)on;
    (void)n;
    (void)categories;
    return @F@OK;
}

/* @if fmi2@ */
fmi2Status fmi2SetupExperiment(fmi2Component instance, fmi2Boolean tolerant, fmi2Real tolerance,
    fmi2Real start, fmi2Boolean stops, fmi2Real stop)
/* @else@ */
fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean tolerant,
    fmi3Float64 tolerance, fmi3Float64 start, fmi3Boolean stops, fmi3Float64 stop)
/* @end@ */
{
    state_t *s = &((instance_t *)instance)->now;
    (void)tolerant;
    (void)tolerance;
    (void)stops;
    (void)stop;
/* @if fmi2@ */
    s->begin = start;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component instance)
{
    state_t *s = &((instance_t *)instance)->now;
    if (s->mode != INSTANTIATED)
        return status_of(instance, "the initialisation comes first, and once");
/* @else@ */
    if (s->mode != INSTANTIATED)
        return status_of(instance, "the initialisation comes first, and once");
    s->begin = start;
/* @end@ */
    s->mode = INITIALIZATION;
    return @F@OK;
}

@F@Status @F@ExitInitializationMode(@F@@INSTANCE@ instance)
{
    state_t *s = &((instance_t *)instance)->now;
    if (s->mode != INITIALIZATION)
        return status_of(instance, "there is no initialisation to leave");
    s->mode = STEPPING;
    return @F@OK;
}

@F@Status @F@Terminate(@F@@INSTANCE@ instance)
{
    (void)instance;
    return @F@OK;
}

@F@Status @F@Reset(@F@@INSTANCE@ instance)
{
    reset_state(&((instance_t *)instance)->now);
    return @F@OK;
}

@F@Status @F@Get@REAL@(@F@@INSTANCE@ instance, const @F@ValueReference vr[], size_t nvr,
    @F@@REAL@ values[]@COUNT@)
{
    instance_t *it = instance;
    const char *problem = @TOO_FEW@;
    size_t k;
    for (k = 0; k < nvr && problem == NULL; k++)
        problem = get_number(&it->now, vr[k], &values[k]);
    return status_of(it, problem);
}

@F@Status @F@Set@REAL@(@F@@INSTANCE@ instance, const @F@ValueReference vr[], size_t nvr,
    const @F@@REAL@ values[]@COUNT@)
{
    instance_t *it = instance;
    const char *problem = @TOO_FEW@;
    size_t k;
    for (k = 0; k < nvr && problem == NULL; k++)
        problem = set_number(&it->now, vr[k], values[k]);
    return status_of(it, problem);
}

@F@Status @F@Get@INTEGER@(@F@@INSTANCE@ instance, const @F@ValueReference vr[], size_t nvr,
    @F@@INTEGER@ values[]@COUNT@)
{
    instance_t *it = instance;
    const char *problem = @TOO_FEW@;
    size_t k;
    for (k = 0; k < nvr && problem == NULL; k++) {
        if (vr[k] != REASON)
            problem = "no integer has this value reference";
        else
            values[k] = it->now.reason;
    }
    return status_of(it, problem);
}

/* @if fmi2@ */
fmi2Status fmi2DoStep(fmi2Component instance, fmi2Real t, fmi2Real h, fmi2Boolean for_good)
/* @else@ */
fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 t, fmi3Float64 h, fmi3Boolean for_good,
    fmi3Boolean *event, fmi3Boolean *ends, fmi3Boolean *early, fmi3Float64 *reached)
/* @end@ */
{
    instance_t *it = instance;
    int before = it->now.law.reason;
    const char *problem = step(&it->now, t, h);
    (void)for_good;
/* @if fmi2@ */
/* @else@ */
    *event = *ends = *early = fmi3False;
    *reached = time_of(&it->now);
/* @end@ */
    if (problem == NULL && it->now.law.reason != before)
        return log_message(it, @F@Warning, "safe state; the output reason says why");
    return status_of(it, problem);
}

/* A copy of a state, in memory that this FMU owns. */
static @F@Status copy_state(instance_t *it, @F@@STATE@ *to, const void *from)
{
    if (*to == NULL)
        *to = malloc(sizeof(state_t));
    if (*to == NULL)
        return log_message(it, @F@Error, "out of memory");
    memcpy(*to, from, sizeof(state_t));
    return @F@OK;
}

@F@Status @F@Get@STATE@(@F@@INSTANCE@ instance, @F@@STATE@ *state)
{
    return copy_state(instance, state, &((instance_t *)instance)->now);
}

@F@Status @F@Set@STATE@(@F@@INSTANCE@ instance, @F@@STATE@ state)
{
    memcpy(&((instance_t *)instance)->now, state, sizeof(state_t));
    return @F@OK;
}

@F@Status @F@Free@STATE@(@F@@INSTANCE@ instance, @F@@STATE@ *state)
{
    (void)instance;
    free(*state);
    *state = NULL;
    return @F@OK;
}

@F@Status @F@Serialized@STATE@Size(@F@@INSTANCE@ instance, @F@@STATE@ state, size_t *size)
{
    (void)instance;
    (void)state;
    *size = sizeof(state_t);
    return @F@OK;
}

@F@Status @F@Serialize@STATE@(
    @F@@INSTANCE@ instance, @F@@STATE@ state, @F@Byte bytes[], size_t size)
{
    if (size < sizeof(state_t))
        return log_message(instance, @F@Error, "the memory is too small for the state");
    memcpy(bytes, state, sizeof(state_t));
    return @F@OK;
}

@F@Status @F@@DESERIALIZE@@STATE@(
    @F@@INSTANCE@ instance, const @F@Byte bytes[], size_t size, @F@@STATE@ *state)
{
    if (size < sizeof(state_t) || memcmp(bytes, TOKEN, sizeof TOKEN) != 0)
        return log_message(instance, @F@Error, "these bytes are no state of this FMU");
    return copy_state(instance, state, bytes);
}

/* What the standard has besides, and this FMU has not. */
@REFUSALS@
