/* The program on a chip; in the loop, the loop has main. */
#ifndef LOOP_FIRMWARE
#include "firmware.h"

/* Of the board: clocks, pins, the converters with their trigger; then TIM1 and both interrupts on. */
void board_start(void);
void board_go(void);

/* Of the board: what the operator or the fieldbus wants now. */
void board_commands(volatile command_t *wanted, const volatile firmware_t *now);

int main(void)
{
    board_start();
    firmware_start();
    board_go();
    for (;;)
        board_commands(&command, &firmware);
}
#endif
