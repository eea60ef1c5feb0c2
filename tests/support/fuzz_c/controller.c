/* Fuzzes examples/own_controller_c: the messages of its link, and what it answers. */
#include "messages.h"

#define main controller_main
#include CONTROLLER
#undef main

static source_t from;

link_t *link_open(const char *endpoint)
{
    (void)endpoint;
    return (link_t *)&from;
}

void link_close(link_t *link) { (void)link; }

bool link_send(link_t *link, const void *message, size_t size)
{
    (void)link;
    check_sent(message, size);
    return true;
}

size_t link_receive(link_t *link, void *message, int wait_ms)
{
    uint8_t found[GFMHIL_LONGEST];
    const size_t size = next_message(&from, found);
    (void)link;
    (void)wait_ms;
    memcpy(message, found, size);
    stopping = size == 0;
    return size;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static char step[] = "0=0.5", *steps[] = {step};
    from.data = data;
    from.left = size;
    stopping = 0;
    run(link_open(""), steps, 1, false);
    return 0;
}
