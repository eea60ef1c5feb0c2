#include "gfm_vsg_2_cascaded.h"
static gfm_vsg_2_cascaded_t law;
static gfm_vsg_2_cascaded_real y[GFM_VSG_2_CASCADED_NY], u[GFM_VSG_2_CASCADED_NU], ref[5];
int main(void)
{
    gfm_vsg_2_cascaded_init(&law);
    return gfm_vsg_2_cascaded_step(&law, ref, y, u);
}
