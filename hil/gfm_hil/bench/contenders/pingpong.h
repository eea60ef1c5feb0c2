/* The limits that the links are compared with: ping-pong between two processes in plain C.
 *
 * A transport includes this file at its end. Before, it defines YIELDS (1: give the processor away
 * after a poll without a message; 0: pause), LONGEST (bytes), end_t, `open_end` (makes an end of
 * numbers and addresses), `transmit` (sends a whole message) and `receive` (takes one if it has
 * arrived; 0: none). It may define PACED(yes): whether there are pauses between the messages.
 */
#include <sched.h>
#include <stdatomic.h>
#include <stdint.h>
#include <time.h>

enum { AHEAD_NS = 40000, SILENCE_NS = 1000000000 };

#ifndef PACED
#define PACED(yes) ((void)(yes))
#endif

static int64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

static void between_polls(void)
{
    if (YIELDS)
        sched_yield();
#if defined(__x86_64__)
    else
        __builtin_ia32_pause();
#endif
}

/* Sleep until shortly before a deadline, then spin. Waiting is as in the compiled loops of the
 * links. */
static void wait_until(int64_t deadline)
{
    if (deadline - now_ns() > AHEAD_NS) {
        int64_t t = deadline - AHEAD_NS;
        struct timespec at = {t / 1000000000, t % 1000000000};
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, 0);
    }
    while (now_ns() < deadline)
        between_polls();
}

/* Fills took[] with the ns of its round trips and returns their number, or -1 if the peer stopped
 * answering. period = 0: one after the other. Else one every `period` ns at absolute deadlines, and
 * a time counts from the deadline, so that a late start is included. */
int64_t ping(const int64_t *opened, int64_t size, int64_t period, int64_t duration, int64_t *took,
             int64_t capacity)
{
    end_t e = open_end(opened);
    char out[LONGEST] = {1}, in[LONGEST];
    PACED(period != 0);
    while (receive(&e, in)) /* late answers of an aborted round */
        ;
    int64_t begin = now_ns(), end = begin + duration, n = 0;
    for (int64_t due = begin + period; n < capacity && begin < end; n++) {
        if (period) {
            wait_until(due);
            begin = due;
            due += period;
        }
        transmit(&e, out, size);
        for (int64_t polls = 1; !receive(&e, in); polls++) {
            between_polls();
            if (polls % 1024 == 0 && now_ns() - begin > SILENCE_NS)
                return -1;
        }
        int64_t now = now_ns();
        took[n] = now - begin;
        begin = now;
    }
    return n;
}

/* Answers until stop[0] is set; stop[2] is the period. */
void pong(const int64_t *opened, int64_t size, atomic_int_fast64_t *stop)
{
    end_t e = open_end(opened);
    char out[LONGEST] = {2}, in[LONGEST];
    PACED(stop[2] != 0);
    while (!atomic_load_explicit(stop, memory_order_acquire))
        if (receive(&e, in))
            transmit(&e, out, size);
        else
            between_polls();
}
