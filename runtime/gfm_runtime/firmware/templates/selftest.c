/* @MADE@
 *
 * On any machine: cc -std=c99 -O2 -ffp-contract=off *.c -lm && ./a.out
 * It returns 0 when every bit of every output and state is that of golden.h. A board without a screen
 * calls golden_row for the rows of golden.h, and looks at the result. */
#include "selftest.h"

#include <string.h>

@LAW_INCLUDES@

/* -DGOLDEN_CLOCK=name: your function that reads a counter, e.g. DWT->CYCCNT of a Cortex-M; after
 * each row golden_elapsed is what a step took. */
#ifdef GOLDEN_CLOCK
unsigned long GOLDEN_CLOCK(void);
#else
#define GOLDEN_CLOCK() 0UL
#endif

unsigned long golden_elapsed;

/* One instance of a law, for any law. */
typedef struct {
    const golden_real *x, *offset, *u, *trend;
    int n;
/* @if stages@ */
    const golden_real *stage, *e;
    int limited;
/* @if counts@ */
    const golden_real *counts;
/* @end@ */
/* @elif fixed@ */
    const golden_real *rest;
    int rests;
/* @end@ */
} view_t;

typedef struct {
    void (*init)(int k);
    void (*reset)(int k);
    int (*step)(int k, const golden_real *ref, const golden_real *y, golden_real *u);
    int (*look)(int k, const golden_real *ref, const golden_real *y, golden_real *u);
    int (*settle)(int k, const golden_real *ref, const golden_real *y, golden_real *u,
        const golden_real *trend@E@);
    int (*change)(int k, const golden_real *ref, const golden_real *y, golden_real *u,
        const golden_real *trend@E@, golden_real *bump);
    view_t (*view)(int k);
    void (*spoil)(int k, int stage);
/* @if tuned@ */
    void (*tune)(int k, int set);
/* @end@ */
/* @if counts@ */
    void (*go_on)(int k, const golden_real *counts);
    void (*align)(int k, const golden_real *y);
    void (*calibrate)(int k, const golden_real *y);
/* @end@ */
} law_t;

@ADAPTERS@
static const law_t laws[] = {
@TABLE@
};

const char *const golden_names[] = {
@NAMES@
};

const unsigned golden_sizes[] = {
@SIZES@
};

static unsigned compare(const golden_real *found, const golden_word *expected, int n)
{
    golden_word bits;
    unsigned differ = 0;
    int i;
/* @if fixed@ */
/* @else@ */
    golden_real wanted;
/* @end@ */
    for (i = 0; i < n; i++) {
        memcpy(&bits, &found[i], sizeof bits);
/* @if fixed@ */
        differ += bits != expected[i];
/* @else@ */
        memcpy(&wanted, &expected[i], sizeof wanted);
        /* processors differ in the bits of what is no number */
        differ += bits != expected[i] && !(found[i] != found[i] && wanted != wanted);
/* @end@ */
    }
    return differ;
}

unsigned golden_row(const golden_word row[])
{
    static const golden_real none[3];
    static golden_real u[GOLDEN_NU], bump;
    static int law, k;
    golden_real ref[5], y[GOLDEN_NY], own[3];
/* @if counts@ */
    golden_real counts[GOLDEN_COUNTS];
    const golden_real *sensed = y; /* what the law has measured */
/* @end@ */
    unsigned differ;
    view_t now;
    int result;
    memcpy(ref, &row[3], sizeof ref);
    memcpy(y, &row[8], sizeof y);
    switch ((int)row[0]) {
    case 1: /* init */
        law = (int)row[1];
        k = 0;
        laws[law].init(k);
        memset(u, 0, sizeof u);
        bump = 0;
        break;
    case 2: /* change to the row's law */
        now = laws[law].view(k);
/* @if counts@ */
        memcpy(counts, now.counts, sizeof counts);
        sensed = &counts[GOLDEN_SENSED];
/* @end@ */
        laws[law].look(k, ref, @MEASURED@, own);
        law = (int)row[1];
        k = 1 - k;
        laws[law].init(k);
        laws[law].change(k, ref, @MEASURED@, own, now.trend@NOW_E@, &bump);
/* @if counts@ */
        laws[law].go_on(k, counts);
/* @end@ */
        break;
    case 3: /* leave the safe state */
        laws[law].reset(k);
        now = laws[law].view(k);
/* @if counts@ */
        sensed = &now.counts[GOLDEN_SENSED];
/* @end@ */
        memcpy(own, now.u, sizeof own);
        laws[law].settle(k, ref, @MEASURED@, own, none@NOW_E@);
        break;
    case 4: /* no number in the law's state */
    case 5: /* no number in its stage's */
        laws[law].spoil(k, (int)row[0] == 5);
        break;
/* @if counts@ */
    case 6:
        laws[law].calibrate(k, y);
        break;
/* @end@ */
    default: /* 7 and more: other gains */
/* @if tuned@ */
        if (row[0] >= 7) {
            laws[law].tune(k, (int)row[0] - 7);
        }
/* @end@ */
        break;
    }
    result = laws[law].step(k, ref, y, u);
    now = laws[law].view(k);
    differ = (golden_word)result != row[2];
    row += 8 + GOLDEN_NY;
    differ += compare(u, row, GOLDEN_NU) + compare(&bump, row + GOLDEN_NU, 1);
    differ += compare(now.x, row + GOLDEN_NU + 1, now.n);
    row += GOLDEN_NU + 1 + GOLDEN_NX;
    differ += compare(now.offset, row, 3) + compare(now.u, row + 3, 3);
    differ += compare(now.trend, row + 6, 3);
/* @if stages@ */
    if (result == GOLDEN_BAD_U) { /* of the stage e alone holds, from which settle goes on */
        return differ + compare(now.e, row + 9 + GOLDEN_E, 2);
    }
    differ += compare(now.stage, row + 9, GOLDEN_STAGE);
    differ += (golden_word)now.limited != row[9 + GOLDEN_STAGE];
/* @if counts@ */
    differ += compare(now.counts, row + 10 + GOLDEN_STAGE, GOLDEN_COUNTS);
/* @end@ */
/* @elif fixed@ */
    differ += compare(now.rest, row + 9, now.rests);
/* @end@ */
    return differ;
}

int golden_refusals(const golden_word row[], unsigned long elapsed[2])
{
/* @if fixed@ */
    const golden_word too_large = ~(golden_word)0 >> 1;
/* @else@ */
    const golden_word too_large = ~(golden_word)0 >> 2; /* whatever the type */
/* @end@ */
    const int law = (int)row[1], k = 2; /* no row runs this instance */
    golden_real ref[5], y[GOLDEN_NY], u[GOLDEN_NU];
    int i, result = 0;
    memcpy(ref, &row[3], sizeof ref);
    memcpy(&ref[4], &too_large, sizeof ref[4]);
    memcpy(y, &row[8], sizeof y);
    laws[law].init(k);
    for (i = 0; i < 2; i++) {
        result = laws[law].step(k, ref, y, u);
        elapsed[i] = golden_elapsed;
    }
    return result;
}

#ifndef GOLDEN_NO_MAIN
#include "golden.h"

#include <stdio.h>

int main(void)
{
    unsigned long i, differ = 0;
    for (i = 0; i < GOLDEN_ROWS; i++)
        differ += golden_row(golden[i]);
    printf("%lu rows, %lu words differ\n", (unsigned long)GOLDEN_ROWS, differ);
    return differ != 0;
}
#endif
