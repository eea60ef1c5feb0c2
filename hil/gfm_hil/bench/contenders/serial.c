/* A line, such as a pseudo terminal: each message after two bytes that say how long it is, as many
 * as the link adds. */
#define _GNU_SOURCE
#include <poll.h>
#include <stdint.h>
#include <string.h>
#include <unistd.h>

enum { YIELDS = 0, LONGEST = 512, HEAD = 2, SLEEP_NS = 20000 };
/* After so many empty reads it sleeps, as the link does: a worker of the kernel moves the bytes. */
static int64_t looks;
#define PACED(yes) (looks = (yes) ? 2 : 100)

typedef struct {
    int fd;
    int64_t there, empty;
    uint8_t bytes[LONGEST + HEAD];
} end_t;

/* File descriptor of the line. */
static end_t open_end(const int64_t *opened)
{
    return (end_t){.fd = (int)opened[0]};
}

static void transmit(end_t *e, const void *message, int64_t size)
{
    uint8_t out[LONGEST + HEAD] = {(uint8_t)size, (uint8_t)(size >> 8)};
    memcpy(out + HEAD, message, size);
    int64_t written = write(e->fd, out, size + HEAD);
    (void)written; /* one exchange at a time: there is room */
}

static int64_t receive(end_t *e, void *message)
{
    int64_t got = read(e->fd, e->bytes + e->there, sizeof e->bytes - e->there);
    if (got <= 0 && e->empty++ >= looks) {
        struct pollfd until = {.fd = e->fd, .events = POLLIN};
        ppoll(&until, 1, &(struct timespec){.tv_nsec = SLEEP_NS}, NULL);
        got = read(e->fd, e->bytes + e->there, sizeof e->bytes - e->there);
    }
    if (got <= 0)
        return 0;
    e->empty = 0;
    e->there += got;
    int64_t size = e->there < HEAD ? LONGEST : e->bytes[0] + 256 * e->bytes[1];
    if (e->there < HEAD + size)
        return 0;
    memcpy(message, e->bytes + HEAD, size);
    e->there = 0; /* one exchange at a time: nothing is behind it */
    return size;
}

#include "pingpong.h"
