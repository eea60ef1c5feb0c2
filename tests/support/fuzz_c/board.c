/* Fuzzes examples/board_c: the bytes of its UART, and what it answers. */
#include <setjmp.h>

#include "messages.h"

#define main board_main
#include "main.c"
#undef main

static source_t from;
static jmp_buf over;
static uint8_t line_bytes[GFMHIL_STUFFED + 1];
static size_t line_size, line_at;
static gfmhil_line answers;

void uart_open(void) { }

uint8_t uart_read(void)
{
    while (line_at == line_size) {
        uint8_t message[GFMHIL_LONGEST];
        const bool raw = from.left > 0 && *from.data % 8 == 0; /* bytes as they are on a line */
        const size_t size = next_message(&from, message);
        if (size == 0)
            longjmp(over, 1);
        line_at = 0;
        if (raw) {
            memcpy(line_bytes, message, size);
            line_bytes[size] = 0;
            line_size = size + 1;
        } else {
            line_size = gfmhil_stuff(message, size, line_bytes);
        }
    }
    return line_bytes[line_at++];
}

void uart_write(const uint8_t *bytes, size_t count)
{
    for (size_t k = 0; k < count; k++) {
        const size_t size = gfmhil_take(&answers, bytes[k]);
        if (size > 0)
            check_sent(answers.bytes, size);
        else if (bytes[k] == 0)
            abort(); /* what it sends can be unstuffed */
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    from.data = data;
    from.left = size;
    line_bytes[0] = 0; /* ends what the last input left */
    line_at = 0;
    line_size = 1;
    if (setjmp(over) == 0)
        board_main();
    return 0;
}
