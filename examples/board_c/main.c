/* A board as the controller of gfmhil's plant, over a UART: the exported law, the frames and their
   stuffing, and nothing of an operating system. docs/own-controller.md describes the protocol, and
   docs/links.md the serial line. */

#include "board.h"
#include "gfm_vsg_2.h"

#include <stdbool.h>
#include <string.h>

enum { NY = GFM_VSG_2_NY, NU = GFM_VSG_2_NU, MAGIC = 0x4647, VERSION = 2, Y_ID = 1, U_ID = 2 };
enum { READY = 1, RUNNING = 2, SAFE = 3, STOPPED = 4, LONGEST = 504, CRC = 4, RUN = 254 };

#define GREETING "GFMHIL "

typedef struct __attribute__((packed)) {
    uint16_t magic;
    uint8_t version, data_id, state, reason;
    uint16_t spare;
    uint32_t sequence;
    uint64_t tick;
} header_t;

typedef struct __attribute__((packed)) {
    header_t head;
    double y[NY]; /* v_dc, p, omega_u, q, V */
    uint32_t crc;
} y_frame_t;

typedef struct __attribute__((packed)) {
    header_t head;
    double u[NU]; /* i_u, omega_u, E_u */
    uint32_t crc;
} u_frame_t;

static uint32_t crc32(const void *data, size_t size) {
    const uint8_t *byte = data;
    uint32_t crc = 0xFFFFFFFF;
    while (size-- > 0) {
        crc ^= *byte++;
        for (int bit = 0; bit < 8; bit++)
            crc = crc >> 1 ^ (crc & 1 ? 0xEDB88320 : 0);
    }
    return ~crc;
}

/* ---- the line: COBS, and a zero after each message ---------------------------------------- */

static void line_send(const void *message, size_t size) {
    const uint8_t *byte = message, zero = 0;
    size_t at = 0;
    for (;;) {
        uint8_t block[RUN + 1];
        size_t run = 0;
        while (run < RUN && at + run < size && byte[at + run] != 0)
            run++;
        block[0] = (uint8_t)(run + 1);
        memcpy(block + 1, byte + at, run);
        uart_write(block, run + 1);
        at += run;
        if (run < RUN) {
            if (at == size)
                break;
            at++; /* the zero that the block stands for */
        }
    }
    uart_write(&zero, 1);
}

/* Wait for the next message. Returns its size; 0 if what came was none. */
static size_t line_receive(uint8_t message[LONGEST + CRC]) {
    size_t size = 0, left = 0;
    bool good = true, zero = false;
    uint8_t byte;
    while ((byte = uart_read()) != 0) {
        if (left > 0) {
            left--;
        } else { /* a code: how many bytes follow before a zero */
            left = byte - 1u;
            if (!zero) {
                zero = byte != RUN + 1;
                continue;
            }
            zero = byte != RUN + 1;
            byte = 0;
        }
        if (size < LONGEST + CRC)
            message[size++] = byte;
        else
            good = false;
    }
    return good && left == 0 ? size : 0;
}

/* ---- the greeting ------------------------------------------------------------------------- */

/* Append a key of a flat JSON object and its value, as they stand there. */
static bool copy(const char *json, const char *key, char *to) {
    const char *at = strstr(json, key);
    if (at == NULL)
        return false;
    const char *value = at + strlen(key) + strspn(at + strlen(key), " :");
    const char *end = *value == '"' ? strchr(value + 1, '"') : value + strcspn(value, ",}") - 1;
    if (end == NULL || strlen(to) + (size_t)(end + 1 - at) + 80 > LONGEST)
        return false;
    strcat(to, ", ");
    strncat(to, at, (size_t)(end + 1 - at));
    return true;
}

static void answer_hello(const char *hello) {
    static const char *const keys[] = {"\"version\"", "\"table\"", "\"T_s\"", "\"laws\"",
                                       "\"digest\""};
    char answer[LONGEST + CRC] = GREETING "{\"kind\": \"hello\", \"role\": \"controller\", "
                                          "\"boot\": \"a board\", \"name\": \"board\"";
    for (size_t k = 0; k < sizeof keys / sizeof *keys; k++)
        if (!copy(hello, keys[k], answer))
            return;
    strcat(answer, "}");
    const size_t size = strlen(answer);
    const uint32_t crc = crc32(answer, size);
    memcpy(answer + size, &crc, CRC);
    line_send(answer, size + CRC);
}

/* ---- the law ------------------------------------------------------------------------------ */

static const gfm_vsg_2_real ref[GFM_VSG_2_NREF] = {1, 0.5f, 1, 0, 1}; /* P_ref = 0.5 p.u. */

static gfm_vsg_2_t law;
static gfm_vsg_2_real u[NU];
static u_frame_t out;

static void begin(void) {
    static const gfm_vsg_2_real rest[NU] = {0.5f, 1, 1};
    const header_t head = {.magic = MAGIC, .version = VERSION, .data_id = U_ID};
    out.head = head;
    memcpy(u, rest, sizeof u);
    gfm_vsg_2_init(&law);
}

/* One tick: y in, u out. The first one settles the law, so that u begins where it is. */
static void tick(const y_frame_t *in, bool first) {
    static const gfm_vsg_2_real trend[NU] = {0};
    gfm_vsg_2_real y[NY];
    for (int j = 0; j < NY; j++)
        y[j] = (gfm_vsg_2_real)in->y[j];
    if (first)
        gfm_vsg_2_settle(&law, ref, y, u, trend);
    const int reason = gfm_vsg_2_step(&law, ref, y, u);
    out.head.state = reason == GFM_VSG_2_OK ? RUNNING : SAFE;
    out.head.reason = (uint8_t)reason;
    for (int i = 0; i < NU; i++)
        out.u[i] = u[i];
}

static void send_u(void) {
    out.crc = crc32(&out, offsetof(u_frame_t, crc));
    line_send(&out, sizeof out);
    out.head.sequence++;
}

int main(void) {
    static union {
        uint8_t bytes[LONGEST + CRC + 1];
        char text[LONGEST + CRC + 1];
        y_frame_t y;
    } message;
    uint32_t next = 0;
    int64_t last = -1;

    uart_open();
    begin();
    for (;;) {
        const size_t size = line_receive(message.bytes);
        message.bytes[size] = 0;
        if (size > CRC && strncmp(message.text, GREETING, strlen(GREETING)) == 0) {
            uint32_t crc;
            memcpy(&crc, message.bytes + size - CRC, CRC);
            message.bytes[size - CRC] = 0;
            if (crc == crc32(message.bytes, size - CRC) && strstr(message.text, "\"hello\"") != NULL)
                answer_hello(message.text);
            continue;
        }
        const y_frame_t *y = &message.y;
        if (size != sizeof *y || y->crc != crc32(y, offsetof(y_frame_t, crc)) ||
            y->head.magic != MAGIC || y->head.version != VERSION || y->head.data_id != Y_ID ||
            y->head.sequence - next >= 0x80000000)
            continue; /* the plant asks again */
        next = y->head.sequence + 1;
        if (y->head.state == SAFE || y->head.state == STOPPED) {
            out.head.state = STOPPED;
            for (int k = 0; k < 3; k++)
                send_u();
            begin(); /* ready for the next run */
            next = 0;
            last = -1;
            continue;
        }
        if ((int64_t)y->head.tick > last) { /* else the answer was lost */
            tick(y, last < 0);
            last = (int64_t)y->head.tick;
            out.head.tick = y->head.tick;
        }
        send_u();
    }
}
