/* The limits that the links are compared with: ping-pong between two processes in plain C.
 *
 * Each `ping_*` fills took[] with the ns of its round trips and returns their number, or -1 if the
 * peer stopped answering. period = 0: one after the other. Else one every `period` ns at absolute
 * deadlines, and a time counts from the deadline, so that a late start is included.
 * Each `pong_*` answers until *stop is set. Waiting is as in the compiled loops of the links.
 */
#define _GNU_SOURCE
#include <sched.h>
#include <stdatomic.h>
#include <stdint.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>

typedef atomic_int_fast64_t number;

enum { AHEAD_NS = 40000, SILENCE_NS = 1000000000, LONGEST = 512 };

static int64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

static void relax(void)
{
#if defined(__x86_64__)
    __builtin_ia32_pause();
#endif
}

/* Sleep until shortly before a deadline, then spin, with a yield or a pause after each poll. */
static void wait_until(int64_t deadline, int yields)
{
    if (deadline - now_ns() > AHEAD_NS) {
        int64_t t = deadline - AHEAD_NS;
        struct timespec at = {t / 1000000000, t % 1000000000};
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, 0);
    }
    while (now_ns() < deadline)
        yields ? (void)sched_yield() : relax();
}

/* A link: send a whole message; receive one if it has arrived (0: none). */
typedef struct link {
    void (*send)(struct link *, const void *, int64_t);
    int64_t (*receive)(struct link *, void *);
    int yields;
} link_t;

static inline __attribute__((always_inline)) int64_t
ping(link_t *l, void (*send)(link_t *, const void *, int64_t), int64_t (*receive)(link_t *, void *),
     int64_t size, int64_t period, int64_t duration, int64_t *took, int64_t capacity)
{
    char out[LONGEST] = {1}, in[LONGEST];
    while (receive(l, in)) /* late answers of an aborted round */
        ;
    int64_t begin = now_ns(), end = begin + duration, n = 0;
    for (int64_t due = begin + period; n < capacity && begin < end; n++) {
        if (period) {
            wait_until(due, l->yields);
            begin = due;
            due += period;
        }
        send(l, out, size);
        for (int64_t looks = 1; !receive(l, in); looks++) {
            l->yields ? (void)sched_yield() : relax();
            if (looks % 1024 == 0 && now_ns() - begin > SILENCE_NS)
                return -1;
        }
        int64_t now = now_ns();
        took[n] = now - begin;
        begin = now;
    }
    return n;
}

static inline __attribute__((always_inline)) void
pong(link_t *l, void (*send)(link_t *, const void *, int64_t), int64_t (*receive)(link_t *, void *),
     int64_t size, number *stop)
{
    char out[LONGEST] = {2}, in[LONGEST];
    while (!atomic_load_explicit(stop, memory_order_acquire))
        if (receive(l, in))
            send(l, out, size);
        else
            l->yields ? (void)sched_yield() : relax();
}

#define ENDS(kind, make, ...)                                                                      \
    int64_t ping_##kind(__VA_ARGS__, int64_t size, int64_t period, int64_t duration,               \
                        int64_t *took, int64_t capacity)                                           \
    {                                                                                              \
        kind##_t l = make;                                                                         \
        return ping(&l.base, kind##_send, kind##_receive, size, period, duration, took, capacity); \
    }                                                                                              \
    void pong_##kind(__VA_ARGS__, int64_t size, number *stop)                                      \
    {                                                                                              \
        kind##_t l = make;                                                                         \
        pong(&l.base, kind##_send, kind##_receive, size, stop);                                    \
    }

/* Shared memory: one slot per direction; the writer releases the counter after the bytes. `seen`
 * outlives a round, so that either side may begin first. */
typedef struct {
    _Alignas(64) number count;
    int64_t size;
    char bytes[LONGEST];
    _Alignas(64) int64_t seen;
} slot_t;

typedef struct {
    link_t base;
    slot_t *out, *in;
} shm_t;

static void shm_send(link_t *base, const void *message, int64_t size)
{
    slot_t *s = ((shm_t *)base)->out;
    memcpy(s->bytes, message, size);
    s->size = size;
    atomic_store_explicit(&s->count, atomic_load_explicit(&s->count, memory_order_relaxed) + 1,
                          memory_order_release);
}

static int64_t shm_receive(link_t *base, void *message)
{
    shm_t *l = (shm_t *)base;
    int64_t count = atomic_load_explicit(&l->in->count, memory_order_acquire);
    if (count == l->in->seen)
        return 0;
    l->in->seen = count;
    memcpy(message, l->in->bytes, l->in->size);
    return l->in->size;
}

static shm_t shm_end(slot_t *slots, int64_t first)
{
    return (shm_t){{shm_send, shm_receive, 0}, slots + !first, slots + !!first};
}

ENDS(shm, shm_end(slots, first), slot_t *slots, int64_t first)

/* UDP on a connected socket. */
typedef struct {
    link_t base;
    int socket;
} udp_t;

static void udp_send(link_t *base, const void *message, int64_t size)
{
    send(((udp_t *)base)->socket, message, size, MSG_DONTWAIT);
}

static int64_t udp_receive(link_t *base, void *message)
{
    int64_t size = recv(((udp_t *)base)->socket, message, LONGEST, MSG_DONTWAIT);
    return size > 0 ? size : 0;
}

#define UDP_END {{udp_send, udp_receive, 0}, (int)socket}
ENDS(udp, UDP_END, int64_t socket)

/* ZeroMQ: libzmq's functions, by address, on an open socket. */
typedef int (*zmq_send_t)(void *, const void *, size_t, int);
typedef int (*zmq_recv_t)(void *, void *, size_t, int);

typedef struct {
    link_t base;
    void *socket;
    zmq_send_t zmq_send;
    zmq_recv_t zmq_recv;
} zmq_t;

static void zmq_send(link_t *base, const void *message, int64_t size)
{
    zmq_t *l = (zmq_t *)base;
    l->zmq_send(l->socket, message, size, 1); /* ZMQ_DONTWAIT */
}

static int64_t zmq_receive(link_t *base, void *message)
{
    zmq_t *l = (zmq_t *)base;
    int size = l->zmq_recv(l->socket, message, LONGEST, 1);
    return size > 0 ? size : 0;
}

#define ZMQ_END {{zmq_send, zmq_receive, 1}, socket, send_at, recv_at}
ENDS(zmq, ZMQ_END, void *socket, zmq_send_t send_at, zmq_recv_t recv_at)
