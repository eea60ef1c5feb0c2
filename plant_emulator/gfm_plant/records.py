"""The memory of a plant: two NumPy records that the compiled functions read and write.

Both travel as arrays of shape (1,): compiled code reaches a field by plain pointer arithmetic,
nothing is allocated in a tick, and a run can be saved or compared as bytes. Units are p.u. and s
unless stated; the order of `measured` channels is (v_dc, p, q, V).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

PlantRecord = NDArray[np.void]
"""Shape (1,) of `plant_par_dtype` or `plant_state_dtype`."""

MAX_DELAY = 5  # samples; a fraction of one may come on top
N_TRIPS = 7  # protections with a threshold, in the order of `protection.TRIP_REASONS`

plant_par_dtype = np.dtype(
    [
        ("omega_b", "f8"),  # rad/s
        # the elements of Eq. (1)-(8); L_g, R_g are what i_o flows through: the line, and behind
        # an open grid breaker the local load as well
        ("L_f", "f8"),
        ("R_f", "f8"),
        ("C_f", "f8"),
        ("L_g", "f8"),
        ("R_g", "f8"),
        ("C_dc", "f8"),
        # the line alone, now and nominally, and the local load (L_load = 0: none)
        ("L_line", "f8"),
        ("R_line", "f8"),
        ("L_line_n", "f8"),
        ("R_line_n", "f8"),
        ("L_load", "f8"),
        ("R_load", "f8"),
        # DC source: i_dc = i_u_gain i_u + k_p (1 - v_dc) + k_i integral, |i_dc| <= i_max
        ("i_u_gain", "f8"),
        ("k_p", "f8"),
        ("k_i", "f8"),
        ("i_max", "f8"),
        # sensors and A/D, one entry a measured channel; lsb = 0: no rounding
        ("filtered", "i8"),
        ("omega_s", "f8"),  # bandwidth, rad/s
        ("gain", "f8", (4,)),
        ("offset", "f8", (4,)),
        ("noise_std", "f8", (4,)),
        ("seed", "u8"),
        ("adc_lo", "f8", (4,)),
        ("adc_hi", "f8", (4,)),
        ("adc_lsb", "f8", (4,)),
        # D/A, one entry a command
        ("dac_lo", "f8", (3,)),
        ("dac_hi", "f8", (3,)),
        ("dac_lsb", "f8", (3,)),
        # one sampling period: `steps_old` RK4 steps of `h_old` under u[k - delay - 1], then
        # `steps_new` of `h_new` under u[k - delay]
        ("T_s", "f8"),
        ("delay", "i8"),
        ("steps_old", "i8"),
        ("h_old", "f8"),
        ("steps_new", "i8"),
        ("h_new", "f8"),
        # protection: threshold, and ticks it may stay crossed (-1: disabled)
        ("trip_limit", "f8", (N_TRIPS,)),
        ("trip_ticks", "i8", (N_TRIPS,)),
    ],
    align=True,
)

plant_state_dtype = np.dtype(
    [
        ("tick", "i8"),
        ("x", "f8", (8,)),  # the state of Eq. (1)-(8)
        ("i_reg", "f8"),  # integral part of the regulated DC source's current
        ("i_load", "f8", (2,)),  # d and q current of the local load while the breaker is closed
        ("sensed", "f8", (4,)),  # the sensors' low-pass states
        ("u", "f8", (MAX_DELAY + 2, 3)),  # commands behind the D/A, u[k] first
        ("u_now", "f8", (3,)),  # the command that acts at this instant
        # grid simulator: values now, where ramps lead, and p.u./s (inf: a step)
        ("closed", "i8"),
        ("omega_g", "f8"),
        ("omega_g_to", "f8"),
        ("omega_g_rate", "f8"),
        ("V_g", "f8"),
        ("V_g_to", "f8"),
        ("V_g_rate", "f8"),
        ("sag_left", "f8"),  # s until a sag recovers (0: no sag)
        ("V_g_after", "f8"),  # voltage it recovers to
        # protection: ticks in a row that each threshold was crossed, and the latched trip
        ("crossed", "i8", (N_TRIPS,)),
        ("trip", "i8"),  # a key of `protection.TRIP_REASONS`, 0: none
        ("trip_tick", "i8"),
        ("trip_value", "f8"),
    ],
    align=True,
)
