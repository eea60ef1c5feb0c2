/* The FMI 3 interface of @LAW_NAME@, for co-simulation. @MADE@ */
#include "fmi3Functions.h"
#include "fmu.h"

#include <stdio.h>

typedef struct {
    state_t now;
    fmi3LogMessageCallback log;
    fmi3InstanceEnvironment environment;
} instance_t;

static fmi3Status say(instance_t *it, fmi3Status status, const char *text)
{
    if (it != NULL && it->log != NULL)
        it->log(it->environment, status,
            status == fmi3Warning ? "logStatusWarning" : "logStatusError", text);
    return status;
}

/* OK, or an error with its cause. */
static fmi3Status told(instance_t *it, const char *problem)
{
    return problem == NULL ? fmi3OK : say(it, fmi3Error, problem);
}

static fmi3Status lacks(void *it, const char *function)
{
    char text[120];
    (void)snprintf(text, sizeof text, "%s: this FMU has no such variable or function", function);
    return say(it, fmi3Error, text);
}

const char *fmi3GetVersion(void)
{
    return fmi3Version;
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources,
    fmi3Boolean visible, fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early,
    const fmi3ValueReference wanted[], size_t n_wanted, fmi3InstanceEnvironment environment,
    fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update)
{
    instance_t *it = calloc(1, sizeof *it);
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
        (void)say(it, fmi3Error, "the instantiation token of this FMU is " TOKEN);
        free(it);
        return NULL;
    }
    make_ready(&it->now);
    return it;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
    fmi3Boolean visible, fmi3Boolean logging, fmi3InstanceEnvironment environment,
    fmi3LogMessageCallback log)
{
    (void)name;
    (void)token;
    (void)resources;
    (void)visible;
    (void)logging;
    (void)environment;
    (void)log;
    return NULL;
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources,
    fmi3Boolean visible, fmi3Boolean logging, fmi3InstanceEnvironment environment,
    fmi3LogMessageCallback log, fmi3ClockUpdateCallback update, fmi3LockPreemptionCallback lock,
    fmi3UnlockPreemptionCallback unlock)
{
    (void)name;
    (void)token;
    (void)resources;
    (void)visible;
    (void)logging;
    (void)environment;
    (void)log;
    (void)update;
    (void)lock;
    (void)unlock;
    return NULL;
}

void fmi3FreeInstance(fmi3Instance instance)
{
    free(instance);
}

fmi3Status fmi3SetDebugLogging(
    fmi3Instance instance, fmi3Boolean on, size_t n, const fmi3String categories[])
{
    (void)instance;
    (void)on;
    (void)n;
    (void)categories;
    return fmi3OK;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean tolerant,
    fmi3Float64 tolerance, fmi3Float64 start, fmi3Boolean stops, fmi3Float64 stop)
{
    instance_t *it = instance;
    (void)tolerant;
    (void)tolerance;
    (void)stops;
    (void)stop;
    return told(it, begin(&it->now, start));
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance)
{
    instance_t *it = instance;
    return told(it, begun(&it->now));
}

fmi3Status fmi3Terminate(fmi3Instance instance)
{
    (void)instance;
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance instance)
{
    make_ready(&((instance_t *)instance)->now);
    return fmi3OK;
}

fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference vr[], size_t nvr,
    fmi3Float64 values[], size_t n)
{
    instance_t *it = instance;
    const char *problem = n < nvr ? "fewer values than value references" : NULL;
    size_t k;
    for (k = 0; k < nvr && problem == NULL; k++)
        problem = get_number(&it->now, vr[k], &values[k]);
    return told(it, problem);
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference vr[], size_t nvr,
    const fmi3Float64 values[], size_t n)
{
    instance_t *it = instance;
    const char *problem = n < nvr ? "fewer values than value references" : NULL;
    size_t k;
    for (k = 0; k < nvr && problem == NULL; k++)
        problem = set_number(&it->now, vr[k], values[k]);
    return told(it, problem);
}

fmi3Status fmi3GetInt32(fmi3Instance instance, const fmi3ValueReference vr[], size_t nvr,
    fmi3Int32 values[], size_t n)
{
    instance_t *it = instance;
    size_t k;
    for (k = 0; k < nvr; k++) {
        if (vr[k] != REASON || k >= n)
            return say(it, fmi3Error, "no integer has this value reference");
        values[k] = it->now.reason;
    }
    return fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 t, fmi3Float64 h, fmi3Boolean for_good,
    fmi3Boolean *event, fmi3Boolean *ends, fmi3Boolean *early, fmi3Float64 *reached)
{
    instance_t *it = instance;
    int before = it->now.law.reason;
    const char *problem = step(&it->now, t, h);
    (void)for_good;
    *event = *ends = *early = fmi3False;
    *reached = time_of(&it->now);
    if (problem == NULL && it->now.law.reason != before)
        return say(it, fmi3Warning, "safe state; the output reason says why");
    return told(it, problem);
}

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *FMUState)
{
    if (*FMUState == NULL)
        *FMUState = malloc(sizeof(state_t));
    if (*FMUState == NULL)
        return say(instance, fmi3Error, "out of memory");
    memcpy(*FMUState, &((instance_t *)instance)->now, sizeof(state_t));
    return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState FMUState)
{
    memcpy(&((instance_t *)instance)->now, FMUState, sizeof(state_t));
    return fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *FMUState)
{
    (void)instance;
    free(*FMUState);
    *FMUState = NULL;
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState FMUState, size_t *size)
{
    (void)instance;
    (void)FMUState;
    *size = sizeof(state_t);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState FMUState, fmi3Byte bytes[], size_t size)
{
    if (size < sizeof(state_t))
        return say(instance, fmi3Error, "the memory is too small for the state");
    memcpy(bytes, FMUState, sizeof(state_t));
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte bytes[], size_t size, fmi3FMUState *FMUState)
{
    if (size < sizeof(state_t) || memcmp(bytes, TOKEN, sizeof TOKEN) != 0)
        return say(instance, fmi3Error, "these bytes are no state of this FMU");
    if (*FMUState == NULL)
        *FMUState = malloc(sizeof(state_t));
    if (*FMUState == NULL)
        return say(instance, fmi3Error, "out of memory");
    memcpy(*FMUState, bytes, sizeof(state_t));
    return fmi3OK;
}

/* What the standard has besides, and this FMU has not. */
@REFUSALS@