/* Shared memory: one slot per direction; the writer releases the counter after the bytes. */
#define _GNU_SOURCE
#include <stdatomic.h>
#include <stdint.h>
#include <string.h>

enum { YIELDS = 0, LONGEST = 512 };

/* `seen` outlives a round, so that either side may begin first. */
typedef struct {
    _Alignas(64) atomic_int_fast64_t count;
    int64_t size;
    char bytes[LONGEST];
    _Alignas(64) int64_t seen;
} slot_t;

typedef struct {
    slot_t *out, *in;
} end_t;

/* Address of two slots; whether this side sends in the first. */
static end_t open_end(const int64_t *opened)
{
    slot_t *slots = (slot_t *)opened[0];
    return (end_t){slots + !opened[1], slots + !!opened[1]};
}

static void transmit(end_t *e, const void *message, int64_t size)
{
    slot_t *s = e->out;
    memcpy(s->bytes, message, size);
    s->size = size;
    atomic_store_explicit(&s->count, atomic_load_explicit(&s->count, memory_order_relaxed) + 1,
                          memory_order_release);
}

static int64_t receive(end_t *e, void *message)
{
    int64_t count = atomic_load_explicit(&e->in->count, memory_order_acquire);
    if (count == e->in->seen)
        return 0;
    e->in->seen = count;
    memcpy(message, e->in->bytes, e->in->size);
    return e->in->size;
}

#include "pingpong.h"
