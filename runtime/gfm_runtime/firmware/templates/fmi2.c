/* The FMI 2 interface of @LAW_NAME@, for co-simulation. @MADE@ */
#include "fmi2Functions.h"
#include "fmu.h"

#include <stdio.h>

typedef struct {
    state_t now;
    fmi2CallbackLogger log;
    fmi2ComponentEnvironment environment;
    char name[128];
} instance_t;

static fmi2Status say(instance_t *it, fmi2Status status, const char *text)
{
    if (it != NULL && it->log != NULL)
        it->log(it->environment, it->name, status,
            status == fmi2Warning ? "logStatusWarning" : "logStatusError", text);
    return status;
}

/* OK, or an error with its cause. */
static fmi2Status told(instance_t *it, const char *problem)
{
    return problem == NULL ? fmi2OK : say(it, fmi2Error, problem);
}

static fmi2Status lacks(void *it, const char *function)
{
    char text[120];
    (void)snprintf(text, sizeof text, "%s: this FMU has no such variable or function", function);
    return say(it, fmi2Error, text);
}

const char *fmi2GetVersion(void)
{
    return fmi2Version;
}

const char *fmi2GetTypesPlatform(void)
{
    return fmi2TypesPlatform;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String token, fmi2String resources,
    const fmi2CallbackFunctions *call, fmi2Boolean visible, fmi2Boolean logging)
{
    instance_t *it = calloc(1, sizeof *it);
    (void)resources;
    (void)visible;
    (void)logging; /* there is a message only for a mistake, and for the safe state */
    if (it == NULL)
        return NULL;
    (void)snprintf(it->name, sizeof it->name, "%s", name);
    it->log = call->logger;
    it->environment = call->componentEnvironment;
    if (type != fmi2CoSimulation || strcmp(token, TOKEN) != 0) {
        (void)say(it, fmi2Error, "this FMU is for co-simulation, and its GUID is " TOKEN);
        free(it);
        return NULL;
    }
    make_ready(&it->now);
    return it;
}

void fmi2FreeInstance(fmi2Component c)
{
    free(c);
}

fmi2Status fmi2SetDebugLogging(
    fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[])
{
    (void)c;
    (void)on;
    (void)n;
    (void)categories;
    return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean tolerant, fmi2Real tolerance, fmi2Real start,
    fmi2Boolean stops, fmi2Real stop)
{
    instance_t *it = c;
    (void)tolerant;
    (void)tolerance;
    (void)stops;
    (void)stop;
    it->now.begin = start;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    instance_t *it = c;
    return told(it, begin(&it->now, it->now.begin));
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    instance_t *it = c;
    return told(it, begun(&it->now));
}

fmi2Status fmi2Terminate(fmi2Component c)
{
    (void)c;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c)
{
    make_ready(&((instance_t *)c)->now);
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Real value[])
{
    instance_t *it = c;
    const char *problem = NULL;
    size_t k;
    for (k = 0; k < nvr && problem == NULL; k++)
        problem = get_number(&it->now, vr[k], &value[k]);
    return told(it, problem);
}

fmi2Status fmi2SetReal(
    fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Real value[])
{
    instance_t *it = c;
    const char *problem = NULL;
    size_t k;
    for (k = 0; k < nvr && problem == NULL; k++)
        problem = set_number(&it->now, vr[k], value[k]);
    return told(it, problem);
}

fmi2Status fmi2GetInteger(
    fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Integer value[])
{
    instance_t *it = c;
    size_t k;
    for (k = 0; k < nvr; k++) {
        if (vr[k] != REASON)
            return say(it, fmi2Error, "no integer has this value reference");
        value[k] = it->now.reason;
    }
    return fmi2OK;
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean for_good)
{
    instance_t *it = c;
    int before = it->now.law.reason;
    const char *problem = step(&it->now, t, h);
    (void)for_good;
    if (problem == NULL && it->now.law.reason != before)
        return say(it, fmi2Warning, "safe state; the output reason says why");
    return told(it, problem);
}

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *FMUstate)
{
    if (*FMUstate == NULL)
        *FMUstate = malloc(sizeof(state_t));
    if (*FMUstate == NULL)
        return say(c, fmi2Error, "out of memory");
    memcpy(*FMUstate, &((instance_t *)c)->now, sizeof(state_t));
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate FMUstate)
{
    memcpy(&((instance_t *)c)->now, FMUstate, sizeof(state_t));
    return fmi2OK;
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *FMUstate)
{
    (void)c;
    free(*FMUstate);
    *FMUstate = NULL;
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate FMUstate, size_t *size)
{
    (void)c;
    (void)FMUstate;
    *size = sizeof(state_t);
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate FMUstate, fmi2Byte bytes[], size_t size)
{
    if (size < sizeof(state_t))
        return say(c, fmi2Error, "the memory is too small for the state");
    memcpy(bytes, FMUstate, sizeof(state_t));
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *FMUstate)
{
    if (size < sizeof(state_t) || memcmp(bytes, TOKEN, sizeof TOKEN) != 0)
        return say(c, fmi2Error, "these bytes are no state of this FMU");
    if (*FMUstate == NULL)
        *FMUstate = malloc(sizeof(state_t));
    if (*FMUstate == NULL)
        return say(c, fmi2Error, "out of memory");
    memcpy(*FMUstate, bytes, sizeof(state_t));
    return fmi2OK;
}

/* What the standard has besides, and this FMU has not. */
@REFUSALS@