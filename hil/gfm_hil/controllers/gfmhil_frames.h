/* What a controller in C that is a program of its own says to gfmhil's plant: frames, greetings, and
 * messages on a serial line. docs/own-controller.md and docs/links.md describe all of it.
 *
 * C99 for gcc and clang on little-endian processors, with or without an operating system; it needs
 * string.h and allocates nothing. Any input is either taken or refused: the tests give it what a
 * fuzzer makes up, under the sanitizers of addresses and undefined behaviour.
 */
#ifndef GFMHIL_FRAMES_H
#define GFMHIL_FRAMES_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#if !defined(__BYTE_ORDER__) || __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "frames are little-endian"
#endif

/* Values of a frame; a run with an inner stage has 11 and 4. In a network with a plant controller y is
   3 longer: set-points of P_ref, Q_ref and V_ref, each NaN where none is sent. */
#ifndef GFMHIL_NY
#define GFMHIL_NY 5 /* v_dc, p, omega_u, q, V */
#define GFMHIL_NU 3 /* i_u, omega_u, E_u */
#endif

enum { GFMHIL_MAGIC = 0x4647, GFMHIL_TABLE_VERSION = 4, GFMHIL_Y_ID = 1, GFMHIL_U_ID = 2 };
#define GFMHIL_TABLE "\"96954d46\"" /* hash of the signal table, as a greeting has it */
enum { GFMHIL_INIT, GFMHIL_READY, GFMHIL_RUNNING, GFMHIL_SAFE, GFMHIL_STOPPED }; /* state */
enum { GFMHIL_OK, GFMHIL_BAD_Y, GFMHIL_BAD_U, GFMHIL_STALE, GFMHIL_LOST_PEER, GFMHIL_PLANT_TRIP,
       GFMHIL_OPERATOR, GFMHIL_BAD_SENSOR }; /* reason */
enum { GFMHIL_LONGEST = 504 }; /* bytes of a message */

typedef struct __attribute__((packed)) {
    uint16_t magic;
    uint8_t version, data_id, state, reason;
    uint16_t spare;
    uint32_t sequence;
    uint64_t tick;
} gfmhil_header;

typedef struct __attribute__((packed)) {
    gfmhil_header head;
    double y[GFMHIL_NY]; /* copy it before you pass it on: it may not be aligned */
    uint32_t crc;
} gfmhil_y_frame;

typedef struct __attribute__((packed)) {
    gfmhil_header head;
    double u[GFMHIL_NU];
    uint32_t crc;
} gfmhil_u_frame;

typedef char gfmhil_frames_have_their_size
    [sizeof(gfmhil_header) == 20 && sizeof(gfmhil_y_frame) == 24 + 8 * GFMHIL_NY ? 1 : -1];

/* CRC-32 of zlib and Ethernet: reflected polynomial, all ones before and after. */
static inline uint32_t gfmhil_crc32(const void *data, size_t size)
{
    const uint8_t *byte = (const uint8_t *)data;
    uint32_t crc = 0xFFFFFFFFu;
    while (size-- > 0) {
        crc ^= *byte++;
        for (int bit = 0; bit < 8; bit++)
            crc = crc >> 1 ^ (crc & 1u ? 0xEDB88320u : 0u);
    }
    return ~crc;
}

/* Whether a message is a frame of y that may be used; `next` is the sequence number expected. */
static inline bool gfmhil_is_y(const void *message, size_t size, uint32_t next)
{
    gfmhil_y_frame y;
    if (size != sizeof y)
        return false;
    memcpy(&y, message, sizeof y);
    return y.crc == gfmhil_crc32(message, offsetof(gfmhil_y_frame, crc))
           && y.head.magic == GFMHIL_MAGIC && y.head.version == GFMHIL_TABLE_VERSION
           && y.head.data_id == GFMHIL_Y_ID && y.head.sequence - next < 0x80000000u;
}

/* A frame of u before the first: all but the values. */
static inline gfmhil_u_frame gfmhil_first_u(void)
{
    gfmhil_u_frame u;
    memset(&u, 0, sizeof u);
    u.head.magic = GFMHIL_MAGIC;
    u.head.version = GFMHIL_TABLE_VERSION;
    u.head.data_id = GFMHIL_U_ID;
    return u;
}

/* Ends a frame that is ready to be sent. Count its sequence number on after you have sent it. */
static inline void gfmhil_seal(gfmhil_u_frame *u)
{
    u->crc = gfmhil_crc32(u, offsetof(gfmhil_u_frame, crc));
}

/* ---- greetings ---------------------------------------------------------------------------- */

#define GFMHIL_GREETING "GFMHIL "

/* Whether a message, a zero behind it, is a greeting of that kind: "hello" or "start". */
static inline bool gfmhil_is_greeting(const char *text, const char *kind)
{
    const size_t prefix = strlen(GFMHIL_GREETING), size = strlen(kind);
    if (strncmp(text, GFMHIL_GREETING, prefix) != 0)
        return false;
    for (const char *at = strstr(text + prefix, kind); at != NULL; at = strstr(at + 1, kind))
        if (at[-1] == '"' && at[size] == '"')
            return true;
    return false;
}

/* The value of a key of a flat JSON object as it stands there, with quotes if it is a string. */
static inline bool gfmhil_field(const char *json, const char *key, char *value, size_t room)
{
    const size_t size = strlen(key);
    for (const char *at = strstr(json, key); at != NULL; at = strstr(at + 1, key)) {
        if (at == json || at[-1] != '"' || at[size] != '"')
            continue;
        const char *first = at + size + 1;
        first += strspn(first, " :");
        const char *behind = first + strcspn(first, " ,}");
        if (*first == '"') {
            behind = strchr(first + 1, '"');
            if (behind == NULL)
                return false;
            behind++;
        }
        const size_t found = (size_t)(behind - first);
        if (found == 0 || found >= room)
            return false;
        memcpy(value, first, found);
        value[found] = '\0';
        return true;
    }
    return false;
}

/* Answer a HELLO: our own, which repeats what the plant compares. `boot` is the machine's boot id or any
 * text, `name` what the run calls this controller; both printable ASCII without quotes. Returns the
 * answer's size, or 0 if the HELLO lacks a field or the answer is too long. */
static inline size_t gfmhil_answer(
    const char *hello, const char *boot, const char *name, char answer[GFMHIL_LONGEST])
{
    static const char *const repeated[] = {"version", "table", "T_s", "laws", "digest"};
    const char *const parts[] = {GFMHIL_GREETING "{\"kind\": \"hello\", \"role\": \"controller\", "
                                 "\"boot\": \"", boot, "\", \"name\": \"", name, "\""};
    size_t at = 0;
    for (size_t k = 0; k < sizeof parts / sizeof *parts; k++) {
        const size_t size = strlen(parts[k]);
        if (size >= GFMHIL_LONGEST - at)
            return 0;
        memcpy(answer + at, parts[k], size);
        at += size;
    }
    for (size_t k = 0; k < sizeof repeated / sizeof *repeated; k++) {
        const size_t size = strlen(repeated[k]);
        if (size + 8 >= GFMHIL_LONGEST - at)
            return 0;
        memcpy(answer + at, ", \"", 3);
        memcpy(answer + at + 3, repeated[k], size);
        memcpy(answer + at + 3 + size, "\": ", 3);
        at += size + 6;
        if (!gfmhil_field(hello, repeated[k], answer + at, GFMHIL_LONGEST - at - 1))
            return 0;
        at += strlen(answer + at);
    }
    answer[at] = '}';
    return at + 1;
}

/* ---- a serial line: COBS, and a zero after each message ------------------------------------ */

enum {
    GFMHIL_CRC = 4, /* bytes, behind a greeting on a line */
    GFMHIL_RUN = 254, /* bytes without a zero that one code byte covers */
    GFMHIL_STUFFED = GFMHIL_LONGEST + GFMHIL_CRC + 4 /* bytes of the longest message on the line */
};

/* A message as it goes to the line; returns its size there. At most GFMHIL_LONGEST bytes, to a
 * greeting a CRC is added. */
static inline size_t gfmhil_stuff(const void *message, size_t size, uint8_t line[GFMHIL_STUFFED])
{
    uint8_t whole[GFMHIL_LONGEST + GFMHIL_CRC];
    size_t at = 0, code = 0, to = 1;
    if (size > GFMHIL_LONGEST)
        return 0;
    memcpy(whole, message, size);
    if (size >= strlen(GFMHIL_GREETING)
        && memcmp(whole, GFMHIL_GREETING, strlen(GFMHIL_GREETING)) == 0) {
        const uint32_t crc = gfmhil_crc32(whole, size);
        memcpy(whole + size, &crc, GFMHIL_CRC);
        size += GFMHIL_CRC;
    }
    for (;;) {
        const bool run = to - code == GFMHIL_RUN + 1, zero = at < size && whole[at] == 0;
        if (run || zero || at == size) {
            line[code] = (uint8_t)(to - code);
            if (at == size && !run)
                break;
            code = to++;
            if (zero && !run)
                at++; /* the zero that the code stands for */
        } else {
            line[to++] = whole[at++];
        }
    }
    line[to] = 0;
    return to + 1;
}

/* What came of the message that is on its way. All zero before the first byte. */
typedef struct {
    uint8_t bytes[GFMHIL_LONGEST + GFMHIL_CRC + 1];
    uint16_t size, left;
    bool zero, damaged;
} gfmhil_line;

/* Take the next byte of the line. Returns the size of a message that is whole now, which is in
 * `bytes` with a zero behind it until the next call, or 0. */
static inline size_t gfmhil_take(gfmhil_line *line, uint8_t byte)
{
    if (byte == 0) {
        const size_t prefix = strlen(GFMHIL_GREETING);
        size_t size = line->damaged || line->left > 0 ? 0 : line->size;
        line->size = line->left = 0;
        line->zero = line->damaged = false;
        if (size >= prefix && memcmp(line->bytes, GFMHIL_GREETING, prefix) == 0) {
            uint32_t crc;
            if (size < prefix + GFMHIL_CRC)
                return 0;
            size -= GFMHIL_CRC;
            memcpy(&crc, line->bytes + size, GFMHIL_CRC);
            if (crc != gfmhil_crc32(line->bytes, size))
                return 0;
        }
        line->bytes[size] = 0;
        return size;
    }
    if (line->left > 0) {
        line->left--;
    } else { /* a code: how many bytes follow before a zero */
        const bool zero = line->zero;
        line->left = (uint16_t)(byte - 1u);
        line->zero = byte != GFMHIL_RUN + 1;
        if (!zero)
            return 0;
        byte = 0;
    }
    if (line->size < GFMHIL_LONGEST + GFMHIL_CRC)
        line->bytes[line->size++] = byte;
    else
        line->damaged = true;
    return 0;
}

#endif
