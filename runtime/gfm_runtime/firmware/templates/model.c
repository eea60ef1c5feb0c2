/* @LAW_NAME@ as a real-code model of the IEEE/CIGRE interface. @MADE@
 *
 * Inputs and outputs are real64 in p.u. All that changes is in the states that the tool owns. The law
 * has its gains as constants, so there are no parameters. */
#include "IEEE_Cigre_DLLInterface.h"
#include "@P@.h"

#include <stddef.h>
#include <stdio.h>
#include <string.h>

typedef @P@_t law_t;
typedef @P@_real real;

enum { NREF = @GUARD@_NREF, NY = @GUARD@_NY, NU = @GUARD@_NU };

@FIRST@
/* @if schedule@ */
/* the instance as a whole, and the u in use, are kept as words */
typedef struct {
    law_t law;
    real u[NOUT];
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
    .NumParameters = 0,
    .ParametersInfo = NULL,
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

int32_T Model_CheckParameters(IEEE_Cigre_DLLInterface_Instance *instance)
{
    (void)instance;
    return IEEE_Cigre_DLLInterface_Return_OK;
}

static void load(const IEEE_Cigre_DLLInterface_Instance *instance, law_t *s, real u[])
{
/* @if schedule@ */
    kept_t kept;
    memcpy(&kept, instance->IntStates + KEPT, sizeof kept);
    *s = kept.law;
    memcpy(u, kept.u, sizeof kept.u);
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

static void store(const IEEE_Cigre_DLLInterface_Instance *instance, const law_t *s, const real u[])
{
/* @if schedule@ */
    kept_t kept;
    kept.law = *s;
    memcpy(kept.u, u, sizeof kept.u);
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
    int i, good = 1;
    for (i = 0; i < NU; i++)
        good = good && out[i] >= low[i] && out[i] <= high[i];
    for (i = 0; i < NU; i++)
        u[i] = good ? (real)out[i] : start[i];
    @P@_init(&s);
    instance->IntStates[STARTED] = 0;
/* @if schedule@ */
/* @else@ */
    instance->IntStates[LIMITED] = 0;
/* @end@ */
    store(instance, &s, u);
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
    int i, before, reason;
    for (i = 0; i < NREF; i++)
        ref[i] = (real)in[i];
    for (i = 0; i < NIN; i++)
        y[i] = (real)in[NREF + i];
    load(instance, &s, u);
    if (!instance->IntStates[STARTED]) {
        reason = begin(&s, ref, y, u);
        if (reason != @GUARD@_OK) {
            give(instance, u, reason);
            return IEEE_Cigre_DLLInterface_Return_OK;
        }
        instance->IntStates[STARTED] = 1;
    }
    before = s.reason;
    reason = go_on(&s, ref, y, u);
    store(instance, &s, u);
    give(instance, u, reason);
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
