/* For sources of a real-code DLL that were written for Windows and use nothing of it but these: how
 * functions are exported and called, and the names of the C library's that Microsoft's adds.
 *
 *   cc -O2 -shared -fPIC -I"$(gfmhil firmware include)/windows" -include windows.h model.c -o model.so -lm
 */
#ifndef GFMHIL_WINDOWS_H
#define GFMHIL_WINDOWS_H
#ifdef _WIN32
#include_next <windows.h>
#else

#include <stdio.h>
#include <string.h>

#define __declspec(what) __attribute__((visibility("default")))
#define __cdecl
#define __stdcall
#define WINAPI
#define APIENTRY
#define TRUE 1
#define FALSE 0
#define DLL_PROCESS_DETACH 0
#define DLL_PROCESS_ATTACH 1
#define DLL_THREAD_ATTACH 2
#define DLL_THREAD_DETACH 3

typedef int BOOL;
typedef unsigned char BYTE;
typedef unsigned short WORD;
typedef unsigned int DWORD, UINT;
typedef void *HANDLE, *HINSTANCE, *HMODULE, *LPVOID;

#define sprintf_s snprintf
#define strcpy_s(to, size, from) snprintf(to, size, "%s", from)
#define _snprintf snprintf
#define _stricmp strcasecmp

#endif
#endif
