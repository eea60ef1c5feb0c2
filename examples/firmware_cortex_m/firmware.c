/* From the A/D's end of conversion to the timer's compare registers, for an STM32F407: a Cortex-M4F
 * at 168 MHz. TIM1 counts up and down, 10 kHz; at its lower end it starts the injected conversions of
 * ADC1 to ADC3, phase a, b and c: current of L_f, voltage of C_f, current of the line; ADC1 then v_dc. */
#include "firmware.h"
#include "stm32f4xx.h"

#include <string.h>

enum { TOP = 8400 };       /* 168 MHz / 10 kHz / 2 */
enum { DTG_2_US = 0xCA };  /* (32 + 10) * 8 / 168 MHz */
enum { V_DC_LOW = 1000 };  /* counts with which the DC link is charged */
enum { NADC = GFM_VSG_2_NADC, NCMP = GFM_VSG_2_NCMP, NY = GFM_VSG_2_NY, NROWS = GFM_VSG_2_NROWS };

volatile command_t command;
volatile firmware_t firmware;

/* ---- the laws --------------------------------------------------------------------------- */

typedef struct law {
    const char *name;
    void *instance;
    unsigned long size;
    const real *trend, *e; /* with which another law goes on */
    const void *counts;
    const int *channel;
    void (*sense)(const uint16_t adc[], real y[]);
    int (*calibrate)(const uint16_t adc[], int *goes_on);
    int (*begin)(const real ref[], const uint16_t adc[]);
    int (*tick)(const real ref[], const uint16_t adc[], real u[], uint16_t cmp[]);
    int (*look)(const real ref[], const real y[], real u[]);
    int (*take_over)(const struct law *from, const real ref[], const uint16_t adc[], real *bump);
} law_t;

/* senses: what ticks will measure. calibrates: takes counts without current for the sensors' offsets, and
 * goes on until it has as many as board.toml says. begins: along the measured voltage, without current,
 * with these offsets. takes_over: at the old law's u, without a bump. */
#define LAW(P, GUARD)                                                                              \
static P##_t P;                                                                                    \
static void P##_senses(const uint16_t adc[], real y[])                                             \
{                                                                                                  \
    P##_t now = P;                                                                                 \
    P##_sense(&now, adc);                                                                          \
    memcpy(y, now.counts.sensed, sizeof now.counts.sensed);                                        \
}                                                                                                  \
static int P##_calibrates(const uint16_t adc[], int *goes_on)                                      \
{                                                                                                  \
    const real before = P.counts.calibrated;                                                       \
    const int reason = P##_calibrate(&P, adc);                                                     \
    *goes_on = P.counts.calibrated != before;                                                      \
    return reason;                                                                                 \
}                                                                                                  \
static int P##_begins(const real ref[], const uint16_t adc[])                                      \
{                                                                                                  \
    static const real trend[NROWS];                                                                \
    real y[NY], u[NROWS] = {0, 1, 1}, shift[NADC];                                                 \
    memcpy(shift, P.counts.shift, sizeof shift);                                                   \
    P##_init(&P);                                                                                  \
    memcpy(P.counts.shift, shift, sizeof shift);                                                   \
    P##_align(&P, adc);                                                                            \
    P##_senses(adc, y);                                                                            \
    return P##_settle(&P, ref, y, u, trend, &y[GUARD##_Y_V_D]);                                    \
}                                                                                                  \
static int P##_ticks(const real ref[], const uint16_t adc[], real u[], uint16_t cmp[])             \
{                                                                                                  \
    return P##_isr(&P, ref, adc, u, cmp);                                                          \
}                                                                                                  \
static int P##_looks(const real ref[], const real y[], real u[])                                   \
{                                                                                                  \
    return P##_look(&P, ref, y, u);                                                                \
}                                                                                                  \
static int P##_takes_over(const law_t *from, const real ref[], const uint16_t adc[], real *bump)   \
{                                                                                                  \
    real y[NY], u[NROWS];                                                                          \
    int reason;                                                                                    \
    from->sense(adc, y);                                                                           \
    reason = from->look(ref, y, u);                                                                \
    P##_init(&P);                                                                                  \
    if (reason == GUARD##_OK)                                                                      \
        reason = P##_switch(&P, ref, y, u, from->trend, from->e, bump);                            \
    memcpy(&P.counts, from->counts, sizeof P.counts);                                              \
    return reason;                                                                                 \
}

#define ENTRY(P)                                                                                   \
    {                                                                                              \
        #P, &P, sizeof P, P.trend, P.stage.e, &P.counts, &P.channel, P##_senses, P##_calibrates,   \
            P##_begins, P##_ticks, P##_looks, P##_takes_over                                       \
    }

LAW(gfm_mimo_gfm, GFM_MIMO_GFM)
LAW(gfm_vsg_2, GFM_VSG_2)

static const law_t laws[LAWS] = {ENTRY(gfm_mimo_gfm), ENTRY(gfm_vsg_2)}; /* as the enum */

const char *firmware_name(int law)
{
    return laws[law].name;
}

void *firmware_instance(int law, unsigned long *size)
{
    *size = laws[law].size;
    return laws[law].instance;
}

/* ---- the states ------------------------------------------------------------------------- */

static void block(void)
{
    TIM1->BDTR &= ~(TIM_BDTR_MOE | TIM_BDTR_AOE);
}

static void make_safe(int reason, int channel)
{
    block();
    firmware.state = SAFE;
    firmware.reason = reason;
    firmware.channel = channel;
}

void firmware_start(void)
{
    block();
    TIM1->CR1 = TIM_CR1_CMS_0 | TIM_CR1_ARPE; /* up and down */
    TIM1->ARR = TOP;
    TIM1->CCMR1 = TIM_CCMR1_OC1PE | TIM_CCMR1_OC1M_1 | TIM_CCMR1_OC1M_2 | TIM_CCMR1_OC2PE
                  | TIM_CCMR1_OC2M_1 | TIM_CCMR1_OC2M_2;
    TIM1->CCMR2 = TIM_CCMR2_OC3PE | TIM_CCMR2_OC3M_1 | TIM_CCMR2_OC3M_2; /* up below the compare value */
    TIM1->CCER = TIM_CCER_CC1E | TIM_CCER_CC1NE | TIM_CCER_CC2E | TIM_CCER_CC2NE | TIM_CCER_CC3E
                 | TIM_CCER_CC3NE;
    TIM1->BDTR = TIM_BDTR_OSSI | TIM_BDTR_BKE | DTG_2_US; /* the trip input, active low */
    TIM1->SR = 0;
    TIM1->DIER = TIM_DIER_BIE;
    gfm_mimo_gfm_init(&gfm_mimo_gfm);
    gfm_vsg_2_init(&gfm_vsg_2);
    firmware.state = START;
    firmware.law = command.law;
    firmware.reason = firmware.settled = 0;
    firmware.channel = -1;
}

/* The trip input: the timer has blocked the gates by itself. */
void TIM1_BRK_TIM9_IRQHandler(void)
{
    TIM1->SR = ~TIM_SR_BIF;
    make_safe(TRIPPED, -1);
}

/* A tick in START with a charged DC link, while the gates are blocked and no current flows. */
static void calibrate(const uint16_t adc[])
{
    int law, any = 0;
    for (law = 0; law < LAWS && !firmware.settled && firmware.state == START; law++) {
        int goes_on, reason = laws[law].calibrate(adc, &goes_on);
        if (reason != GFM_VSG_2_OK)
            make_safe(reason, *laws[law].channel);
        any |= goes_on;
    }
    if (firmware.state == START && !any)
        firmware.state = READY;
}

static void read_counts(uint16_t adc[])
{
    adc[GFM_VSG_2_ADC_I_A] = (uint16_t)ADC1->JDR1;
    adc[GFM_VSG_2_ADC_I_B] = (uint16_t)ADC2->JDR1;
    adc[GFM_VSG_2_ADC_I_C] = (uint16_t)ADC3->JDR1;
    adc[GFM_VSG_2_ADC_V_A] = (uint16_t)ADC1->JDR2;
    adc[GFM_VSG_2_ADC_V_B] = (uint16_t)ADC2->JDR2;
    adc[GFM_VSG_2_ADC_V_C] = (uint16_t)ADC3->JDR2;
    adc[GFM_VSG_2_ADC_I_O_A] = (uint16_t)ADC1->JDR3;
    adc[GFM_VSG_2_ADC_I_O_B] = (uint16_t)ADC2->JDR3;
    adc[GFM_VSG_2_ADC_I_O_C] = (uint16_t)ADC3->JDR3;
    adc[GFM_VSG_2_ADC_V_DC] = (uint16_t)ADC1->JDR4;
}

/* A tick in RUN. The compare registers are preloaded, so they act from the timer's next update on; the
 * first time AOE lets that update set MOE, so that no gate switches with older values. */
static void run(const real ref[], const uint16_t adc[])
{
    const int wanted = command.law, first = (TIM1->BDTR & TIM_BDTR_MOE) == 0;
    int i, reason = GFM_VSG_2_OK;
    uint16_t cmp[NCMP + 1];
    real u[GFM_VSG_2_NU], bump;
    if (wanted != firmware.law && wanted >= 0 && wanted < LAWS) {
        reason = laws[wanted].take_over(&laws[firmware.law], ref, adc, &bump);
        firmware.law = wanted;
        firmware.bump = bump;
    }
    if (reason == GFM_VSG_2_OK)
        reason = laws[firmware.law].tick(ref, adc, u, cmp);
    if (reason != GFM_VSG_2_OK || cmp[NCMP] == 0) {
        make_safe(reason, *laws[firmware.law].channel);
        return;
    }
    TIM1->CCR1 = cmp[0];
    TIM1->CCR2 = cmp[1];
    TIM1->CCR3 = cmp[2];
    for (i = 0; i < GFM_VSG_2_NU; i++)
        firmware.u[i] = u[i];
    if (first)
        TIM1->BDTR |= TIM_BDTR_AOE;
    else
        TIM1->BDTR &= ~TIM_BDTR_AOE;
}

void ADC_IRQHandler(void)
{
    uint16_t adc[NADC];
    real ref[GFM_VSG_2_NREF];
    int i, reason;
    ADC1->SR = ~ADC_SR_JEOC;
    read_counts(adc);
    for (i = 0; i < GFM_VSG_2_NREF; i++)
        ref[i] = command.ref[i];
    if (firmware.state == SAFE && command.reset && !command.enable)
        firmware_start();
    if (firmware.state == START && adc[GFM_VSG_2_ADC_V_DC] >= V_DC_LOW)
        calibrate(adc);
    if (firmware.state == RUN && !command.enable) {
        block();
        firmware.state = READY;
    }
    if (firmware.state == READY && command.enable) {
        firmware.state = RUN;
        firmware.law = command.law;
        reason = firmware.settled ? GFM_VSG_2_OK : laws[firmware.law].begin(ref, adc);
        firmware.settled = 0;
        if (reason != GFM_VSG_2_OK)
            make_safe(reason, *laws[firmware.law].channel);
    }
    if (firmware.state == RUN)
        run(ref, adc);
}
