/* In place of the harness's board.h: a processor in the loop whose requests a fuzzer makes up. */
#include <stddef.h>
#include <stdint.h>
#include <string.h>

enum { BOARD_READ = 1, BOARD_WRITE = 5 };
#define ELAPSED(ticks) (ticks)

static const uint8_t *fuzz_data;
static size_t fuzz_left;

unsigned long clock_now(void);
unsigned long clock_now(void) { return 0; }

static long board_open(const char *name, long length, long mode) { return name[0] + length + mode; }

static unsigned long board_read(long file, void *at, unsigned long size)
{
    const size_t taken = size < fuzz_left ? size : fuzz_left;
    (void)file;
    memcpy(at, fuzz_data, taken);
    fuzz_data += taken;
    fuzz_left -= taken;
    return taken;
}

static void board_write(long file, const void *at, unsigned long size)
{
    volatile uint8_t sum = 0; /* reads all of it, so that the sanitizers see what it reads */
    (void)file;
    for (unsigned long k = 0; k < size; k++)
        sum ^= ((const uint8_t *)at)[k];
}

static void board_end(void) { }
