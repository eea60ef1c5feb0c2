/* The functions of a firmware whose tasks a timer calls, as OpenIBR's battery application has them. */
#ifndef FIRMWARE_H
#define FIRMWARE_H

#include <stdbool.h>

/* Once: inertia constant, s; damping and droop of frequency, p.u. of power per Hz. */
void app_task_init(double H, double D, double kDroop);

/* Every 200 us: bridge voltages and whether to switch, from phase voltages and currents of the filter's
 * inductor (V, A), the DC voltage (V), requests and limits of power (W, var). */
void app_task_5kHz(double v_bridge[3], bool *pwm_enable, const double v_ac[3], const double i_L[3],
                   double v_dc, double P_request, double Q_request, bool enable, double P_lim_high,
                   double P_lim_low);

#endif
