/* A controller library from counts to compare counts around the C of mimo-gfm; its fault is the law's
 * reason. */
#include "gfm_mimo_gfm.h"
#include "gfmhil_controller.h"

#include <math.h>

enum { NREF = GFM_MIMO_GFM_NREF, NU = GFM_MIMO_GFM_NU, NCMP = GFM_MIMO_GFM_NCMP };

static gfm_mimo_gfm_t law;
static gfmhil_setup rated;
static int begins;
static double now[NU];

int gfmhil_version(void) { return GFMHIL_CONTROLLER_VERSION; }
const char *gfmhil_name(void) { return "mimo-gfm from counts"; }

void *gfmhil_new(const gfmhil_setup *setup)
{
    rated = *setup;
    return &law;
}

int gfmhil_start(void *self, const gfmhil_input *in, const gfmhil_output *out)
{
    (void)self, (void)in;
    gfm_mimo_gfm_init(&law);
    now[0] = out->i_dc * rated.V_dcref / rated.S_n;
    now[1] = begins = 1;
    now[2] = sqrt(out->e[0] * out->e[0] + out->e[1] * out->e[1] + out->e[2] * out->e[2]) / rated.V_n;
    return 0;
}

int gfmhil_isr(void *self, const gfmhil_input *in, const unsigned short adc[10], gfmhil_output *out,
               unsigned short cmp[3])
{
    static const double trend[3] = {0};
    const double ref[NREF] = {in->V_dc_ref / rated.V_dcref, in->P_ref / rated.S_n,
                              in->omega_ref / rated.omega_n, in->Q_ref / rated.S_n,
                              in->V_ref / rated.V_n};
    double u[NU];
    unsigned short gates[NCMP + 1];
    int k, why;
    (void)self;
    if (begins) {
        const double e[2] = {now[2], 0.0};
        gfm_mimo_gfm_t first;
        begins = 0;
        gfm_mimo_gfm_align(&law, adc);
        first = law;
        gfm_mimo_gfm_sense(&first, adc);
        gfm_mimo_gfm_settle(&law, ref, first.counts.sensed, now, trend, e);
    }
    why = gfm_mimo_gfm_isr(&law, ref, adc, u, gates);
    if (why != 0)
        return why;
    out->i_dc = u[0] * rated.S_n / rated.V_dcref;
    for (k = 0; k < NCMP; k++)
        cmp[k] = gates[k];
    return 0;
}

const char *gfmhil_fault(void *self, int number)
{
    (void)self;
    return number == GFM_MIMO_GFM_BAD_SENSOR ? "a sensor is not plausible" : "refused";
}

void gfmhil_free(void *self) { (void)self; }
