/* What the program needs of a board: two hooks for its UART. board_an386.c is one board; write these
   two functions for yours. */

#ifndef BOARD_H
#define BOARD_H

#include <stddef.h>
#include <stdint.h>

/* Set the UART up: 8 data bits, no parity, 1 stop bit, at the rate of link.options.baud. */
void uart_open(void);

/* Wait for the next byte. */
uint8_t uart_read(void);

/* Send bytes, waiting for room. */
void uart_write(const uint8_t *bytes, size_t count);

#endif
