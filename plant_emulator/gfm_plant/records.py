"""The memory of a plant: two NumPy records that the compiled functions read and write.

Both travel as arrays of shape (1,): compiled code reaches a field by plain pointer arithmetic,
nothing is allocated in a tick, and a run can be saved or compared as bytes. Units are p.u. and s
unless stated; the order of measured channels is (v_dc, p, q, V), then those of an inner stage.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

PlantRecord = NDArray[np.void]
"""Shape (1,) of `plant_par_dtype` or `plant_state_dtype`."""

MAX_DELAY = 5  # samples; a fraction of one may come on top
N_W = 5  # states of the circuit, see `solution.STATES`
N_SOURCES = 3  # the bridge, and the positive and the negative sequence of the grid
N_CIRCUITS = 4
OPERATING, BLOCKED, FAULTED = 0, 1, 2
"""The circuits: with the bridge in operation, or BLOCKED, without the filter inductor; and each of
them + FAULTED."""
N_MEASURED, N_COMMANDS = 10, 4  # channels of A/D and D/A, see `options.MEASURED`, `COMMANDS`
N_TRIPS = 7  # protections with a threshold, in the order of `protection.TRIP_REASONS`
N_OVERLOADS = 4  # steps of the overload profile, at most; their thresholds follow
N_RING = 256  # places of a ring that holds one cycle

plant_par_dtype = np.dtype(
    [
        ("omega_b", "f8"),  # rad/s
        # the elements of Eq. (1)-(8)
        ("L_f", "f8"),
        ("R_f", "f8"),
        ("C_f", "f8"),
        ("L_g", "f8"),
        ("R_g", "f8"),
        ("C_dc", "f8"),
        # the line as the converter file has it, and the local load (L_load = 0: none)
        ("L_line_n", "f8"),
        ("R_line_n", "f8"),
        ("L_load", "f8"),
        ("R_load", "f8"),
        # DC source: i_dc = i_u_gain i_u + k_p (1 - v_dc) + k_i integral, |i_dc| <= i_max
        ("i_u_gain", "f8"),
        ("k_p", "f8"),
        ("k_i", "f8"),
        ("i_max", "f8"),
        ("tau_dc", "f8"),  # its lag, s (0: none)
        # the bridge: |E| <= m_max v_dc, and |i| <= i_peak by blocking pulses
        ("m_max", "f8"),
        ("i_peak", "f8"),
        # sensors and A/D, one entry a measured channel; lsb = 0: no rounding
        ("filtered", "i8"),
        ("omega_s", "f8"),  # bandwidth, rad/s
        ("gain", "f8", (N_MEASURED,)),
        ("offset", "f8", (N_MEASURED,)),
        ("noisy", "i8"),
        ("noise_std", "f8", (N_MEASURED,)),
        ("seed", "u8"),
        ("adc_lo", "f8", (N_MEASURED,)),
        ("adc_hi", "f8", (N_MEASURED,)),
        ("adc_lsb", "f8", (N_MEASURED,)),
        # D/A, one entry a command
        ("dac_lo", "f8", (N_COMMANDS,)),
        ("dac_hi", "f8", (N_COMMANDS,)),
        ("dac_lsb", "f8", (N_COMMANDS,)),
        # a finite grid on its own rating (H_grid = 0: ideal); its rating over the converter's
        ("H_grid", "f8"),
        ("D_grid", "f8"),
        ("droop_grid", "f8"),
        ("T_gov", "f8"),
        ("S_grid", "f8"),
        # one sampling period: a stretch under u[k - delay - 1], which has no length without a
        # fraction of delay, then one under u[k - delay]; each is cut into pieces for Simpson's
        # rule, and each piece in halves
        ("T_s", "f8"),
        ("delay", "i8"),
        ("stretch", "f8", (2,)),  # s
        ("pieces", "i8", (2,)),
        ("half_h", "f8", (2,)),  # s
        ("dc_steps", "i8"),  # of RK4 for the DC link in each half
        ("sensor_weights", "f8", (2, 4)),  # of the last reading, and of a piece's parabola
        # the modes of each circuit: in operation, and with the bridge blocked
        ("n_states", "i8"),  # of w, without those at its end that the plant does not have
        # a fault: its place on the line, 0 at the terminal and 1 at the grid (-1: none), and R
        ("fault_at", "f8"),
        ("fault_R", "f8"),
        ("n_modes", "i8", (N_CIRCUITS,)),
        ("rate", "f8", (N_CIRCUITS, N_W, 2)),  # real and imaginary part, also below; 1/s
        ("decay", "f8", (N_CIRCUITS, 2, N_W, 2)),  # in half a piece of each stretch
        ("drive", "f8", (N_CIRCUITS, N_W, N_SOURCES, 2)),
        ("states", "f8", (N_CIRCUITS, N_W, N_W, 2)),
        ("modes", "f8", (N_CIRCUITS, N_W, N_W, 2)),
        # protection: threshold, and ticks it may stay crossed (-1: disabled)
        ("trip_limit", "f8", (N_TRIPS + N_OVERLOADS,)),
        ("trip_ticks", "i8", (N_TRIPS + N_OVERLOADS,)),
        # what is looked at over a cycle: places of the ring (0: nothing), ticks from one place to
        # the next, and whether the frequency is that of the voltage
        ("places", "i8"),
        ("place_ticks", "i8"),
        ("by_voltage", "i8"),
    ],
    align=True,
)

plant_state_dtype = np.dtype(
    [
        ("tick", "i8"),
        # in the common frame, real and imaginary parts: modes, what drives them in the present
        # stretch (in its first and its second half), states, and the sources' unit phasors
        ("z", "f8", (N_W, 2)),
        ("forced", "f8", (N_W, 4)),
        # each source's gain on the modes, for which speed and stretch, and turn in half a piece
        ("gain", "f8", (N_SOURCES, N_W, 2)),
        ("gain_omega", "f8", (N_SOURCES,)),
        ("gain_part", "i8", (N_SOURCES,)),
        ("turn", "f8", (N_SOURCES, 2)),
        ("w", "f8", (N_W, 2)),
        ("unit", "f8", (N_SOURCES, 2)),
        ("w_before", "f8", (N_W, 2)),  # w at the last tick
        ("x", "f8", (8,)),  # the state of Eq. (1)-(8), in the converter's frame
        ("i_reg", "f8"),  # integral part of the regulated DC source's current
        ("i_source", "f8"),  # current of a DC source with a lag
        ("E", "f8", (2,)),  # the bridge's voltage at this instant, d and q
        ("sensed", "f8", (4,)),  # the sensors' low-pass states
        ("u", "f8", (MAX_DELAY + 2, N_COMMANDS)),  # commands behind the D/A, u[k] first
        ("u_now", "f8", (N_COMMANDS,)),  # the command that acts at this instant
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
        # positive and negative sequence over V_g, real and imaginary part, and s until they are
        # 1 and 0 again
        ("sequence", "f8", (2, 2)),
        ("unbalance_left", "f8"),
        ("faulted", "i8"),
        ("fault_left", "f8"),  # s until the fault is cleared
        # a finite grid, p.u. of its rating: power of turbines, set point of governors, load; its
        # d/dt omega_g, 1/s; energy that the line has brought since the last tick, p.u. of S_n s
        ("P_turbine", "f8"),
        ("P_set", "f8"),
        ("P_load", "f8"),
        ("omega_g_slope", "f8"),
        ("brought", "f8"),
        # protection: ticks in a row that each threshold was crossed, and the latched trip
        ("crossed", "i8", (N_TRIPS + N_OVERLOADS,)),
        # one cycle: ticks looked at; sums over them of i^2 and of the turn of the capacitor's
        # voltage in the common frame, rad, and a ring of what they were; the voltage at the last
        # tick; RMS of the current and speed of the voltage
        ("looked", "i8"),
        ("sums", "f8", (2,)),
        ("ring", "f8", (N_RING, 2)),
        ("v_before", "f8", (2,)),
        ("i_rms", "f8"),
        ("omega_v", "f8"),
        ("trip", "i8"),  # a key of `protection.TRIP_REASONS`, 0: none
        ("trip_tick", "i8"),
        ("trip_value", "f8"),
    ],
    align=True,
)
