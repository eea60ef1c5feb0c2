/* Turns a fuzzer's bytes into messages: raw ones, frames of y and greetings that are whole but for what
 * the bytes change. Without this a fuzzer would not come past the CRC. */
#include <stdlib.h>

#include "gfmhil_frames.h"

typedef struct {
    const uint8_t *data;
    size_t left;
} source_t;

static uint8_t one(source_t *from)
{
    if (from->left == 0)
        return 0;
    from->left--;
    return *from->data++;
}

static size_t some(source_t *from, void *to, size_t size)
{
    const size_t taken = size < from->left ? size : from->left;
    memcpy(to, from->data, taken);
    from->data += taken;
    from->left -= taken;
    return taken;
}

/* The next message; returns its size, 1 to GFMHIL_LONGEST, or 0 at the end of the bytes. */
static size_t next_message(source_t *from, uint8_t message[GFMHIL_LONGEST])
{
    while (from->left > 0) {
        const uint8_t kind = one(from);
        size_t size;
        if (kind % 4 == 0) { /* raw */
            size = some(from, message, one(from) * 2u % (GFMHIL_LONGEST + 1u));
        } else if (kind % 4 == 1) { /* a greeting */
            memcpy(message, GFMHIL_GREETING, strlen(GFMHIL_GREETING));
            size = strlen(GFMHIL_GREETING);
            size += some(from, message + size, one(from));
            for (size_t k = 0; k < size; k++)
                if (message[k] == '\n')
                    message[k] = '"'; /* so that short inputs have strings */
        } else {
            gfmhil_y_frame y;
            memset(&y, 0, sizeof y);
            y.head.sequence = one(from);
            y.head.tick = one(from);
            y.head.state = kind & 64 ? one(from) : GFMHIL_RUNNING;
            some(from, y.y, kind & 128 ? sizeof y.y : 0);
            y.head.magic = GFMHIL_MAGIC;
            y.head.version = GFMHIL_TABLE_VERSION;
            y.head.data_id = GFMHIL_Y_ID;
            if (kind & 4)
                some(from, &y.head, sizeof y.head);
            y.crc = gfmhil_crc32(&y, offsetof(gfmhil_y_frame, crc)) + (kind & 8 ? 1u : 0u);
            memcpy(message, &y, sizeof y);
            size = sizeof y;
        }
        if (size > 0)
            return size;
    }
    return 0;
}

/* What a controller sends must be whole: a frame of u with a right CRC and finite values, or a HELLO. */
static void check_sent(const uint8_t *message, size_t size)
{
    gfmhil_u_frame u;
    if (size == sizeof u) {
        memcpy(&u, message, sizeof u);
        if (u.crc != gfmhil_crc32(&u, offsetof(gfmhil_u_frame, crc)) || u.head.data_id != GFMHIL_U_ID
            || u.head.state > GFMHIL_STOPPED)
            abort();
        for (int k = 0; k < GFMHIL_NU; k++) {
            double value;
            memcpy(&value, (const char *)message + sizeof u.head + 8 * (size_t)k, sizeof value);
            if (!(value - value == 0.0))
                abort();
        }
    } else if (size == 0 || size > GFMHIL_LONGEST || message[size - 1] != '}'
               || memcmp(message, GFMHIL_GREETING, strlen(GFMHIL_GREETING)) != 0) {
        abort();
    }
}
