/* ZeroMQ: libzmq's functions, by address, on an open socket. */
#define _GNU_SOURCE
#include <stddef.h>
#include <stdint.h>

enum { YIELDS = 1, LONGEST = 512, DONTWAIT = 1 /* ZMQ_DONTWAIT */ };

typedef struct {
    void *socket;
    int (*zmq_send)(void *, const void *, size_t, int);
    int (*zmq_recv)(void *, void *, size_t, int);
} end_t;

/* Addresses of the socket, of zmq_send and of zmq_recv. */
static end_t open_end(const int64_t *opened)
{
    return *(const end_t *)opened;
}

static void transmit(end_t *e, const void *message, int64_t size)
{
    e->zmq_send(e->socket, message, size, DONTWAIT);
}

static int64_t receive(end_t *e, void *message)
{
    int size = e->zmq_recv(e->socket, message, LONGEST, DONTWAIT);
    return size > 0 ? size : 0;
}

#include "pingpong.h"
