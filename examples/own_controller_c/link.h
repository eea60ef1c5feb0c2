/* One end of a link to gfmhil's plant: whole messages, in order.

   link_zmq.c and link_shm.c both implement it; the Makefile builds one program with each. */

#ifndef LINK_H
#define LINK_H

#include <stdbool.h>
#include <stddef.h>

enum { LONGEST = 504 }; /* bytes of a message; the greeting takes about 300 */

typedef struct link link_t;

/* Open the controller's end. Says why on stderr and returns NULL if that fails. */
link_t *link_open(const char *endpoint);

/* Hand a message over; false if the plant has no room for it or is not there yet. */
bool link_send(link_t *link, const void *message, size_t size);

/* Wait up to wait_ms for a message and write at most LONGEST bytes of it. Returns its size, or 0
   if none came in time or a signal interrupted the wait. */
size_t link_receive(link_t *link, void *message, int wait_ms);

/* Free the endpoint; the messages sent last still reach the plant. */
void link_close(link_t *link);

#endif
