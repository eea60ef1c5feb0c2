/* The program of a processor in the loop: waits for a request in the file `to`, and answers in the file
 * `from`. A request is what a tick does first, the number of a law, whether its stage limits, the
 * references and the measurements; at a start the law's whole state follows. At a check a golden row
 * follows, and the answer's result is how many of its words differ; to IDENTIFY the law's
 * identification follows the answer. The first answer says that the
 * program runs; its count is what reading the clock takes. The number of a law that is not there ends
 * the program. */
#define GOLDEN_NO_MAIN
#define GOLDEN_CLOCK clock_now
#include "selftest.c"

#include "board.h"
#include "states.h"
#ifdef LOOP_FIRMWARE
#include "loop.h"
#endif

enum { TICK, START, CHANGE, CHECK, ALIGN, IDENTIFY };

static struct {
    golden_word what, law, limited;
    golden_real ref[5], y[GOLDEN_NY];
#if COUNTS
    golden_real measured[11];
#endif
} request;

static struct {
    golden_word result, channel, limited, count;
    golden_real u[GOLDEN_NU], own[3], bump, i_ref[2];
#if COUNTS
    golden_real counts[GOLDEN_COUNTS];
#endif
} answer;

static golden_real state[STATE_REALS];
static golden_word row[GOLDEN_WORDS];

/* What the host records of a law after a tick. */
static void look_at(int law, int k)
{
    const view_t now = laws[law].view(k);
    memcpy(answer.own, now.u, sizeof answer.own);
#if STAGES
    memcpy(answer.i_ref, now.stage, sizeof answer.i_ref);
    answer.limited = (golden_word)now.limited;
#endif
#if COUNTS
    memcpy(answer.counts, now.counts, sizeof answer.counts);
#endif
    answer.channel = (golden_word)states[law].channel(k);
}

#ifdef LOOP_FIRMWARE
/* A tick of the firmware: changes of law are its own. */
static int tick_firmware(int law)
{
    const char *name = golden_names[law];
    uint16_t adc[GOLDEN_NY];
    int i, result;
    for (i = 0; i < GOLDEN_NY; i++)
        adc[i] = (uint16_t)request.y[i];
    if (request.what == ALIGN) {
        laws[law].align(0, request.y);
        memcpy(loop_instance(name), states[law].at(0), golden_sizes[law]);
    }
    result = loop_tick(name, request.ref, adc, answer.u, &answer.bump);
    memcpy(states[law].at(0), loop_instance(name), golden_sizes[law]);
    return result;
}
#else
/* Changes to the request's law, between the instances k and 1 - k. */
static void change(int *law, int *k)
{
#if COUNTS
    const golden_real *y = request.measured; /* by the old law; the new one measures it anew */
#else
    const golden_real *y = request.y;
#endif
    const view_t now = laws[*law].view(*k);
    laws[*law].look(*k, request.ref, y, answer.own);
    *law = (int)request.law;
    *k = 1 - *k;
    laws[*law].init(*k);
    laws[*law].change(*k, request.ref, y, answer.own, now.trend NOW_E, &answer.bump);
#if COUNTS
    laws[*law].go_on(*k, now.counts);
#endif
}
#endif

static int whole(long file, void *at, unsigned long size)
{
    unsigned long got = 0, more;
    while (got < size && (more = board_read(file, (char *)at + got, size - got)) != 0)
        got += more;
    return got == size;
}

int main(void)
{
    const long to = board_open("to", 2, BOARD_READ), from = board_open("from", 4, BOARD_WRITE);
    const unsigned long before = clock_now();
    int law = 0, k = 0;
    answer.count = (golden_word)ELAPSED(clock_now() - before);
    board_write(from, &answer, sizeof answer);
    while (whole(to, &request, sizeof request) && request.law < GOLDEN_LAWS) {
        if (request.what == START) {
            if (!whole(to, state, sizeof state))
                break;
            law = (int)request.law;
            k = 0;
            laws[law].init(k);
            states[law].load(k, state, (int)request.limited);
#ifdef LOOP_FIRMWARE
            if (!loop_start(golden_names[law], states[law].at(k))) {
                board_say("the firmware has no law ");
                board_say(golden_names[law]);
                break;
            }
#endif
            continue;
        }
        if (request.what == CHECK) {
            if (!whole(to, row, sizeof row) || row[1] >= GOLDEN_LAWS)
                break;
            answer.result = golden_row(row);
            board_write(from, &answer, sizeof answer);
            continue;
        }
        if (request.what == IDENTIFY) {
            static char text[ID_SIZE];
            const unsigned long size = states[request.law].id_size;
            memset(text, 0, sizeof text);
            memcpy(text, states[request.law].id, size < sizeof text ? size : sizeof text);
            board_write(from, &answer, sizeof answer);
            board_write(from, text, sizeof text);
            continue;
        }
        answer.bump = 0;
#ifdef LOOP_FIRMWARE
        law = (int)request.law;
        answer.result = (golden_word)tick_firmware(law);
#else
        if (request.what == CHANGE)
            change(&law, &k);
#if COUNTS
        if (request.what == ALIGN)
            laws[law].align(k, request.y);
#endif
        answer.result = (golden_word)laws[law].step(k, request.ref, request.y, answer.u);
#endif
        answer.count = (golden_word)ELAPSED(golden_elapsed);
        look_at(law, k);
        board_write(from, &answer, sizeof answer);
    }
    board_end();
    return 0;
}
