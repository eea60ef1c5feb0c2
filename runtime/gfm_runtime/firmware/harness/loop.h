/* What a firmware of one's own gives the program of a processor in the loop, which then has it in place
 * of the bare laws. A law is named as its module, such as gfm_vsg_2. */
#ifndef GFM_LOOP_H
#define GFM_LOOP_H

#include "selftest.h"

enum { LOOP_BLOCKED = -1 }; /* of loop_tick: no reason, but the gates stay blocked */

/* Be enabled with this law; its instance begins as this one. Returns 0 if there is no such law. */
int loop_start(const char *law, const void *instance);

/* The law's instance, as it is now. */
void *loop_instance(const char *law);

/* One interrupt, under this law: from counts of the A/D to u of the law and the compare counts, and
 * the bump of a change of law in this tick. golden_elapsed is what the interrupt took. Returns why
 * the gates are blocked, or 0. */
int loop_tick(const char *law, const golden_real ref[], const uint16_t adc[], golden_real u[],
              golden_real *bump);

/* Reads the clock, of which loop_tick sets golden_elapsed. */
unsigned long clock_now(void);

#endif
