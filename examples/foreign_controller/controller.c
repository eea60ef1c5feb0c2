/* A grid-forming controller as a manufacturer might write it: droop, cascaded voltage and current
 * control, all in volts and amperes on the measured phases. It uses nothing of gfmhil but the
 * interface, needs no PLL, and begins at the voltage that the plant rests under.
 */
#include <math.h>
#include <stdlib.h>

#include "gfmhil_controller.h"

static const double two_pi = 6.283185307179586;

/* Per unit of the converter's rating; times in seconds. */
static const double droop_p = 0.01;   /* of frequency per power */
static const double droop_q = 0.05;   /* of voltage per reactive power */
static const double power_hz = 5.0;   /* low-pass on P and Q */
static const double virtual_r = 0.1, virtual_x = 0.3;
static const double voltage_p = 1.0, voltage_i = 100.0, load_share = 0.6;
static const double current_p = 0.15, filter_x = 0.0174, filter_b = 0.2268;
static const double voltage_hz = 400.0; /* low-pass on v, fed forward */
static const double current_max = 1.2;
static const double dc_p = 50.0, dc_i = 200.0;

typedef struct {
    double d, q;
} vector;

typedef struct {
    gfmhil_setup rated;
    double v_peak, i_peak; /* V, A: 1 p.u. of a phase */
    double theta;          /* rad */
    double p, q;           /* W, var, filtered */
    double rise;           /* V: what the voltage's droop does not explain at the start */
    vector integral;       /* A, of the voltage control */
    vector v_smooth;       /* V */
    double dc_integral;    /* A */
} controller;

static vector to_frame(const double phase[3], double theta)
{
    const double alpha = (2.0 * phase[0] - phase[1] - phase[2]) / 3.0;
    const double beta = (phase[1] - phase[2]) / sqrt(3.0);
    const vector x = {cos(theta) * alpha + sin(theta) * beta,
                      cos(theta) * beta - sin(theta) * alpha};
    return x;
}

static void to_phases(vector x, double theta, double phase[3])
{
    for (int k = 0; k < 3; k++) {
        const double at = theta - two_pi * k / 3.0;
        phase[k] = x.d * cos(at) - x.q * sin(at);
    }
}

static double smoothing(double hz, double period) { return 1.0 - exp(-two_pi * hz * period); }

static double active(vector v, vector i) { return 1.5 * (v.d * i.d + v.q * i.q); }

static double reactive(vector v, vector i) { return 1.5 * (v.q * i.d - v.d * i.q); }

static double voltage_wanted(const controller *c, const gfmhil_input *in)
{
    const double lack = droop_q * (in->Q_ref - c->q) / c->rated.S_n;
    return in->V_ref * sqrt(2.0 / 3.0) + lack * c->v_peak + c->rise;
}

int gfmhil_version(void) { return GFMHIL_CONTROLLER_VERSION; }

const char *gfmhil_name(void) { return "droop of another house"; }

void *gfmhil_new(const gfmhil_setup *setup)
{
    controller *c = calloc(1, sizeof *c);
    if (c) {
        c->rated = *setup;
        c->v_peak = setup->V_n * sqrt(2.0 / 3.0);
        c->i_peak = setup->S_n / (1.5 * c->v_peak);
    }
    return c;
}

int gfmhil_start(void *self, const gfmhil_input *in, const gfmhil_output *now)
{
    controller *c = self;
    const double ohm = c->v_peak / c->i_peak;
    /* the angle of the voltage behind the virtual impedance, so that the voltage control rests */
    const vector v = to_frame(in->v, 0.0), load = to_frame(in->i_o, 0.0);
    const vector inside = {v.d + ohm * (virtual_r * load.d - virtual_x * load.q),
                           v.q + ohm * (virtual_r * load.q + virtual_x * load.d)};
    c->theta = atan2(inside.q, inside.d);
    c->p = active(v, load);
    c->q = reactive(v, load);
    c->rise = 0.0;
    c->rise = hypot(inside.d, inside.q) - voltage_wanted(c, in);

    const vector v_own = to_frame(in->v, c->theta), i = to_frame(in->i, c->theta);
    const vector i_o = to_frame(in->i_o, c->theta);
    const vector e = to_frame(now->e, c->theta + c->rated.omega_n * c->rated.delay);
    /* what the proportional current control needs for e, and the voltage control's part of it */
    const double gain = current_p * ohm, x = filter_x * ohm, b = filter_b / ohm;
    const vector wanted = {i.d + (e.d - v_own.d + x * i.q) / gain,
                           i.q + (e.q - v_own.q - x * i.d) / gain};
    c->integral.d = wanted.d - load_share * i_o.d + b * v_own.q;
    c->integral.q = wanted.q - load_share * i_o.q - b * v_own.d;
    c->v_smooth = v_own;
    c->dc_integral = now->i_dc;
    return 0;
}

int gfmhil_step(void *self, const gfmhil_input *in, gfmhil_output *out)
{
    controller *c = self;
    const double T = c->rated.period, ohm = c->v_peak / c->i_peak;
    const vector v = to_frame(in->v, c->theta), i = to_frame(in->i, c->theta);
    const vector i_o = to_frame(in->i_o, c->theta);

    const double slow = smoothing(power_hz, T), quick = smoothing(voltage_hz, T);
    c->p += slow * (active(v, i_o) - c->p);
    c->q += slow * (reactive(v, i_o) - c->q);
    const double lead = droop_p * (in->P_ref - c->p) / c->rated.S_n;
    const double omega = in->omega_ref + lead * c->rated.omega_n;

    const vector lack = {
        voltage_wanted(c, in) - ohm * (virtual_r * i_o.d - virtual_x * i_o.q) - v.d,
        -ohm * (virtual_r * i_o.q + virtual_x * i_o.d) - v.q};
    const double b = filter_b / ohm, x = filter_x * ohm;
    vector wanted = {voltage_p / ohm * lack.d + c->integral.d + load_share * i_o.d - b * v.q,
                     voltage_p / ohm * lack.q + c->integral.q + load_share * i_o.q + b * v.d};
    const double size = hypot(wanted.d, wanted.q), most = current_max * c->i_peak;
    if (size > most) { /* the integral waits while the current is limited */
        wanted.d *= most / size;
        wanted.q *= most / size;
    } else {
        c->integral.d += T * voltage_i / ohm * lack.d;
        c->integral.q += T * voltage_i / ohm * lack.q;
    }

    c->v_smooth.d += quick * (v.d - c->v_smooth.d);
    c->v_smooth.q += quick * (v.q - c->v_smooth.q);
    const vector e = {c->v_smooth.d + current_p * ohm * (wanted.d - i.d) - x * i.q,
                      c->v_smooth.q + current_p * ohm * (wanted.q - i.q) + x * i.d};
    to_phases(e, c->theta + omega * c->rated.delay, out->e);
    c->theta = fmod(c->theta + omega * T, two_pi);

    const double dc = (in->V_dc_ref - in->v_dc) * c->rated.S_n
                      / (c->rated.V_dcref * c->rated.V_dcref);
    c->dc_integral += T * dc_i * dc;
    out->i_dc = c->dc_integral + dc_p * dc;
    return 0;
}

void gfmhil_free(void *self) { free(self); }
