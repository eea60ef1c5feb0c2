/* Fuzzes the program of a processor in the loop: its requests. */
#define main loop_main
#include "pil.c"
#undef main

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    fuzz_data = data;
    fuzz_left = size;
    loop_main();
    return 0;
}
