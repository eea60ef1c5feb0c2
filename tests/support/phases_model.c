/* The controller of examples/foreign_controller behind the interface of IEEE and CIGRE, written as for
 * Windows. Its period and delay are parameters. */
#include <windows.h>

#include "IEEE_Cigre_DLLInterface.h"
#include "gfmhil_controller.h"

typedef struct {
    real64_T v[3], i[3], i_o[3], v_dc, P, Q, V, omega, V_dc; /* V, A, W, var, rad/s */
} inputs_t;

typedef struct {
    real64_T e[3], i_dc; /* V, A */
} outputs_t;

#define REAL64 IEEE_Cigre_DLLInterface_DataType_real64_T

static const IEEE_Cigre_DLLInterface_Signal inputs[] = {
    {"v", "", "V", REAL64, 3},    {"i", "", "A", REAL64, 3},   {"i_o", "", "A", REAL64, 3},
    {"v_dc", "", "V", REAL64, 1}, {"P", "", "W", REAL64, 1},   {"Q", "", "var", REAL64, 1},
    {"V", "", "V", REAL64, 1},    {"w", "", "rad/s", REAL64, 1}, {"V_dc", "", "V", REAL64, 1},
};

static const IEEE_Cigre_DLLInterface_Signal outputs[] = {
    {"e", "", "V", REAL64, 3},
    {"i_dc", "", "A", REAL64, 1},
};

static const IEEE_Cigre_DLLInterface_Parameter parameters[] = {
    {.Name = "period", .DataType = REAL64, .DefaultValue.Real64_Val = 1e-4},
    {.Name = "delay", .DataType = REAL64, .DefaultValue.Real64_Val = 0.5e-4},
};

static const IEEE_Cigre_DLLInterface_Model_Info info = {
    .DLLInterfaceVersion = {1, 1, 0, 0},
    .ModelName = "phases",
    .FixedStepBaseSampleTime = 1e-4,
    .EMT_RMS_Mode = 1,
    .NumInputPorts = 9,
    .InputPortsInfo = inputs,
    .NumOutputPorts = 2,
    .OutputPortsInfo = outputs,
    .NumParameters = 2,
    .ParametersInfo = parameters,
};

static void *controller;

static gfmhil_input given(const IEEE_Cigre_DLLInterface_Instance *instance)
{
    const inputs_t *x = instance->ExternalInputs;
    gfmhil_input in = {.t = instance->Time, .v_dc = x->v_dc, .P_ref = x->P, .Q_ref = x->Q,
                       .V_ref = x->V, .omega_ref = x->omega, .V_dc_ref = x->V_dc};
    for (int k = 0; k < 3; k++) {
        in.v[k] = x->v[k];
        in.i[k] = x->i[k];
        in.i_o[k] = x->i_o[k];
    }
    return in;
}

__declspec(dllexport) const IEEE_Cigre_DLLInterface_Model_Info *__cdecl Model_GetInfo(void)
{
    return &info;
}

__declspec(dllexport) int32_T __cdecl Model_Initialize(IEEE_Cigre_DLLInterface_Instance *instance)
{
    const real64_T *set = instance->Parameters;
    const gfmhil_setup setup = {set[0], set[1], 4000, 380, 314.15926535897931, 700};
    const gfmhil_input in = given(instance);
    controller = gfmhil_new(&setup);
    return gfmhil_start(controller, &in, instance->ExternalOutputs) ? 2 : 0;
}

__declspec(dllexport) int32_T __cdecl Model_Outputs(IEEE_Cigre_DLLInterface_Instance *instance)
{
    static char message[32];
    const gfmhil_input in = given(instance);
    const int fault = gfmhil_step(controller, &in, instance->ExternalOutputs);
    sprintf_s(message, sizeof message, "fault %d", fault);
    instance->LastErrorMessage = message;
    return fault ? 2 : 0;
}
