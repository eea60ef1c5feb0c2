/* A controller of your own in C: droop with a low-pass on p, against gfmhil's plant.

   It uses nothing of gfmhil; docs/own-controller.md describes all that it has to know.

   Usage: controller-zmq ENDPOINT [--realtime] TICK=P_REF ...
          controller-shm ENDPOINT [--realtime] TICK=P_REF ...

   The first TICK must be 0; P_REF (p.u.) holds from that tick on. Exit code 0: the run ended in
   order. 1: the plant is gone, or no link could be opened. 2: wrong input, or a plant that runs
   something else. */

#include "link.h"

#include <math.h>
#include <sched.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <time.h>

enum { NY = 5, NU = 3, MAGIC = 0x4647, TABLE_VERSION = 2, Y_ID = 1, U_ID = 2 };
enum { READY = 1, RUNNING = 2, SAFE = 3, STOPPED = 4 };
enum { OK = 0, BAD_Y = 1, LOST_PEER = 4, OPERATOR = 6 };
enum { GREETING_WAIT_MS = 60000, LOCKSTEP_WAIT_MS = 20000, REALTIME_WAIT_MS = 1000 };
enum { PRIORITY = 50, ANSWER_EVERY_MS = 100, LAST_TIMES = 3 };

#define GREETING "GFMHIL "
#define NAME "droop in C" /* what the plant's report calls this controller */

/* The signal table that this program was written for; the plant sends its own. */
#define TABLE "\"fb7ec5b6\""

typedef struct __attribute__((packed)) {
    uint16_t magic;
    uint8_t version, data_id, state, reason;
    uint16_t spare;
    uint32_t sequence;
    uint64_t tick;
} header_t;

typedef struct __attribute__((packed)) {
    header_t head;
    double y[NY]; /* v_dc, p, omega_u, q, V */
    uint32_t crc;
} y_frame_t;

typedef struct __attribute__((packed)) {
    header_t head;
    double u[NU]; /* i_u, omega_u, E_u */
    uint32_t crc;
} u_frame_t;

_Static_assert(sizeof(header_t) == 20, "header");
_Static_assert(sizeof(y_frame_t) == 64, "frame of y");
_Static_assert(sizeof(u_frame_t) == 48, "frame of u");
_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "frames are little-endian");

/* CRC-32 of zlib and Ethernet: reflected polynomial, all ones before and after. */
static uint32_t crc32(const void *data, size_t size) {
    const uint8_t *byte = data;
    uint32_t crc = 0xFFFFFFFF;
    while (size-- > 0) {
        crc ^= *byte++;
        for (int bit = 0; bit < 8; bit++)
            crc = crc >> 1 ^ (crc & 1 ? 0xEDB88320 : 0);
    }
    return ~crc;
}

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

/* The value of a key of a flat JSON object as it stands there, with quotes if it is a string. */
static bool field(const char *json, const char *key, char *value, size_t room) {
    char quoted[32];
    snprintf(quoted, sizeof quoted, "\"%s\"", key);
    const char *at = strstr(json, quoted);
    if (at == NULL)
        return false;
    at += strlen(quoted);
    at += strspn(at, " :");
    const char *end = *at == '"' ? strchr(at + 1, '"') : at + strcspn(at, " ,}") - 1;
    if (end == NULL || (size_t)(end + 1 - at) >= room)
        return false;
    memcpy(value, at, (size_t)(end + 1 - at));
    value[end + 1 - at] = '\0';
    return true;
}

/* Answer a HELLO of the plant, after a look at what it runs. Returns its T_s in s, or 0 if this
   program does not fit. */
static double answer_hello(link_t *link, const char *hello) {
    char boot[64] = "", version[64], table[64], T_s[64], laws[128], digest[128], answer[LONGEST];
    if (!field(hello, "version", version, sizeof version) ||
        !field(hello, "table", table, sizeof table) || !field(hello, "T_s", T_s, sizeof T_s) ||
        !field(hello, "laws", laws, sizeof laws) || !field(hello, "digest", digest, sizeof digest))
        return 0;
    if (atoi(version) != TABLE_VERSION || strcmp(table, TABLE) != 0) {
        fprintf(stderr, "the plant has another signal table: version %s, %s\n", version, table);
        return 0;
    }
    FILE *file = fopen("/proc/sys/kernel/random/boot_id", "r");
    if (file != NULL) {
        if (fgets(boot, sizeof boot, file) != NULL)
            boot[strcspn(boot, "\n")] = '\0';
        fclose(file);
    }
    const int size = snprintf(answer, sizeof answer,
                              GREETING "{\"kind\": \"hello\", \"role\": \"controller\", "
                                       "\"boot\": \"%s\", \"version\": %s, \"table\": %s, "
                                       "\"T_s\": %s, \"laws\": %s, \"digest\": %s, "
                                       "\"name\": \"" NAME "\"}",
                              boot, version, table, T_s, laws, digest);
    link_send(link, answer, (size_t)size);
    return atof(T_s);
}

/* ---- the loop ---------------------------------------------------------------------------- */

typedef struct {
    link_t *link;
    u_frame_t out;  /* the last frame sent */
    uint32_t next;  /* sequence expected of the plant */
    int64_t tick;   /* of the last y computed, -1 before the first */
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

/* Whether a message is a frame of y that may be used. */
static bool good(const loop_t *loop, const y_frame_t *y, size_t size) {
    return size == sizeof *y && y->crc == crc32(y, offsetof(y_frame_t, crc)) &&
           y->head.magic == MAGIC && y->head.version == TABLE_VERSION && y->head.data_id == Y_ID &&
           y->head.sequence - loop->next < 0x80000000; /* not one that was there before */
}

/* Send the frame in `out` under the next sequence number. */
static void send_u(loop_t *loop, uint8_t state, uint8_t reason) {
    header_t *head = &loop->out.head;
    head->state = state;
    head->reason = reason;
    head->tick = loop->tick < 0 ? 0 : (uint64_t)loop->tick;
    loop->out.crc = crc32(&loop->out, offsetof(u_frame_t, crc));
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
    loop_t loop = {.link = link, .tick = -1};
    loop.out.head = (header_t){.magic = MAGIC, .version = TABLE_VERSION, .data_id = U_ID};
    loop.out.u[1] = loop.out.u[2] = 1.0;
    droop_t law = {.Q_ref = 0.0, .V_ref = 1.0};
    uint8_t state = READY, reason = OK;
    int64_t answered = -ANSWER_EVERY_MS;
    int wait_ms = GREETING_WAIT_MS;
    int64_t heard = now_ms();
    union {
        char text[LONGEST + 1];
        y_frame_t y;
    } message;

    while (!stopping) {
        const size_t size = link_receive(link, &message, wait_ms);
        const int64_t now = now_ms();
        if (size == 0) {
            if (now - heard < wait_ms)
                continue; /* a signal */
            fprintf(stderr, "the plant is gone\n");
            return leave(&loop, SAFE, LOST_PEER, 1);
        }
        heard = now;
        message.text[size < LONGEST ? size : LONGEST] = '\0';
        if (strncmp(message.text, GREETING, strlen(GREETING)) == 0) {
            if (strstr(message.text, "\"hello\"") == NULL)
                continue; /* START: frames follow; \"t0\" is the time of tick 0 */
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
        if (!good(&loop, &message.y, size))
            continue; /* damaged: in lockstep the plant sends it again */
        loop.next = message.y.head.sequence + 1;
        if (message.y.head.state == SAFE || message.y.head.state == STOPPED)
            return leave(&loop, STOPPED, OK, 0); /* the plant tripped, or the run is over */
        const int64_t tick = (int64_t)message.y.head.tick;
        if (tick > loop.tick) { /* else the plant asks again: the answer was lost */
            loop.tick = tick;
            double y[NY];
            memcpy(y, message.y.y, sizeof y); /* the frame's may not be aligned */
            if (state != SAFE && !plausible(y)) {
                state = SAFE; /* for good: u stays, the plant blocks its bridge and ends the run */
                reason = BAD_Y;
            }
            if (state != SAFE) {
                state = RUNNING;
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
    return leave(&loop, STOPPED, OPERATOR, 0);
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
