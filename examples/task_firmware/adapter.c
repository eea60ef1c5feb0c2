/* Connects a firmware with the functions of firmware.h to gfmhil's bench, through gfmhil_controller.h.
 *
 * Such a firmware is one instance, wants to see the grid for some seconds before it switches, and
 * knows nothing of the bench's start in the middle of operation. So the adapter shows it the voltages
 * and currents of the start, as they were for some seconds before. The DC link is not the firmware's:
 * the adapter commands the source.
 */
#include <math.h>
#include <stddef.h>

#include "firmware.h"
#include "gfmhil_controller.h"

/* What the firmware is made for; the bench must be the same. */
#ifndef S_RATED
#define S_RATED 1.0e6 /* VA */
#define V_RATED 480.0 /* V, line to line */
#define F_RATED 60.0  /* Hz */
#endif
#ifndef INERTIA
#define INERTIA 2.5 /* s */
#define DAMPING 2.0 /* p.u. per Hz */
#define DROOP 1.0   /* p.u. per Hz */
#endif
#define PERIOD 200e-6

enum { WATCHES = 20000, RUNS = 40000 }; /* periods before the start: disabled, then enabled */
enum { NOT_SWITCHING = 1 };

static const double dc_p = 20.0, dc_i = 100.0; /* of the DC source, p.u. and p.u./s */
static bool taken;
static double dc_integral; /* A */
static gfmhil_setup rated;

static int same(double a, double b) { return fabs(a - b) < 1e-3 * fabs(b); }

int gfmhil_version(void) { return GFMHIL_CONTROLLER_VERSION; }

const char *gfmhil_name(void) { return "firmware of 5 kHz tasks"; }

void *gfmhil_new(const gfmhil_setup *setup)
{
    if (taken || !same(setup->period, PERIOD) || !same(setup->S_n, S_RATED)
        || !same(setup->V_n, V_RATED) || !same(setup->omega_n, 6.283185307179586 * F_RATED))
        return NULL;
    taken = true;
    rated = *setup;
    return &rated;
}

/* The phases as they were before, at that angle back; times k. */
static void turned(const double now[3], double back, double k, double before[3])
{
    const double alpha = (2.0 * now[0] - now[1] - now[2]) / 3.0;
    const double beta = (now[1] - now[2]) / 1.7320508075688772;
    const double a = k * (cos(back) * alpha + sin(back) * beta);
    const double b = k * (cos(back) * beta - sin(back) * alpha);
    before[0] = a;
    before[1] = -0.5 * a + 0.8660254037844386 * b;
    before[2] = -0.5 * a - 0.8660254037844386 * b;
}

static bool task(const double v[3], const double i[3], const gfmhil_input *in, bool enable,
                 double e[3])
{
    bool switching = false;
    app_task_5kHz(e, &switching, v, i, in->v_dc, in->P_ref, in->Q_ref, enable, rated.S_n,
                  -rated.S_n);
    return switching;
}

int gfmhil_start(void *self, const gfmhil_input *in, const gfmhil_output *now)
{
    bool switching = false;
    (void)self;
    app_task_init(INERTIA, DAMPING, DROOP);
    for (int k = WATCHES + RUNS; k > 0; k--) {
        const double back = fmod(in->omega_ref * PERIOD * k, 6.283185307179586);
        const bool enable = k <= RUNS;
        double v[3], i[3], e[3];
        turned(in->v, back, 1.0, v);
        turned(in->i, back, enable ? 1.0 : 0.0, i);
        switching = task(v, i, in, enable, e);
    }
    dc_integral = now->i_dc;
    return switching ? 0 : NOT_SWITCHING;
}

int gfmhil_step(void *self, const gfmhil_input *in, gfmhil_output *out)
{
    const double lack = (in->V_dc_ref - in->v_dc) * rated.S_n / (rated.V_dcref * rated.V_dcref);
    (void)self;
    if (!task(in->v, in->i, in, true, out->e))
        return NOT_SWITCHING;
    dc_integral += PERIOD * dc_i * lack;
    out->i_dc = dc_integral + dc_p * lack;
    return 0;
}

const char *gfmhil_fault(void *self, int number)
{
    (void)self;
    return number == NOT_SWITCHING ? "the firmware does not enable its PWM" : NULL;
}

void gfmhil_free(void *self)
{
    (void)self;
    taken = false;
}
