/* The chip around firmware.c when it runs in the loop: registers in RAM, which this file writes and
 * reads as converters and timer do, and interrupts, which on a Cortex-M come through its NVIC. */
#include "loop.h"
#include "firmware.h"
#include "stm32f4xx.h"

#include <string.h>

ADC_TypeDef ADC_in_RAM[3];
TIM_TypeDef TIM1_in_RAM;

#ifdef __arm__
#define CORE(address) (*(volatile uint32_t *)(address))
enum { VECTORS = 64 };
__attribute__((aligned(4 * VECTORS))) static void (*const vectors[VECTORS])(void) = {
    [16 + ADC_IRQn] = ADC_IRQHandler, [16 + TIM1_BRK_TIM9_IRQn] = TIM1_BRK_TIM9_IRQHandler};

static void enable_interrupts(void)
{
    CORE(0xE000ED08) = (uint32_t)vectors;                                      /* SCB->VTOR */
    CORE(0xE000E100) = (1UL << ADC_IRQn) | (1UL << TIM1_BRK_TIM9_IRQn); /* NVIC->ISER[0] */
}

static void interrupt(IRQn_Type which)
{
    CORE(0xE000E200) = 1UL << which; /* NVIC->ISPR[0] */
    __asm__ volatile("dsb\n isb" ::: "memory");
}
#else
static void enable_interrupts(void)
{
}

static void interrupt(IRQn_Type which)
{
    if (which == ADC_IRQn)
        ADC_IRQHandler();
    else
        TIM1_BRK_TIM9_IRQHandler();
}
#endif

static int number(const char *name)
{
    int law = 0;
    while (law < LAWS && strcmp(firmware_name(law), name) != 0)
        law++;
    return law;
}

/* The conversions are at their end. */
static void convert(const uint16_t adc[])
{
    int phase;
    for (phase = 0; phase < 3; phase++) {
        ADC_in_RAM[phase].JDR1 = adc[GFM_VSG_2_ADC_I_A + phase];
        ADC_in_RAM[phase].JDR2 = adc[GFM_VSG_2_ADC_V_A + phase];
        ADC_in_RAM[phase].JDR3 = adc[GFM_VSG_2_ADC_I_O_A + phase];
    }
    ADC1->JDR4 = adc[GFM_VSG_2_ADC_V_DC];
    ADC1->SR |= ADC_SR_JEOC;
}

/* The timer's update, which sets MOE if it may. */
static void update(void)
{
    if ((TIM1->BDTR & TIM_BDTR_AOE) != 0 && (TIM1->SR & TIM_SR_BIF) == 0)
        TIM1->BDTR |= TIM_BDTR_MOE;
}

/* The trip input: the timer blocks the gates, then it interrupts. */
void loop_trip(void)
{
    TIM1->BDTR &= ~TIM_BDTR_MOE;
    TIM1->SR |= TIM_SR_BIF;
    interrupt(TIM1_BRK_TIM9_IRQn);
}

int loop_start(const char *law, const void *instance)
{
    const int k = number(law);
    unsigned long size;
    void *own;
    if (k == LAWS)
        return 0;
    enable_interrupts();
    command.law = k;
    command.enable = 0;
    firmware_start();
    own = firmware_instance(k, &size);
    memcpy(own, instance, size);
    firmware.settled = 1; /* the bench gives the state, in mid operation */
    command.enable = 1;
    return 1;
}

int loop_tick(const char *law, const golden_real ref[], const uint16_t adc[], golden_real u[],
              golden_real *bump)
{
    unsigned long before, reading = clock_now();
    int i;
    reading = clock_now() - reading;
    command.law = number(law);
    for (i = 0; i < GFM_VSG_2_NREF; i++)
        command.ref[i] = ref[i];
    firmware.bump = 0;
    convert(adc);
    before = clock_now();
    interrupt(ADC_IRQn);
    golden_elapsed = clock_now() - before - reading;
    update();
    for (i = 0; i < GFM_VSG_2_NU; i++)
        u[i] = firmware.u[i];
    u[GFM_VSG_2_NU] = (golden_real)TIM1->CCR1;
    u[GFM_VSG_2_NU + 1] = (golden_real)TIM1->CCR2;
    u[GFM_VSG_2_NU + 2] = (golden_real)TIM1->CCR3;
    *bump = firmware.bump;
    if (firmware.state == SAFE)
        return firmware.reason;
    return (TIM1->BDTR & TIM_BDTR_MOE) != 0 ? GFM_VSG_2_OK : LOOP_BLOCKED;
}

void *loop_instance(const char *law)
{
    unsigned long size;
    return firmware_instance(number(law), &size);
}
