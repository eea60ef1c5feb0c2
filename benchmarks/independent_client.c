/* A client of each link in C, written from docs/links.md, docs/protection.md and the DBC alone, which
 * times its round trips by its own clock. cantools generates can_link.h and can_link.c from the DBC. */
#define _GNU_SOURCE
#include <sched.h>
#include <stdint.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "can_link.h"

enum { SHM, ZMQ, SERIAL, CAN };           /* numbers[0] */
enum { SLOTS = 64, SLOT = 512, WORD = 8 }; /* of a ring in shared memory */
enum { FIRST_VALUE = 20, MOST = 1024, DONTWAIT = 1, SILENCE_NS = 1000000000 };

static int64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

/* numbers: kind, and of SHM the addresses of the ring to write and of the ring to read, with their
 * heads; of ZMQ the socket, zmq_send and zmq_recv; of SERIAL and CAN the file descriptors to read
 * from and to write to, of CAN the data ids of both frames. */
typedef struct {
    const int64_t *numbers;
    uint64_t sent, taken;    /* messages */
    uint8_t bytes[MOST];     /* of the line, not yet a message */
    int64_t there;           /* how many */
    double y[5], u[3];
} client_t;

static int send_shm(client_t *c, const uint8_t *message, uint64_t size)
{
    char *slot = (char *)c->numbers[1] + c->sent % SLOTS * SLOT;
    uint64_t *head = (uint64_t *)c->numbers[2];
    if (c->sent - __atomic_load_n(head, __ATOMIC_ACQUIRE) >= SLOTS)
        return 0;
    memcpy(slot + WORD, message, size);
    c->sent++;
    __atomic_store_n((uint64_t *)slot, c->sent << 16 | size, __ATOMIC_RELEASE);
    return 1;
}

static int64_t receive_shm(client_t *c, uint8_t *message)
{
    char *slot = (char *)c->numbers[3] + c->taken % SLOTS * SLOT;
    uint64_t stamp = __atomic_load_n((uint64_t *)slot, __ATOMIC_ACQUIRE);
    if (stamp >> 16 != c->taken + 1) {
        __builtin_ia32_pause();
        return 0;
    }
    int64_t size = stamp & 0xffff;
    memcpy(message, slot + WORD, size);
    c->taken++;
    __atomic_store_n((uint64_t *)c->numbers[4], c->taken, __ATOMIC_RELEASE);
    return size;
}

/* COBS: each zero becomes the distance to the next one; a zero ends the message. */
static int64_t stuff(const uint8_t *message, int64_t size, uint8_t *out)
{
    int64_t code = 0, n = 1;
    for (int64_t k = 0; k < size; k++)
        if (message[k] == 0) {
            out[code] = n - code;
            code = n++;
        } else
            out[n++] = message[k];
    out[code] = n - code;
    out[n++] = 0;
    return n;
}

static int64_t unstuff(const uint8_t *in, int64_t end, uint8_t *message)
{
    int64_t n = 0;
    for (int64_t k = 0; k < end;) {
        int64_t next = k + in[k];
        for (k++; k < next && k < end; k++)
            message[n++] = in[k];
        if (k < end)
            message[n++] = 0;
    }
    return n;
}

static int64_t receive_serial(client_t *c, uint8_t *message)
{
    int64_t got = read(c->numbers[1], c->bytes + c->there, MOST - c->there);
    if (got <= 0)
        return 0;
    c->there += got;
    uint8_t *zero = memchr(c->bytes, 0, c->there);
    if (zero == NULL)
        return 0;
    c->there = 0; /* one exchange at a time: nothing is behind it */
    return unstuff(c->bytes, zero - c->bytes, message);
}

/* CRC-8 SAE J1850 over the data id and all bytes behind the first. */
static uint8_t crc8(uint16_t id, const uint8_t *data, int size)
{
    static uint8_t table[256];
    if (table[1] == 0)
        for (int k = 0; k < 256; k++) {
            uint8_t r = k;
            for (int bit = 0; bit < 8; bit++)
                r = r & 0x80 ? r << 1 ^ 0x1d : r << 1;
            table[k] = r;
        }
    uint8_t r = table[0xff ^ (id & 0xff)];
    r = table[r ^ id >> 8];
    for (int k = 1; k < size; k++)
        r = table[r ^ data[k]];
    return r ^ 0xff;
}

typedef struct {
    uint32_t id;
    uint8_t length, flags, reserved[2], data[64];
} frame_t; /* struct canfd_frame */

static int send_can(client_t *c, const uint8_t *message)
{
    struct can_link_measurements_t m = {0};
    memcpy(c->y, message + FIRST_VALUE, sizeof c->y);
    m.v_dc = can_link_measurements_v_dc_encode(c->y[0]);
    m.p = can_link_measurements_p_encode(c->y[1]);
    m.omega_u = can_link_measurements_omega_u_encode(c->y[2]);
    m.q = can_link_measurements_q_encode(c->y[3]);
    m.v = can_link_measurements_v_encode(c->y[4]);
    m.counter = c->sent++ % 64;
    frame_t f = {CAN_LINK_MEASUREMENTS_FRAME_ID, CAN_LINK_MEASUREMENTS_LENGTH, 0x05, {0}, {0}};
    can_link_measurements_pack(f.data, &m, f.length);
    f.data[0] = crc8(c->numbers[3], f.data, f.length);
    return send(c->numbers[2], &f, 8 + f.length, MSG_DONTWAIT) > 0;
}

static int64_t receive_can(client_t *c)
{
    frame_t f;
    struct can_link_commands_t m;
    if (recv(c->numbers[1], &f, sizeof f, MSG_DONTWAIT) <= 0)
        return 0;
    if (f.id != CAN_LINK_COMMANDS_FRAME_ID || f.data[0] != crc8(c->numbers[4], f.data, f.length))
        return 0; /* the controller's status */
    can_link_commands_unpack(&m, f.data, f.length);
    c->u[0] = can_link_commands_i_u_decode(m.i_u);
    c->u[1] = can_link_commands_omega_u_decode(m.omega_u);
    c->u[2] = can_link_commands_e_u_decode(m.e_u);
    return f.length;
}

static int send_one(client_t *c, const uint8_t *message, int64_t size)
{
    uint8_t out[MOST];
    switch (c->numbers[0]) {
    case SHM:
        return send_shm(c, message, size);
    case ZMQ:
        return ((int (*)(void *, const void *, size_t, int))c->numbers[2])(
                   (void *)c->numbers[1], message, size, DONTWAIT) > 0;
    case SERIAL:
        return write(c->numbers[2], out, stuff(message, size, out)) > 0;
    default:
        return send_can(c, message);
    }
}

static int64_t receive_one(client_t *c, uint8_t *message)
{
    switch (c->numbers[0]) {
    case SHM:
        return receive_shm(c, message);
    case ZMQ:
        return ((int (*)(void *, void *, size_t, int))c->numbers[3])(
            (void *)c->numbers[1], message, MOST, DONTWAIT);
    case SERIAL:
        return receive_serial(c, message);
    default:
        return receive_can(c);
    }
}

/* Fills took[] with the ns of round trips, one after the other, of the messages in turn. Returns
 * their number, or -1 if no answer came for a second. */
int64_t exchange(client_t *c, const int64_t *numbers, const uint8_t *messages, int64_t count,
                 int64_t size, int64_t duration, int64_t *took, int64_t capacity)
{
    uint8_t answer[MOST];
    c->numbers = numbers;
    while (receive_one(c, answer) > 0) /* late answers of an earlier round */
        ;
    int64_t begin = now_ns(), end = begin + duration, n = 0;
    while (n < capacity && begin < end) {
        send_one(c, messages + n % count * size, size);
        for (int64_t polls = 1; receive_one(c, answer) <= 0; polls++) {
            if (numbers[0] == ZMQ)
                sched_yield();
            if (polls % 1024 == 0 && now_ns() - begin > SILENCE_NS)
                return -1;
        }
        int64_t now = now_ns();
        took[n++] = now - begin;
        begin = now;
    }
    return n;
}

const int64_t SIZE_OF_CLIENT = sizeof(client_t);
