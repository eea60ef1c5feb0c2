/* The ZeroMQ link: a PAIR socket, which the controller binds and the plant connects to. */

#include "link.h"

#include <stdio.h>
#include <stdlib.h>
#include <zmq.h>

enum { ROOM = 64, KERNEL_ROOM = 16384, LINGER_MS = 500 };

struct link {
    void *context, *socket;
};

link_t *link_open(const char *endpoint) {
    static struct link link;
    const int room = ROOM, kernel_room = KERNEL_ROOM, linger = LINGER_MS;
    link.context = zmq_ctx_new();
    link.socket = zmq_socket(link.context, ZMQ_PAIR);
    /* Bound what a stalled plant leaves unread: a frame that is late is worth nothing. */
    zmq_setsockopt(link.socket, ZMQ_SNDHWM, &room, sizeof room);
    zmq_setsockopt(link.socket, ZMQ_RCVHWM, &room, sizeof room);
    zmq_setsockopt(link.socket, ZMQ_SNDBUF, &kernel_room, sizeof kernel_room);
    zmq_setsockopt(link.socket, ZMQ_RCVBUF, &kernel_room, sizeof kernel_room);
    /* Give the last frames half a second to leave when the socket is closed. */
    zmq_setsockopt(link.socket, ZMQ_LINGER, &linger, sizeof linger);
    if (zmq_bind(link.socket, endpoint) != 0) {
        fprintf(stderr, "%s: cannot be bound: %s\n", endpoint, zmq_strerror(zmq_errno()));
        link_close(&link);
        return NULL;
    }
    return &link;
}

bool link_send(link_t *link, const void *message, size_t size) {
    return zmq_send(link->socket, message, size, ZMQ_DONTWAIT) == (int)size;
}

size_t link_receive(link_t *link, void *message, int wait_ms) {
    zmq_pollitem_t item = {.socket = link->socket, .events = ZMQ_POLLIN};
    if (zmq_poll(&item, 1, wait_ms) <= 0)
        return 0;
    const int size = zmq_recv(link->socket, message, LONGEST, ZMQ_DONTWAIT);
    return size < 0 ? 0 : (size_t)size; /* a longer message tells its length and is cut off */
}

void link_close(link_t *link) {
    zmq_close(link->socket);
    zmq_ctx_term(link->context);
}
