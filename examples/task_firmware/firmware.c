/* Stands in for a firmware of yours: a virtual machine with stator impedance, governor and a limit of the
 * current, without a PLL. Its variables are static, as on a processor of its own.
 */
#include "firmware.h"

#include <math.h>

static const double two_pi = 6.283185307179586, period = 200e-6;
static const double s_rated = 1.0e6, v_rated = 480.0, f_rated = 60.0;
static const double stator_x = 0.3, stator_r = 0.1, droop_q = 0.05, current_max = 1.6; /* p.u. */
static const double current_ohm = 0.08;  /* proportional control of the current */
static const double filter_ohm = 0.0113; /* reactance of the filter's inductor */

typedef struct {
    double a, b;
} vector;

static double inertia, damping, droop;  /* s, p.u. per Hz */
static double theta, df, df_slow, e_mag; /* rad, Hz, Hz, V peak */
static vector i_m;                      /* A, of the virtual machine */
static vector v_slow;                   /* V, in the machine's frame, without what is fast */
static double healthy;                  /* s, for how long the voltage has been there */

void app_task_init(double H, double D, double kDroop)
{
    inertia = H;
    damping = D;
    droop = kDroop;
    df = df_slow = healthy = 0.0;
    i_m.a = i_m.b = 0.0;
    e_mag = v_rated * sqrt(2.0 / 3.0);
}

/* A vector turned by an angle. */
static vector turned(vector x, double angle)
{
    const vector y = {x.a * cos(angle) - x.b * sin(angle), x.a * sin(angle) + x.b * cos(angle)};
    return y;
}

static vector space(const double phase[3])
{
    const vector x = {(2.0 * phase[0] - phase[1] - phase[2]) / 3.0,
                      (phase[1] - phase[2]) / sqrt(3.0)};
    return x;
}

void app_task_5kHz(double v_bridge[3], bool *pwm_enable, const double v_ac[3], const double i_L[3],
                   double v_dc, double P_request, double Q_request, bool enable, double P_lim_high,
                   double P_lim_low)
{
    const double peak = v_rated * sqrt(2.0 / 3.0), ohm = v_rated * v_rated / s_rated;
    const vector v = space(v_ac), i = space(i_L);
    const double size = hypot(v.a, v.b);
    healthy = size > 0.8 * peak ? healthy + period : (healthy > 1.0 ? healthy : 0.0);
    *pwm_enable = enable && healthy > 1.0;

    if (!enable) { /* follow the grid */
        theta = atan2(v.b, v.a);
        i_m.a = i_m.b = 0.0;
        df = df_slow = 0.0;
    }
    const double q_m = 1.5 * (v.b * i_m.a - v.a * i_m.b), p_m = 1.5 * (v.a * i_m.a + v.b * i_m.b);
    const double wanted = P_request < P_lim_low ? P_lim_low
                          : P_request > P_lim_high ? P_lim_high : P_request;
    const double mechanical = wanted / s_rated - droop * df;
    df_slow += 3.33 * period * (df - df_slow);
    df += period * f_rated / (2.0 * inertia)
          * (mechanical - p_m / s_rated - damping * (df - df_slow));
    theta = fmod(theta + two_pi * (f_rated + df) * period, two_pi);
    e_mag += 10.0 * period * (peak * (1.0 + droop_q * (Q_request - q_m) / s_rated) - e_mag);

    const double rate = period * two_pi * f_rated / (stator_x * ohm);
    const vector e = {e_mag * cos(theta), e_mag * sin(theta)};
    if (enable) {
        i_m.a += rate * (e.a - v.a - stator_r * ohm * i_m.a);
        i_m.b += rate * (e.b - v.b - stator_r * ohm * i_m.b);
    }
    const double most = current_max * s_rated / (1.5 * peak), now = hypot(i_m.a, i_m.b);
    const double less = now > most ? most / now : 1.0;
    const vector i_ref = {less * i_m.a, less * i_m.b};

    /* the voltage is fed forward, and all is turned ahead to the middle of when the bridge has it */
    const vector own = turned(v, -theta);
    v_slow.a += 2000.0 * period * (own.a - v_slow.a);
    v_slow.b += 2000.0 * period * (own.b - v_slow.b);
    const vector still = turned(v_slow, theta);
    vector bridge = {still.a - filter_ohm * i_ref.b + current_ohm * (i_ref.a - i.a),
                     still.b + filter_ohm * i_ref.a + current_ohm * (i_ref.b - i.b)};
    bridge = turned(bridge, 1.5 * two_pi * f_rated * period);
    double a = bridge.a, b = bridge.b;
    const double top = 0.5 * v_dc, high = hypot(a, b);
    if (high > top) {
        a *= top / high;
        b *= top / high;
    }
    v_bridge[0] = a;
    v_bridge[1] = -0.5 * a + 0.5 * sqrt(3.0) * b;
    v_bridge[2] = -0.5 * a - 0.5 * sqrt(3.0) * b;
}
