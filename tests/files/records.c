#include "gfm_vsg_2.h"
static gfm_t law;
static gfm_law_t gains;
static gfm_real y[GFM_NY], u[GFM_NU], ref[GFM_NREF], other[GFM_NU];
int main(void)
{
    static struct { int n; gfm_t laws[2]; } pair;
    gains = gfm_vsg_2_law;
    gfm_init(&law);
    gfm_init(&pair.laws[pair.n]);
    return gfm_step(&gains, &law, ref, y, u) + gfm_step(&gains, &pair.laws[1], ref, y, other)
        + gfm_vsg_2_id[law.reason];
}
