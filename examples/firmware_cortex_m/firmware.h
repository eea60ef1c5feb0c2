/* The converter's firmware as the rest of the processor sees it. */
#ifndef FIRMWARE_H
#define FIRMWARE_H

#include "gfm_mimo_gfm.h"
#include "gfm_vsg_2.h"

#include <stdint.h>

typedef gfm_vsg_2_real real;

/* The gates may switch in RUN alone. SAFE is left by a reset only. */
typedef enum { START, READY, RUN, SAFE } state_t;

enum { MIMO_GFM, VSG_2, LAWS };
enum { TRIPPED = 100 }; /* a reason beside those of the laws: the trip input */

/* What an operator or a fieldbus writes between two interrupts. */
typedef struct {
    real ref[GFM_VSG_2_NREF];
    int law;    /* which one is to control */
    int enable; /* READY to RUN, and at 0 back */
    int reset;  /* SAFE to START, if enable is 0 */
} command_t;

extern volatile command_t command;

typedef struct {
    state_t state;
    int law;
    int reason, channel;   /* of SAFE: why, and which signal */
    real u[GFM_VSG_2_NU];  /* i_u, omega_u, e; i_u is the DC source's */
    real bump;             /* of the last change of law, p.u. */
    int settled;           /* whether RUN begins with the law's instance as it is */
} firmware_t;

extern volatile firmware_t firmware;

/* Once, before the interrupts: the timer stands, and the gates are blocked. */
void firmware_start(void);

/* Of a law: its name, and its instance for a calibration tool. */
const char *firmware_name(int law);
void *firmware_instance(int law, unsigned long *size);

void ADC_IRQHandler(void);
void TIM1_BRK_TIM9_IRQHandler(void);

#endif
