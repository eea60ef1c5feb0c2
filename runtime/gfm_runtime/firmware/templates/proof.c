/* Frama-C proves by this program that @P@ never overflows, and reads and writes only its own: for all
 * inputs, in every order of calls, for ever. @MADE@ */
#include "@P@.h"

#include "__fc_builtin.h"

static int32_t any(void)
{
    return Frama_C_interval(INT32_MIN, INT32_MAX);
}

int main(void)
{
    static @P@_t law;
    int32_t ref[@GUARD@_NREF], y[@GUARD@_NY], u[@GUARD@_NU], trend[@GUARD@_NU], bump;
    int i;
    @P@_init(&law);
    /* where EVA stops widening: the bounds of the state */
    /*@ loop widen_hints "all", @HINTS@; */
    for (;;) {
        for (i = 0; i < @GUARD@_NU; i++) {
            u[i] = any();
            trend[i] = any();
        }
        for (i = 0; i < @GUARD@_NREF; i++) {
            ref[i] = any();
        }
        for (i = 0; i < @GUARD@_NY; i++) {
            y[i] = any();
        }
        switch (Frama_C_interval(0, 8)) {
        case 0:
            @P@_init(&law);
            break;
        case 1:
            @P@_reset(&law);
            break;
        case 2:
            (void)@P@_look(&law, ref, y, u);
            break;
        case 3:
            (void)@P@_settle(&law, ref, y, u, trend);
            break;
        case 4:
            (void)@P@_switch(&law, ref, y, u, trend, &bump);
            break;
        default:
            (void)@P@_step(&law, ref, y, u);
            break;
        }
    }
}
