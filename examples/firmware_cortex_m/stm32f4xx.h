/* Stands in for the manufacturer's header: the registers that firmware.c works on, in RAM, under their
 * CMSIS names and with their bits. On a chip take its own stm32f4xx.h, and leave this file out. */
#ifndef STM32F4XX_H
#define STM32F4XX_H

#include <stdint.h>

#define __IO volatile

typedef enum { ADC_IRQn = 18, TIM1_BRK_TIM9_IRQn = 24 } IRQn_Type;

typedef struct {
    __IO uint32_t SR, CR1, CR2, SMPR1, SMPR2, JOFR1, JOFR2, JOFR3, JOFR4, HTR, LTR, SQR1, SQR2, SQR3;
    __IO uint32_t JSQR, JDR1, JDR2, JDR3, JDR4, DR;
} ADC_TypeDef;

typedef struct {
    __IO uint32_t CR1, CR2, SMCR, DIER, SR, EGR, CCMR1, CCMR2, CCER, CNT, PSC, ARR, RCR;
    __IO uint32_t CCR1, CCR2, CCR3, CCR4, BDTR, DCR, DMAR;
} TIM_TypeDef;

extern ADC_TypeDef ADC_in_RAM[3];
extern TIM_TypeDef TIM1_in_RAM;

#define ADC1 (&ADC_in_RAM[0])
#define ADC2 (&ADC_in_RAM[1])
#define ADC3 (&ADC_in_RAM[2])
#define TIM1 (&TIM1_in_RAM)

#define ADC_SR_JEOC (1U << 2)
#define TIM_CR1_CMS_0 (1U << 5)
#define TIM_CR1_ARPE (1U << 7)
#define TIM_DIER_BIE (1U << 7)
#define TIM_SR_BIF (1U << 7)
#define TIM_CCMR1_OC1PE (1U << 3)
#define TIM_CCMR1_OC1M_1 (2U << 4)
#define TIM_CCMR1_OC1M_2 (4U << 4)
#define TIM_CCMR1_OC2PE (1U << 11)
#define TIM_CCMR1_OC2M_1 (2U << 12)
#define TIM_CCMR1_OC2M_2 (4U << 12)
#define TIM_CCMR2_OC3PE (1U << 3)
#define TIM_CCMR2_OC3M_1 (2U << 4)
#define TIM_CCMR2_OC3M_2 (4U << 4)
#define TIM_CCER_CC1E (1U << 0)
#define TIM_CCER_CC1NE (1U << 2)
#define TIM_CCER_CC2E (1U << 4)
#define TIM_CCER_CC2NE (1U << 6)
#define TIM_CCER_CC3E (1U << 8)
#define TIM_CCER_CC3NE (1U << 10)
#define TIM_BDTR_OSSI (1U << 10)
#define TIM_BDTR_BKE (1U << 12)
#define TIM_BDTR_AOE (1U << 14)
#define TIM_BDTR_MOE (1U << 15)

#endif
