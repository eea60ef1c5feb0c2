#include "gfmhil_frames.h"
static gfmhil_line line;
size_t take(uint8_t byte, uint8_t *to)
{
    const size_t size = gfmhil_take(&line, byte);
    memcpy(to, line.bytes, size);
    return size;
}
size_t stuff(const void *m, size_t size, uint8_t *to) { return gfmhil_stuff(m, size, to); }
uint32_t crc(const void *data, size_t size) { return gfmhil_crc32(data, size); }
int is_y(const void *m, size_t size, uint32_t next) { return gfmhil_is_y(m, size, next); }
int is_greeting(const char *text, const char *kind) { return gfmhil_is_greeting(text, kind); }
size_t answer(const char *hello, const char *name, char *to)
{
    return gfmhil_answer(hello, "here", name, to);
}
void seal(uint64_t tick, uint8_t state, const double *u, void *to)
{
    gfmhil_u_frame f = gfmhil_first_u();
    f.head.tick = tick;
    f.head.state = state;
    memcpy(f.u, u, sizeof f.u);
    gfmhil_seal(&f);
    memcpy(to, &f, sizeof f);
}
