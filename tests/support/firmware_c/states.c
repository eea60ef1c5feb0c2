/* The states of examples/firmware_cortex_m: a line for each step, with the state, whether the gates may
 * switch, and the reason. The A/D sees a grid of 50 Hz without current, or what a step spoils. */
#include "firmware.h"
#include "loop.h"
#include "stm32f4xx.h"

#include <math.h>
#include <stdio.h>

void loop_trip(void);

unsigned long clock_now(void)
{
    return 0;
}

enum { OFFSET = 20 };

static int k;

static void ticks(int n, double v_dc, double v_a)
{
    uint16_t adc[GFM_VSG_2_NADC];
    golden_real u[GOLDEN_NU], bump, ref[] = {1, 0, 1, 0, 1};
    int i;
    for (; n > 0; n--, k++) {
        for (i = 0; i < GFM_VSG_2_NADC; i++)
            adc[i] = 2048;
        adc[GFM_VSG_2_ADC_I_A] += OFFSET;
        for (i = 0; i < 3; i++)
            adc[GFM_VSG_2_ADC_V_A + i] =
                (uint16_t)lrint(2048 + (i == 0 ? v_a : 1) * V_1 * cos(0.0314159265358979 * k - 2.0943951023932 * i));
        adc[GFM_VSG_2_ADC_V_DC] = (uint16_t)lrint(v_dc * V_DC_1);
        loop_tick("gfm_vsg_2", ref, adc, u, &bump);
    }
}

static void say(const char *what)
{
    static const char *const names[] = {"START", "READY", "RUN", "SAFE"};
    printf("%s: %s %d %d\n", what, names[firmware.state], (TIM1->BDTR & TIM_BDTR_MOE) != 0,
           firmware.reason);
}

/* What a law takes from the counts of i_a. */
static golden_real offset(int law)
{
    unsigned long size;
    void *instance = firmware_instance(law, &size);
    return law == VSG_2 ? ((gfm_vsg_2_t *)instance)->counts.shift[GFM_VSG_2_ADC_I_A]
                        : ((gfm_mimo_gfm_t *)instance)->counts.shift[GFM_MIMO_GFM_ADC_I_A];
}

int main(void)
{
    command.law = VSG_2;
    firmware_start();
    say("power");
    command.enable = 1;
    ticks(1, 0.1, 1);
    say("no v_dc");
    command.enable = 0;
    ticks(200, 1, 1);
    say("charged");
    ticks(1, 1, 1);
    say("calibrated");
    printf("%g %g\n", (double)offset(MIMO_GFM), (double)offset(VSG_2));
    command.enable = 1;
    ticks(1, 1, 1);
    say("enabled");
    ticks(200, 1, 1);
    say("runs");
    printf("%g\n", (double)offset(VSG_2));
    printf("%d\n", TIM1->CCR1 != TIM1->CCR2 && TIM1->CCR1 <= TIM1->ARR);
    command.enable = 0;
    ticks(1, 1, 1);
    say("disabled");
    command.enable = 1;
    ticks(2, 1, 1);
    loop_trip();
    say("trip");
    command.reset = 1;
    ticks(3, 1, 1);
    say("reset while enabled");
    command.enable = 0;
    ticks(201, 1, 1);
    say("reset");
    command.reset = 0;
    command.enable = 1;
    ticks(100, 1, 1);
    say("again");
    ticks(2000, 1, 0);
    say("lost v_a");
    ticks(100, 1, 1);
    say("v_a is back");
    return 0;
}
