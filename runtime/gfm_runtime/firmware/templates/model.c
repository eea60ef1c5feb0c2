/* @LAW_NAME@ as a real-code model of the IEEE/CIGRE interface. @MADE@
 *
 * Inputs and outputs are real64 in p.u. All that changes is in the states that the tool owns. */
#include "IEEE_Cigre_DLLInterface.h"
#include "@P@.h"

#include <stddef.h>
#include <stdio.h>
#include <string.h>

typedef @P@_t law_t;
typedef @P@_real real;

enum { NREF = @GUARD@_NREF, NY = @GUARD@_NY, NU = @GUARD@_NU };

@FIRST@
/* @if whole@ */
/* the instance as a whole, and the u in use, are kept as words */
typedef struct {
    law_t law;
    real u[NOUT];
/* @if tuned@ */
    @P@_gains_t gains; /* in force, or refused */
/* @end@ */
} kept_t;
enum { STARTED, KEPT, INTS = KEPT + (sizeof(kept_t) + sizeof(int32_T) - 1) / sizeof(int32_T) };
/* @else@ */
/* real states: those of the law, which are the first members of its instance, and the u in use */
enum { LAW_REALS = offsetof(law_t, @FIRST_INT@) / sizeof(real), REALS = LAW_REALS + NOUT };
enum { STARTED, REASON, CHANNEL, LIMITED, INTS };
/* @end@ */

static const IEEE_Cigre_DLLInterface_Signal inputs[] = {
@INPUTS@
};

static const IEEE_Cigre_DLLInterface_Signal outputs[] = {
@OUTPUTS@
    {"reason", @REASON@, "", @REAL64@, 1},
};

/* @if tuned@ */
static const IEEE_Cigre_DLLInterface_Parameter parameters[] = {
@PARAMETERS@
};

/* @end@ */
static const IEEE_Cigre_DLLInterface_Model_Info info = {
    .DLLInterfaceVersion = {1, 1, 0, 0},
    .ModelName = @NAME@,
    .ModelVersion = @VERSION@,
    .ModelDescription = @TITLE@,
    .GeneralInformation = @SOURCE@,
    .ModelCreated = "",
    .ModelCreator = "gfmhil firmware dll",
    .ModelLastModifiedDate = "",
    .ModelLastModifiedBy = "",
    .ModelModifiedComment = "",
    .ModelModifiedHistory = "",
    .FixedStepBaseSampleTime = @T_S@,
    .EMT_RMS_Mode = 1,
    .NumInputPorts = NREF + NIN,
    .InputPortsInfo = inputs,
    .NumOutputPorts = NOUT + 1,
    .OutputPortsInfo = outputs,
/* @if tuned@ */
    .NumParameters = @GUARD@_NGAINS,
    .ParametersInfo = parameters,
/* @else@ */
    .NumParameters = 0,
    .ParametersInfo = NULL,
/* @end@ */
    .NumIntStates = INTS,
    .NumFloatStates = @FLOATS@,
    .NumDoubleStates = @DOUBLES@,
};

const IEEE_Cigre_DLLInterface_Model_Info *Model_GetInfo(void)
{
    return &info;
}

int32_T Model_PrintInfo(void)
{
    printf("%s: %s (%s)\n", info.ModelName, info.ModelDescription, info.ModelVersion);
    return IEEE_Cigre_DLLInterface_Return_OK;
}

int32_T Model_FirstCall(IEEE_Cigre_DLLInterface_Instance *instance)
{
    (void)instance;
    return IEEE_Cigre_DLLInterface_Return_OK;
}

/* @if tuned@ */
/* Other gains than those in force; what is wrong with them, or NULL. */
static const char *tune(const IEEE_Cigre_DLLInterface_Instance *instance, law_t *s, @P@_gains_t *last)
{
    static char text[80];
    @P@_gains_t gains;
    int why;
    if (instance->Parameters == NULL)
        return NULL;
    memcpy(&gains, instance->Parameters, sizeof gains);
    if (memcmp(&gains, last, sizeof gains) == 0)
        return NULL;
    *last = gains;
    why = @P@_tune(s, &gains);
    if (why == 0)
        return NULL;
    if (why > @GUARD@_NGAINS)
        return "these gains together give no stable law";
    (void)snprintf(text, sizeof text, "the gain %.40s is out of range", parameters[why - 1].Name);
    return text;
}

/* @end@ */
int32_T Model_CheckParameters(IEEE_Cigre_DLLInterface_Instance *instance)
{
/* @if tuned@ */
    law_t s;
    @P@_gains_t gains = @P@_gains;
    @P@_init(&s);
    instance->LastErrorMessage = tune(instance, &s, &gains);
    if (instance->LastErrorMessage != NULL)
        return IEEE_Cigre_DLLInterface_Return_Error;
/* @else@ */
    (void)instance;
/* @end@ */
    return IEEE_Cigre_DLLInterface_Return_OK;
}

static void load(const IEEE_Cigre_DLLInterface_Instance *instance, law_t *s, real u[]@GAINS_OUT@)
{
/* @if whole@ */
    kept_t kept;
    memcpy(&kept, instance->IntStates + KEPT, sizeof kept);
    *s = kept.law;
    memcpy(u, kept.u, sizeof kept.u);
/* @if tuned@ */
    *gains = kept.gains;
/* @end@ */
/* @else@ */
    const real *states = instance->@STATES@;
    memcpy(s, states, LAW_REALS * sizeof(real));
    memcpy(u, states + LAW_REALS, NOUT * sizeof(real));
    s->reason = instance->IntStates[REASON];
    s->channel = instance->IntStates[CHANNEL];
/* @if stages@ */
    s->limited = instance->IntStates[LIMITED];
/* @end@ */
/* @end@ */
}

static void store(
    const IEEE_Cigre_DLLInterface_Instance *instance, const law_t *s, const real u[]@GAINS_IN@)
{
/* @if whole@ */
    kept_t kept;
    kept.law = *s;
    memcpy(kept.u, u, sizeof kept.u);
/* @if tuned@ */
    kept.gains = *gains;
/* @end@ */
    memcpy(instance->IntStates + KEPT, &kept, sizeof kept);
/* @else@ */
    real *states = instance->@STATES@;
    memcpy(states, s, LAW_REALS * sizeof(real));
    memcpy(states + LAW_REALS, u, NOUT * sizeof(real));
    instance->IntStates[REASON] = s->reason;
    instance->IntStates[CHANNEL] = s->channel;
/* @if stages@ */
    instance->IntStates[LIMITED] = s->limited;
/* @end@ */
/* @end@ */
}

static void give(IEEE_Cigre_DLLInterface_Instance *instance, const real u[], int reason)
{
    real64_T *out = instance->ExternalOutputs;
    int i;
    for (i = 0; i < NOUT; i++)
        out[i] = (real64_T)u[i];
    out[NOUT] = reason;
}

/* The tool gives in ExternalOutputs where the outputs shall begin. If they are not in the ranges of the
 * signal table, they begin at its defaults. */
int32_T Model_Initialize(IEEE_Cigre_DLLInterface_Instance *instance)
{
    static const real64_T low[] = {@U_LOW@}, high[] = {@U_HIGH@};
    static const real start[] = {@U_START@};
    const real64_T *out = instance->ExternalOutputs;
    law_t s;
    real u[NOUT] = {0};
/* @if tuned@ */
    @P@_gains_t gains = @P@_gains;
/* @end@ */
    int i, good = 1;
    for (i = 0; i < NU; i++)
        good = good && out[i] >= low[i] && out[i] <= high[i];
    for (i = 0; i < NU; i++)
        u[i] = good ? (real)out[i] : start[i];
    @P@_init(&s);
/* @if tuned@ */
    instance->LastErrorMessage = tune(instance, &s, &gains);
    if (instance->LastErrorMessage != NULL)
        return IEEE_Cigre_DLLInterface_Return_Error;
/* @end@ */
    instance->IntStates[STARTED] = 0;
/* @if whole@ */
/* @else@ */
    instance->IntStates[LIMITED] = 0;
/* @end@ */
    store(instance, &s, u@GAINS@);
    give(instance, u, @GUARD@_OK);
    return IEEE_Cigre_DLLInterface_Return_OK;
}

/* One tick. The first one whose inputs are accepted sets the states so that the outputs begin where
 * Model_Initialize was told; until then they stay there, and reason says what is wrong. */
int32_T Model_Outputs(IEEE_Cigre_DLLInterface_Instance *instance)
{
    const real64_T *in = instance->ExternalInputs;
    law_t s;
    real ref[NREF], y[NIN], u[NOUT];
/* @if tuned@ */
    @P@_gains_t gains;
    const char *problem;
/* @end@ */
    int i, before, reason;
    for (i = 0; i < NREF; i++)
        ref[i] = (real)in[i];
    for (i = 0; i < NIN; i++)
        y[i] = (real)in[NREF + i];
    load(instance, &s, u@GAINS@);
/* @if tuned@ */
    problem = tune(instance, &s, &gains);
/* @end@ */
    if (!instance->IntStates[STARTED]) {
        reason = begin(&s, ref, y, u);
        if (reason != @GUARD@_OK) {
/* @if tuned@ */
            store(instance, &s, u, &gains);
/* @end@ */
            give(instance, u, reason);
            return IEEE_Cigre_DLLInterface_Return_OK;
        }
        instance->IntStates[STARTED] = 1;
    }
    before = s.reason;
    reason = go_on(&s, ref, y, u);
    store(instance, &s, u@GAINS@);
    give(instance, u, reason);
/* @if tuned@ */
    if (problem != NULL) {
        instance->LastGeneralMessage = problem; /* the old gains stay */
        return IEEE_Cigre_DLLInterface_Return_Message;
    }
/* @end@ */
    if (reason != before) {
        instance->LastGeneralMessage = "safe state; the output reason says why";
        return IEEE_Cigre_DLLInterface_Return_Message;
    }
    return IEEE_Cigre_DLLInterface_Return_OK;
}

int32_T Model_Iterate(IEEE_Cigre_DLLInterface_Instance *instance)
{
    (void)instance; /* for RMS tools only */
    return IEEE_Cigre_DLLInterface_Return_OK;
}

int32_T Model_Terminate(IEEE_Cigre_DLLInterface_Instance *instance)
{
    (void)instance;
    return IEEE_Cigre_DLLInterface_Return_OK;
}
