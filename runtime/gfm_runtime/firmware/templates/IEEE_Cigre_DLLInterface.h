/* The interface of real-code models, IEEE/CIGRE (CIGRE TB 958), version 2 of its API: the layout of what
 * a model and a simulation tool exchange. @MADE@ */
#ifndef IEEE_CIGRE_DLLINTERFACE_H
#define IEEE_CIGRE_DLLINTERFACE_H

#include <stdint.h>

typedef char char_T;
typedef int8_t int8_T;
typedef uint8_t uint8_T;
typedef int16_t int16_T;
typedef uint16_t uint16_T;
typedef int32_t int32_T;
typedef uint32_t uint32_T;
typedef float real32_T;
typedef double real64_T;

enum IEEE_Cigre_DLLInterface_DataType {
    IEEE_Cigre_DLLInterface_DataType_char_T = 1,
    IEEE_Cigre_DLLInterface_DataType_int8_T = 2,
    IEEE_Cigre_DLLInterface_DataType_uint8_T = 3,
    IEEE_Cigre_DLLInterface_DataType_int16_T = 4,
    IEEE_Cigre_DLLInterface_DataType_uint16_T = 5,
    IEEE_Cigre_DLLInterface_DataType_int32_T = 6,
    IEEE_Cigre_DLLInterface_DataType_uint32_T = 7,
    IEEE_Cigre_DLLInterface_DataType_real32_T = 8,
    IEEE_Cigre_DLLInterface_DataType_real64_T = 9,
    IEEE_Cigre_DLLInterface_DataType_c_string_T = 10
};

enum IEEE_Cigre_DLLInterface_Return_Value {
    IEEE_Cigre_DLLInterface_Return_OK = 0,
    IEEE_Cigre_DLLInterface_Return_Message = 1, /* see LastGeneralMessage */
    IEEE_Cigre_DLLInterface_Return_Error = 2    /* see LastErrorMessage; the simulation ends */
};

typedef struct {
    const char_T *Name; /* a name that C allows */
    const char_T *Description;
    const char_T *Unit;
    enum IEEE_Cigre_DLLInterface_DataType DataType;
    int32_T Width;
} IEEE_Cigre_DLLInterface_Signal;

union DefaultValueU {
    char_T Char_Val;
    const char_T *Char_Ptr;
    int32_T Int32_Val;
    real32_T Real32_Val;
    real64_T Real64_Val;
};

union MinMaxValueU {
    char_T Char_Val;
    int32_T Int32_Val;
    real32_T Real32_Val;
    real64_T Real64_Val;
};

typedef struct {
    const char_T *Name;
    const char_T *GroupName;
    const char_T *Description;
    const char_T *Unit;
    enum IEEE_Cigre_DLLInterface_DataType DataType;
    int32_T FixedValue; /* 1: it cannot change after Time = 0 */
    union DefaultValueU DefaultValue;
    union MinMaxValueU MinValue;
    union MinMaxValueU MaxValue;
} IEEE_Cigre_DLLInterface_Parameter;

typedef struct {
    uint8_T DLLInterfaceVersion[4];
    const char_T *ModelName;
    const char_T *ModelVersion;
    const char_T *ModelDescription;
    const char_T *GeneralInformation;
    const char_T *ModelCreated;
    const char_T *ModelCreator;
    const char_T *ModelLastModifiedDate;
    const char_T *ModelLastModifiedBy;
    const char_T *ModelModifiedComment;
    const char_T *ModelModifiedHistory;
    real64_T FixedStepBaseSampleTime; /* s */
    uint8_T EMT_RMS_Mode;             /* 1 EMT, 2 RMS, 3 both */
    int32_T NumInputPorts;
    const IEEE_Cigre_DLLInterface_Signal *InputPortsInfo;
    int32_T NumOutputPorts;
    const IEEE_Cigre_DLLInterface_Signal *OutputPortsInfo;
    int32_T NumParameters;
    const IEEE_Cigre_DLLInterface_Parameter *ParametersInfo;
    int32_T NumIntStates;
    int32_T NumFloatStates;
    int32_T NumDoubleStates;
} IEEE_Cigre_DLLInterface_Model_Info;

/* The tool owns all memory. It may copy the states away and back between two calls. */
typedef struct {
    void *ExternalInputs;
    void *ExternalOutputs;
    void *Parameters;
    real64_T Time; /* s */
    uint8_T SimTool_EMT_RMS_Mode;
    const char_T *LastErrorMessage;
    const char_T *LastGeneralMessage;
    int32_T *IntStates;
    real32_T *FloatStates;
    real64_T *DoubleStates;
} IEEE_Cigre_DLLInterface_Instance;

#ifdef _WIN32
#define MODEL(type) __declspec(dllexport) type __cdecl
#else
#define MODEL(type) __attribute__((visibility("default"))) type
#endif

MODEL(const IEEE_Cigre_DLLInterface_Model_Info *) Model_GetInfo(void);
MODEL(int32_T) Model_PrintInfo(void);
MODEL(int32_T) Model_FirstCall(IEEE_Cigre_DLLInterface_Instance *instance);
MODEL(int32_T) Model_CheckParameters(IEEE_Cigre_DLLInterface_Instance *instance);
MODEL(int32_T) Model_Initialize(IEEE_Cigre_DLLInterface_Instance *instance);
MODEL(int32_T) Model_Outputs(IEEE_Cigre_DLLInterface_Instance *instance);
MODEL(int32_T) Model_Iterate(IEEE_Cigre_DLLInterface_Instance *instance);
MODEL(int32_T) Model_Terminate(IEEE_Cigre_DLLInterface_Instance *instance);

#endif
