/* load_model.exe MODEL.dll: loads a real-code model as a Windows program does, starts it at the outputs
 * that begin ticks.bin, steps it through the inputs after them, and writes all outputs to found.bin. */
#include "IEEE_Cigre_DLLInterface.h"

#include <stdio.h>
#include <stdlib.h>
#include <windows.h>

typedef const IEEE_Cigre_DLLInterface_Model_Info *(__cdecl *info_t)(void);
typedef int32_T(__cdecl *call_t)(IEEE_Cigre_DLLInterface_Instance *);

int main(int count, char *given[])
{
    HMODULE dll = count == 2 ? LoadLibraryA(given[1]) : NULL;
    FILE *ticks = fopen("ticks.bin", "rb"), *found = fopen("found.bin", "wb");
    IEEE_Cigre_DLLInterface_Instance now = {0};
    const IEEE_Cigre_DLLInterface_Model_Info *info;
    call_t outputs;
    if (dll == NULL || ticks == NULL || found == NULL)
        return 1;
    info = ((info_t)(void *)GetProcAddress(dll, "Model_GetInfo"))();
    outputs = (call_t)(void *)GetProcAddress(dll, "Model_Outputs");
    now.ExternalInputs = calloc((size_t)info->NumInputPorts, sizeof(real64_T));
    now.ExternalOutputs = calloc((size_t)info->NumOutputPorts, sizeof(real64_T));
    now.IntStates = calloc((size_t)info->NumIntStates + 1, sizeof(int32_T));
    now.FloatStates = calloc((size_t)info->NumFloatStates + 1, sizeof(real32_T));
    now.DoubleStates = calloc((size_t)info->NumDoubleStates + 1, sizeof(real64_T));
    now.SimTool_EMT_RMS_Mode = 1;
    fread(now.ExternalOutputs, sizeof(real64_T), (size_t)info->NumOutputPorts, ticks);
    if (((call_t)(void *)GetProcAddress(dll, "Model_Initialize"))(&now) != 0)
        return 2;
    while (fread(now.ExternalInputs, sizeof(real64_T), (size_t)info->NumInputPorts, ticks) != 0) {
        if (outputs(&now) != 0)
            return 3;
        fwrite(now.ExternalOutputs, sizeof(real64_T), (size_t)info->NumOutputPorts, found);
    }
    return 0;
}
