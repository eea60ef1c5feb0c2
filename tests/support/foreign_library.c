/* A controller library that misbehaves at its step AT in the way that FOREIGN_WHAT names; until then
 * it leaves the bridge's voltage turning at the nominal speed. */
#define _GNU_SOURCE
#include "gfmhil_controller.h"

#include <math.h>
#include <pthread.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define AT 100
#ifndef SAYS
#define SAYS GFMHIL_CONTROLLER_VERSION
#endif

static gfmhil_setup rated;
static const char *what;
static int steps;
static cpu_set_t of_thread, of_step, of_both;
static char where[80];

static void *look(void *processors)
{
    sched_getaffinity(0, sizeof of_thread, processors);
    return NULL;
}

int gfmhil_version(void) { return SAYS; }
const char *gfmhil_name(void) { return "a library that fails"; }

void *gfmhil_new(const gfmhil_setup *setup)
{
    what = getenv("FOREIGN_WHAT");
    rated = *setup;
    pthread_t thread;
    if (!strcmp(what, "where") && !pthread_create(&thread, NULL, look, &of_thread))
        pthread_join(thread, NULL);
    if (!strcmp(what, "fork") && !fork())  /* a process of its own, in a session of its own */
        setsid();
    if (!strcmp(what, "block") || !strcmp(what, "fork"))
        for (;;)
            sleep(1);
    return strcmp(what, "refuse") ? &rated : NULL;
}

int gfmhil_start(void *self, const gfmhil_input *in, const gfmhil_output *now)
{
    (void)self, (void)in, (void)now;
    steps = 0;
    return strcmp(what, "start") ? 0 : 3;
}

int gfmhil_step(void *self, const gfmhil_input *in, gfmhil_output *out)
{
    (void)self, (void)in;
    /* after the first call e turns by its angle in one period */
    const double turn = steps ? rated.omega_n * rated.period : 0.0;
    const double c = cos(turn), s = sin(turn) / sqrt(3.0);
    const double a = out->e[0], b = out->e[1], d = out->e[2];
    out->e[0] = c * a - s * (b - d);
    out->e[1] = c * b - s * (d - a);
    out->e[2] = c * d - s * (a - b);
    if (!strcmp(what, "talk"))
        for (int k = 0; k < 1000; k++)
            puts("a line of sixty-four bytes, which a controller prints at each step");
    if (steps++ < AT)
        return 0;
    if (!strcmp(what, "crash"))
        *(volatile int *)0 = 1;
    if (!strcmp(what, "hang"))
        for (;;)
            sleep(1);
    if (!strcmp(what, "slow"))
        usleep(80000);
    if (!strcmp(what, "pause") && steps == AT + 1)
        sleep(2);
    if (!strcmp(what, "where")) {
        look(&of_step);
        CPU_AND(&of_both, &of_step, &of_thread);
        snprintf(where, sizeof where, "%d for its thread, %d for its step, %d for both",
                 CPU_COUNT(&of_thread), CPU_COUNT(&of_step), CPU_COUNT(&of_both));
        return 8;
    }
    if (!strcmp(what, "nan"))
        out->e[1] = NAN;
    return strcmp(what, "fault") ? 0 : 7;
}

const char *gfmhil_fault(void *self, int number)
{
    (void)self;
    return number == 7 ? "the cooling has stopped" : number == 8 ? where : NULL;
}

void gfmhil_free(void *self) { (void)self; }
