/* A real-code model that is not ours: a droop in SI units with ports of several types and widths, which
 * leaves out all that a model may leave out. At tick `at` it does `what`: 1 fails, 2 gives a frequency
 * that is no number, 3 blocks. */
#include "IEEE_Cigre_DLLInterface.h"

#include <math.h>
#include <stddef.h>

typedef struct {
    real32_T dispatch[2]; /* W, var */
    int16_T mode;
    real64_T p, q; /* W, var */
} inputs_t;

typedef struct {
    uint8_T block;
    real64_T f; /* Hz */
    real32_T amplitude; /* V */
} outputs_t;

typedef struct {
    real64_T droop; /* Hz/W */
    int32_T at;
    int8_T what;
} parameters_t;

#define REAL64 IEEE_Cigre_DLLInterface_DataType_real64_T
#define REAL32 IEEE_Cigre_DLLInterface_DataType_real32_T

static const IEEE_Cigre_DLLInterface_Signal inputs[] = {
    {"dispatch", "", "W, var", REAL32, 2},
    {"mode", "", "", IEEE_Cigre_DLLInterface_DataType_int16_T, 1},
    {"p", "", "W", REAL64, 1},
    {"q", "", "var", REAL64, 1},
};

static const IEEE_Cigre_DLLInterface_Signal outputs[] = {
    {"block", "", "", IEEE_Cigre_DLLInterface_DataType_uint8_T, 1},
    {"f", "", "Hz", REAL64, 1},
    {"amplitude", "", "V", REAL32, 1},
};

static const IEEE_Cigre_DLLInterface_Parameter parameters[] = {
    {.Name = "droop", .DataType = REAL64, .DefaultValue.Real64_Val = 1e-4},
    {.Name = "at", .DataType = IEEE_Cigre_DLLInterface_DataType_int32_T, .DefaultValue.Int32_Val = -1},
    {.Name = "what", .DataType = IEEE_Cigre_DLLInterface_DataType_int8_T},
};

static const IEEE_Cigre_DLLInterface_Model_Info info = {
    .DLLInterfaceVersion = {1, 1, 0, 0},
    .ModelName = "droop of others",
    .FixedStepBaseSampleTime = 2e-4,
    .EMT_RMS_Mode = 1,
    .NumInputPorts = 4,
    .InputPortsInfo = inputs,
    .NumOutputPorts = 3,
    .OutputPortsInfo = outputs,
    .NumParameters = 3,
    .ParametersInfo = parameters,
    .NumIntStates = 1,
    .NumDoubleStates = 1,
};

const IEEE_Cigre_DLLInterface_Model_Info *Model_GetInfo(void)
{
    return &info;
}

int32_T Model_Initialize(IEEE_Cigre_DLLInterface_Instance *instance)
{
    const parameters_t *set = instance->Parameters;
    if (set->droop <= 0) {
        instance->LastErrorMessage = "the droop must be positive";
        return IEEE_Cigre_DLLInterface_Return_Error;
    }
    instance->DoubleStates[0] = NAN;
    return IEEE_Cigre_DLLInterface_Return_OK;
}

int32_T Model_Outputs(IEEE_Cigre_DLLInterface_Instance *instance)
{
    const parameters_t *set = instance->Parameters;
    const inputs_t *in = instance->ExternalInputs;
    outputs_t *out = instance->ExternalOutputs;
    real64_T *p = instance->DoubleStates;
    *p = isnan(*p) ? in->p : *p + 0.01 * (in->p - *p);
    out->f = 50 + set->droop * (in->dispatch[0] - *p);
    out->amplitude = (real32_T)(400 + 0.0005 * (in->dispatch[1] - in->q));
    out->block = in->mode != 7;
    if (instance->IntStates[0]++ == set->at) {
        if (set->what == 1) {
            instance->LastErrorMessage = "the sun is down";
            return IEEE_Cigre_DLLInterface_Return_Error;
        }
        if (set->what == 2)
            out->f = NAN;
        if (set->what == 3)
            out->block = 1;
    }
    return IEEE_Cigre_DLLInterface_Return_OK;
}
