/* A board as the controller of gfmhil's plant, over a UART: an exported law, gfmhil's header for the
   frames and the line, and nothing of an operating system. docs/own-controller.md describes the protocol, and
   docs/links.md the serial line. */

#include "board.h"
#include "gfm_vsg_2.h"
#include "gfmhil_frames.h"

enum { NY = GFM_VSG_2_NY, NU = GFM_VSG_2_NU };

static void send(const void *message, size_t size) {
    static uint8_t bytes[GFMHIL_STUFFED];
    uart_write(bytes, gfmhil_stuff(message, size, bytes));
}

/* ---- the law ------------------------------------------------------------------------------ */

static const gfm_vsg_2_real ref[GFM_VSG_2_NREF] = {1, 0.5f, 1, 0, 1}; /* P_ref = 0.5 p.u. */

static gfm_vsg_2_t law;
static gfm_vsg_2_real u[NU];
static gfmhil_u_frame out;

static void begin(void) {
    static const gfm_vsg_2_real rest[NU] = {0.5f, 1, 1};
    out = gfmhil_first_u();
    memcpy(u, rest, sizeof u);
    gfm_vsg_2_init(&law);
}

/* One tick: y in, u out. The first one settles the law, so that u begins where it is. */
static void tick(const gfmhil_y_frame *in, bool first) {
    static const gfm_vsg_2_real trend[NU] = {0};
    gfm_vsg_2_real y[NY];
    for (int j = 0; j < NY; j++)
        y[j] = (gfm_vsg_2_real)in->y[j];
    if (first)
        gfm_vsg_2_settle(&law, ref, y, u, trend);
    const int reason = gfm_vsg_2_step(&law, ref, y, u);
    out.head.state = reason == GFM_VSG_2_OK ? GFMHIL_RUNNING : GFMHIL_SAFE;
    out.head.reason = (uint8_t)reason;
    for (int i = 0; i < NU; i++)
        out.u[i] = u[i];
}

static void send_u(void) {
    gfmhil_seal(&out);
    send(&out, sizeof out);
    out.head.sequence++;
}

int main(void) {
    static gfmhil_line line;
    static char answer[GFMHIL_LONGEST];
    uint32_t next = 0;
    int64_t last = -1;

    uart_open();
    begin();
    for (;;) {
        const size_t size = gfmhil_take(&line, uart_read());
        const char *text = (const char *)line.bytes;
        if (size > 0 && gfmhil_is_greeting(text, "hello")) {
            const size_t length = gfmhil_answer(text, "a board", "board", answer);
            if (length > 0)
                send(answer, length);
            continue;
        }
        if (!gfmhil_is_y(line.bytes, size, next))
            continue; /* not whole yet, or the plant asks again */
        gfmhil_y_frame y;
        memcpy(&y, line.bytes, sizeof y);
        next = y.head.sequence + 1;
        if (y.head.state == GFMHIL_SAFE || y.head.state == GFMHIL_STOPPED) {
            out.head.state = GFMHIL_STOPPED;
            for (int k = 0; k < 3; k++)
                send_u();
            begin(); /* ready for the next run */
            next = 0;
            last = -1;
            continue;
        }
        if ((int64_t)y.head.tick > last) { /* else the answer was lost */
            tick(&y, last < 0);
            last = (int64_t)y.head.tick;
            out.head.tick = y.head.tick;
        }
        send_u();
    }
}
