#include "firmware.h"
double seen[80000][11];
int calls, pwm_on = 1;
void app_task_init(double H, double D, double kDroop)
{
    calls = H > 0 && D > 0 && kDroop > 0 ? 0 : -1;
}
void app_task_5kHz(double e[3], bool *pwm, const double v[3], const double i[3], double v_dc,
                   double P, double Q, bool enable, double high, double low)
{
    const double all[11] = {v[0], v[1], v[2], i[0], i[1], i[2], v_dc, P, Q, enable, high - low};
    for (int k = 0; k < 11; k++)
        seen[calls][k] = all[k];
    for (int k = 0; k < 3; k++)
        e[k] = v[k];
    calls++;
    *pwm = enable && pwm_on;
}
