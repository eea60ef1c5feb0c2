/* A controller of your own in C: droop with a low-pass on p, against gfmhil's plant.

   It uses nothing of gfmhil but its header gfmhil_frames.h; docs/own-controller.md describes all
   that is in there.

   Usage: controller-zmq ENDPOINT [--realtime] TICK=P_REF ...
          controller-shm ENDPOINT [--realtime] TICK=P_REF ...

   The first TICK must be 0; P_REF (p.u.) holds from that tick on. Exit code 0: the run ended in
   order. 1: the plant is gone, or no link could be opened. 2: wrong input, or a plant that runs
   something else. */

#include "link.h"
#include "gfmhil_frames.h"

#include <math.h>
#include <sched.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <time.h>

enum { NY = GFMHIL_NY, NU = GFMHIL_NU };
enum { GREETING_WAIT_MS = 60000, LOCKSTEP_WAIT_MS = 20000, REALTIME_WAIT_MS = 1000 };
enum { LOOK_MS = 100 }; /* a signal may come just before a wait, which it then does not interrupt */
enum { PRIORITY = 50, ANSWER_EVERY_MS = 100, LAST_TIMES = 3 };

#define NAME "droop in C" /* what the plant's report calls this controller */

/* ---- the law ----------------------------------------------------------------------------- */

typedef struct {
    double P_ref, Q_ref, V_ref; /* p.u. */
    double share;               /* T_s over the time constant of the low-pass */
    double p;                   /* filtered, p.u. */
    bool begun;
} droop_t;

/* One tick: measurements y in, inputs u out, p.u. */
static void droop(droop_t *law, const double y[NY], double u[NU]) {
    const double D_p = 0.01, k_34 = 0.005;
    law->p = law->begun ? law->p + law->share * (y[1] - law->p) : y[1];
    law->begun = true;
    u[0] = law->P_ref; /* the rig's DC source regulates itself */
    u[1] = 1.0 + D_p * (law->P_ref - law->p);
    u[2] = law->V_ref + k_34 * (law->Q_ref - y[3]);
}

/* Whether every measurement is a number in the plausible range of the signal table. */
static bool plausible(const double y[NY]) {
    static const double low[NY] = {0, -6, 0.7, -6, 0}, high[NY] = {3, 6, 1.3, 6, 3};
    for (int j = 0; j < NY; j++)
        if (!(y[j] >= low[j] && y[j] <= high[j])) /* so that NaN fails */
            return false;
    return true;
}

/* ---- the greeting ------------------------------------------------------------------------ */

/* Answer a HELLO of the plant, after a look at what it runs. Returns its T_s in s, or 0 if this
   program does not fit. */
static double answer_hello(link_t *link, const char *hello) {
    char boot[64] = "", version[64], table[64], T_s[64], answer[GFMHIL_LONGEST];
    if (!gfmhil_field(hello, "version", version, sizeof version) ||
        !gfmhil_field(hello, "table", table, sizeof table) ||
        !gfmhil_field(hello, "T_s", T_s, sizeof T_s))
        return 0;
    if (atoi(version) != GFMHIL_TABLE_VERSION || strcmp(table, GFMHIL_TABLE) != 0) {
        fprintf(stderr, "the plant has another signal table: version %s, %s\n", version, table);
        return 0;
    }
    FILE *file = fopen("/proc/sys/kernel/random/boot_id", "r");
    if (file != NULL) {
        if (fgets(boot, sizeof boot, file) != NULL)
            boot[strcspn(boot, "\n")] = '\0';
        fclose(file);
    }
    const size_t size = gfmhil_answer(hello, boot, NAME, answer);
    if (size == 0)
        return 0;
    link_send(link, answer, size);
    return atof(T_s);
}

/* ---- the loop ---------------------------------------------------------------------------- */

typedef struct {
    link_t *link;
    gfmhil_u_frame out; /* the last frame sent */
    uint32_t next;      /* sequence expected of the plant */
    int64_t tick;       /* of the last y computed, -1 before the first */
} loop_t;

static volatile sig_atomic_t stopping;

static void on_signal(int number) {
    (void)number;
    stopping = 1;
}

static int64_t now_ms(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * (int64_t)1000 + now.tv_nsec / 1000000;
}

/* Send the frame in `out` under the next sequence number. */
static void send_u(loop_t *loop, uint8_t state, uint8_t reason) {
    gfmhil_header *head = &loop->out.head;
    head->state = state;
    head->reason = reason;
    head->tick = loop->tick < 0 ? 0 : (uint64_t)loop->tick;
    gfmhil_seal(&loop->out);
    link_send(loop->link, &loop->out, sizeof loop->out);
    head->sequence++; /* modulo 2^32, as unsigned numbers go */
}

/* Send the last frame, and some more like it: one alone might be lost. */
static int leave(loop_t *loop, uint8_t state, uint8_t reason, int code) {
    for (int k = 0; k < LAST_TIMES; k++)
        send_u(loop, state, reason);
    return code;
}

/* Run until the plant ends the run; returns the exit code. `steps` are the arguments TICK=P_REF. */
static int run(link_t *link, char **steps, int count, bool realtime) {
    loop_t loop = {.link = link, .out = gfmhil_first_u(), .tick = -1};
    loop.out.u[1] = loop.out.u[2] = 1.0;
    droop_t law = {.Q_ref = 0.0, .V_ref = 1.0};
    uint8_t state = GFMHIL_READY, reason = GFMHIL_OK;
    int64_t answered = -ANSWER_EVERY_MS;
    int wait_ms = GREETING_WAIT_MS;
    int64_t heard = now_ms();
    union {
        char text[LONGEST + 1];
        gfmhil_y_frame y;
    } message;

    while (!stopping) {
        const size_t size = link_receive(link, &message, LOOK_MS);
        const int64_t now = now_ms();
        if (size == 0) {
            if (now - heard < wait_ms)
                continue;
            fprintf(stderr, "the plant is gone\n");
            return leave(&loop, GFMHIL_SAFE, GFMHIL_LOST_PEER, 1);
        }
        heard = now;
        message.text[size < LONGEST ? size : LONGEST] = '\0';
        if (gfmhil_is_greeting(message.text, "start"))
            continue; /* frames follow; "t0" is the time of tick 0 */
        if (gfmhil_is_greeting(message.text, "hello")) {
            if (now - answered < ANSWER_EVERY_MS)
                continue; /* one answer for all that had piled up */
            answered = now;
            const double T_s = answer_hello(link, message.text);
            if (T_s == 0)
                return 2;
            law.share = T_s / 0.02;
            wait_ms = realtime ? REALTIME_WAIT_MS : LOCKSTEP_WAIT_MS;
            continue;
        }
        if (!gfmhil_is_y(&message, size, loop.next))
            continue; /* damaged: in lockstep the plant sends it again */
        loop.next = message.y.head.sequence + 1;
        if (message.y.head.state == GFMHIL_SAFE || message.y.head.state == GFMHIL_STOPPED)
            return leave(&loop, GFMHIL_STOPPED, GFMHIL_OK, 0); /* the plant tripped, or the run is over */
        const int64_t tick = (int64_t)message.y.head.tick;
        if (tick > loop.tick) { /* else the plant asks again: the answer was lost */
            loop.tick = tick;
            double y[NY];
            memcpy(y, message.y.y, sizeof y); /* the frame's may not be aligned */
            if (state != GFMHIL_SAFE && !plausible(y)) {
                state = GFMHIL_SAFE; /* for good: u stays, the plant blocks its bridge and ends the run */
                reason = GFMHIL_BAD_Y;
            }
            if (state != GFMHIL_SAFE) {
                state = GFMHIL_RUNNING;
                for (int k = 0; k < count; k++)
                    if (strtoll(steps[k], NULL, 10) <= tick)
                        law.P_ref = atof(strchr(steps[k], '=') + 1);
                double u[NU];
                droop(&law, y, u);
                memcpy(loop.out.u, u, sizeof u);
            }
        }
        send_u(&loop, state, reason);
    }
    return leave(&loop, GFMHIL_STOPPED, GFMHIL_OPERATOR, 0);
}

/* Ask for a processor, a real-time priority and memory that stays; do without what is refused. */
static void ask_for_real_time(void) {
    const struct sched_param priority = {.sched_priority = PRIORITY};
    cpu_set_t mine;
    if (sched_getaffinity(0, sizeof mine, &mine) == 0) {
        size_t last = CPU_SETSIZE - 1; /* gfmhil's plant takes the first that it may use */
        while (last > 0 && !CPU_ISSET(last, &mine))
            last--;
        CPU_ZERO(&mine);
        CPU_SET(last, &mine);
        sched_setaffinity(0, sizeof mine, &mine);
    }
    if (sched_setscheduler(0, SCHED_FIFO, &priority) != 0)
        perror("no SCHED_FIFO");
    if (mlockall(MCL_CURRENT | MCL_FUTURE) != 0)
        perror("no locked memory");
}

int main(int argc, char **argv) {
    const bool realtime = argc > 2 && strcmp(argv[2], "--realtime") == 0;
    const int first = realtime ? 3 : 2;
    bool right = argc > first && strtoll(argv[first], NULL, 10) == 0;
    for (int k = first; k < argc; k++)
        right = right && strchr(argv[k], '=') != NULL;
    if (!right) {
        fprintf(stderr, "usage: %s ENDPOINT [--realtime] 0=P_REF [TICK=P_REF ...]\n", argv[0]);
        return 2;
    }
    const struct sigaction stop = {.sa_handler = on_signal}; /* without SA_RESTART */
    sigaction(SIGINT, &stop, NULL);
    sigaction(SIGTERM, &stop, NULL);
    if (realtime)
        ask_for_real_time(); /* first: the threads of a link inherit it */
    link_t *link = link_open(argv[1]);
    if (link == NULL)
        return 1;
    const int code = run(link, argv + first, argc - first, realtime);
    link_close(link);
    return code;
}
