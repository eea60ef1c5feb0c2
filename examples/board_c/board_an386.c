/* QEMU's machine mps2-an386: a Cortex-M4F with the UART of Arm's CMSDK. */

#include "board.h"

#define REGISTER(address) (*(volatile uint32_t *)(address))
#define UART 0x40004000u
#define DATA REGISTER(UART)
#define STATE REGISTER(UART + 4) /* bit 0: no room to send; bit 1: a byte has come */
#define CONTROL REGISTER(UART + 8)
#define DIVIDER REGISTER(UART + 16)

int main(void);
void reset(void);
extern char stack_top[];

__attribute__((section(".vectors"), used)) void (*const vectors[])(void) = {
    (void (*)(void))stack_top, reset};

void reset(void) {
    REGISTER(0xE000ED88) |= 0xFu << 20; /* the floating-point unit */
    __asm__ volatile("dsb\n isb");
    main();
    for (;;)
        ;
}

void uart_open(void) {
    DIVIDER = 25; /* 25 MHz / 25: 1 Mbit/s */
    CONTROL = 3;
}

uint8_t uart_read(void) {
    while ((STATE & 2) == 0)
        ;
    return (uint8_t)DATA;
}

void uart_write(const uint8_t *bytes, size_t count) {
    while (count-- > 0) {
        while ((STATE & 1) != 0)
            ;
        DATA = *bytes++;
    }
}
