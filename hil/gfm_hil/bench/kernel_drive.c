/* As `drive` of gfm_hil/bench/kernel.py, with the generic step of gfmhil firmware export.
 *
 * It includes the step's source to call its parts: the kernel's step refuses no inputs, so this one
 * does not either.
 */
#include "gfm.c"

#include <stdint.h>

/* `rows` inputs in turn, each changed by the last u; io holds ref, y and u. */
void drive(const gfm_law_t *law, gfm_t *s, gfm_real *io, const gfm_real *inputs,
           gfm_real *outputs, int64_t rows, int64_t steps, gfm_real feedback)
{
    gfm_real *ref = io, *y = io + GFM_NREF, *u = io + GFM_NREF + GFM_NY;
    tick_t t;
    for (int64_t k = 0, m = 0; k < steps; k++, m = m + 1 == rows ? 0 : m + 1) {
        for (int j = 0; j < GFM_NY; j++)
            y[j] = inputs[m * GFM_NY + j] + feedback * u[j % GFM_NU];
        set_inputs(law, &t, ref, y);
        output(law, s, &t);
        advance(law, s, &t);
        for (int i = 0; i < GFM_NU; i++)
            outputs[m * GFM_NU + i] = u[i] = t.u[i];
    }
}
