"""The memory of a plant: NumPy records that the compiled functions read and write.

``par`` and ``st`` have one element for each converter. Compiled code reaches a field by plain
pointer arithmetic, nothing is allocated in a tick, and a run can be saved or compared as bytes.
Units are p.u. and s unless stated: those of a converter are p.u. of its own rating, those of the
network p.u. of the first converter's. The order of measured channels is (v_dc, p, q, V), then those
of an inner stage. What every tick needs stands first in a record, so that it fills few lines of the
processor's cache.
"""

from typing import NamedTuple

import numpy as np

from gfm_plant.layout import Record as Record
from gfm_runtime.signals import NY_INNER

MAX_DELAY = 5  # samples; a fraction of one may come on top
N_OWN = 3  # states of the circuit that a converter brings: i_f, v, i_o
I_F, V, I_O = 0, 1, 2
"""Places of a converter's states in w, from ``own(k)`` on: currents of filter and line, and the
voltage of the filter capacitor."""
N_MEASURED, N_COMMANDS = 10, 7  # channels of A/D and D/A, see `options.MEASURED`, `COMMANDS`
COMPARE = 4  # place of the compare values in a command, below 0: it has none
N_PHASES = 10  # channels of the A/D at the phases, in the order of the group ``adc``
N_TRIPS = 7  # protections with a threshold, in the order of `protection.TRIP_REASONS`
N_OVERLOADS = 4  # steps of the overload profile, at most; their thresholds follow
N_LIVE = 10  # states of a converter with a switched bridge, see ``ends``
N_PATH = 4  # terms of its path between two edges, see ``ends``
N_GATES = 6  # states of the gates of a leg, at most, see `bridge`
ACROSS, BEHIND = 1, 2  # where a PV array is, see ``array``
N_RING = 256  # places of a ring that holds one cycle


class PlantRecords(NamedTuple):
    """A plant as compiled functions take it, see ``gfm_plant.make_plant``."""

    # par, st: parameters and state of the converters, shape (N,), of `converter_par_dtype` and
    # `converter_state_dtype`
    par: Record
    st: Record
    # net, now: parameters and state of the network that connects them, shape (1,), see `layout`
    net: Record
    now: Record
    # of each kind of component in ``components.DYNAMIC`` the records of all that there are, of its
    # ``record``
    parts: tuple[Record, ...]


converter_par_dtype = np.dtype(
    [
        ("omega_b", "f8"),  # rad/s
        # the elements of Eq. (1)-(8)
        ("L_f", "f8"),
        ("R_f", "f8"),
        ("C_f", "f8"),
        ("L_g", "f8"),
        ("R_g", "f8"),
        ("C_dc", "f8"),
        ("current", "f8"),  # p.u. of the network in p.u. of the converter: ratio of their ratings
        # DC source: i_dc = i_u_gain i_u + k_p (1 - v_dc) + k_i integral, |i_dc| <= i_max
        ("i_u_gain", "f8"),
        ("k_p", "f8"),
        ("k_i", "f8"),
        ("i_max", "f8"),
        ("tau_dc", "f8"),  # its lag, s (0: none)
        # the battery behind it: energy over S_n, s (0: none), charge at the start and its limits,
        # power that it gives and takes at most, resistance
        ("energy", "f8"),
        ("soc", "f8", (3,)),
        ("P_most", "f8", (2,)),
        ("R_battery", "f8"),
        # the chopper: its conductance (0: none), v_dc that turns it on and off
        ("chopper", "f8", (3,)),
        ("array", "i8"),  # a PV array is ACROSS the link or BEHIND its source; 0: there is none
        ("dc_steps", "i8"),  # of the DC link in a piece, see `net`
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
        # from the tick that samples y[k] to the effect of u[k]: samples, and a fraction of one
        ("T_s", "f8"),
        ("delay", "i8"),
        ("fraction", "f8"),
        # protection: threshold, and ticks it may stay crossed (-1: disabled)
        ("trip_limit", "f8", (N_TRIPS + N_OVERLOADS,)),
        ("trip_ticks", "i8", (N_TRIPS + N_OVERLOADS,)),
        # what is looked at over a cycle: places of the ring (0: nothing), ticks from one place to
        # the next, and whether the frequency is that of the voltage
        ("places", "i8"),
        ("place_ticks", "i8"),
        ("by_voltage", "i8"),
        # the line as the converter file has it
        ("L_line_n", "f8"),
        ("R_line_n", "f8"),
        # a switched one (0 levels: it is averaged), see `bridge`: levels of a leg, gates that block
        # it; counts of the timer in half a carrier, and s of one; dead time, s; the shortest half
        # of a pulse, counts; the space vector of a leg's voltage in p.u. of v_dc. For each state of
        # the gates whether the leg's voltage depends on its current, and its least and its largest
        # voltage as factors of v_dc and of the midpoint's displacement, p.u. of v_dc, and p.u. of
        # resistance
        ("levels", "i8"),
        ("off", "i8"),
        ("counts", "i8"),
        ("count_s", "f8"),
        ("dead", "f8"),
        ("least", "i8"),
        ("leg", "f8"),
        ("wide", "i8", (N_GATES,)),
        ("band", "f8", (N_GATES, 2, 4)),
        # which of all different ones it is; whether legs of one kind give no voltage together
        ("band_kind", "i8", (N_GATES, 2)),
        ("cancels", "i8"),
        # sensors and A/D at the phases, see `phases`, one entry a channel: s by which it samples
        # before the tick; value of the lowest code and of a step; the highest code; weights of the
        # sensor's low-pass in a period
        ("phase_gain", "f8", (N_PHASES,)),
        ("phase_offset", "f8", (N_PHASES,)),
        ("phase_noise", "f8", (N_PHASES,)),
        ("phase_skew", "f8", (N_PHASES,)),
        ("skewed", "i8"),  # one of them
        ("phase_lo", "f8", (N_PHASES,)),
        ("phase_per_lsb", "f8", (N_PHASES,)),
        ("phase_top", "f8"),
        ("phase_weights", "f8", (3,)),
        ("phase_samples", "i8"),  # conversions in a period, whose sum is the count
        # the PV array, see `pv_array`: photocurrent at an irradiance of 1, saturation current and
        # voltage of the diode, irradiance at the start
        ("I_sc", "f8"),
        ("I_0", "f8"),
        ("v_T", "f8"),
        ("irradiance", "f8"),
    ],
    align=True,
)

converter_state_dtype = np.dtype(
    [
        ("tick", "i8"),
        ("x", "f8", (8,)),  # the state of Eq. (1)-(8), in the converter's frame
        ("i_reg", "f8"),  # integral part of the regulated DC source's current
        ("i_source", "f8"),  # current of a DC source with a lag
        # in this period: limits of its current, and the conductance of the chopper; the battery's
        # state of charge
        ("i_most", "f8", (2,)),
        ("chopper", "f8"),
        ("soc", "f8"),
        ("E", "f8", (2,)),  # the bridge's voltage at this instant, d and q
        ("sensed", "f8", (4,)),  # the sensors' low-pass states
        ("u", "f8", (MAX_DELAY + 2, N_COMMANDS)),  # commands behind the D/A, u[k] first
        ("u_now", "f8", (N_COMMANDS,)),  # the command that acts at this instant
        ("reads", "f8", (NY_INNER,)),  # what the A/D of `sensors` gave last, p.u.
        ("phase_sums", "f8", (N_PHASES,)),  # of this period's conversions, NaN if there were none
        # in a piece of time: power that the bridge draws, and what the sensors see, at its
        # beginning, middle and end; the command's voltage and the most that v_dc gives
        ("drawn", "f8", (3,)),
        ("seen", "f8", (3, 3)),
        ("E_commanded", "f8", (2,)),
        ("E_most", "f8"),
        # when kept: delta, v_dc, DC source (3), sensors (4), and what the bridge was commanded (3)
        ("before", "f8", (12,)),
        # protection: ticks in a row that each threshold was crossed, and the latched trip
        ("crossed", "i8", (N_TRIPS + N_OVERLOADS,)),
        ("trip", "i8"),  # a key of `protection.TRIP_REASONS`, 0: none
        ("trip_tick", "i8"),
        ("trip_value", "f8"),
        ("tripped_by", "i8"),  # place of its threshold in trip_limit, of a protection
        # of a bridge that is to start again, see `protection.start_condition`; the speed of the
        # capacitor's voltage that a blocked one sees
        ("waits", "i8"),
        ("omega_seen", "f8"),
        # at the phases, at the last tick: the true values and the sensors' (NaN: not known yet)
        ("phase_seen", "f8", (2, N_PHASES)),
        # of a conversion: values, what they change by in a second, and samples of N(0, 1)
        ("phase_true", "f8", (N_PHASES,)),
        ("phase_slope", "f8", (N_PHASES,)),
        ("phase_random", "f8", (N_PHASES,)),
        # what ``seen`` changes by in a second at the beginning and the end of an interval between
        # two edges
        ("seen_slopes", "f8", (2, 3)),
        # the legs of a switched bridge: gates, commanded level, sign of the current where it
        # decides (0: there is none), and when the next gate turns on, s from the beginning of the
        # unit; of this unit the level below the carrier and the edges down and up, s; when each leg
        # changes next, and the first of them
        ("gate", "i8", (3,)),
        ("level", "i8", (3,)),
        ("flows", "i8", (3,)),
        ("on_at", "f8", (3,)),
        ("base", "i8", (3,)),
        ("edges", "f8", (3, 2)),
        ("next", "f8", (3,)),
        ("soonest", "f8"),
        # v of the upper less that of the lower half of C_dc, p.u. of v_dc; at which limit the DC
        # source is, and whether its integral goes on; legs without current: none (-1), one, all (3)
        ("mid", "f8"),
        ("limit", "f8"),
        ("winds", "f8"),
        ("open", "i8"),
        # of the interval between two edges: the states i_f, v, i_o (alpha and beta), v_dc, integral
        # of the source's control with i_u, current of the source, and midpoint, at its beginning
        # and where it leads to, and the first terms of the series between the two, see
        # `series.find_path`; what v and i_o change by in a second there; what has to be done
        # before it: 1: equations, 2: find what conducts besides; the matrix of `powers` in
        # force; the bridge's voltage by v_dc, by mid and by nothing, as
        # a space vector, and what they and the voltage at its terminal, and the current, do to the
        # current, 1/s
        ("ends", "f8", (2 + N_PATH, N_LIVE)),
        ("slopes", "f8", (2, 4)),
        ("due", "i8"),
        ("slot", "i8"),
        ("by_dc", "c16"),
        ("by_mid", "c16"),
        ("di_dc", "c16"),
        ("di_mid", "c16"),
        ("di", "c16"),
        ("di_v", "f8", (3,)),
        ("di_i", "f8", (4,)),
        # the bridge's frame, as a phasor that stands still
        ("ahead", "c16"),
        ("legs_before", "f8", (7, 3)),
        # one cycle: ticks looked at; sums over them of i^2 and of the turn of the capacitor's
        # voltage in the common frame, rad, and a ring of what they were; the voltage at the last
        # tick; RMS of the current and speed of the voltage
        ("looked", "i8"),
        ("sums", "f8", (2,)),
        ("ring", "f8", (N_RING, 2)),
        ("v_before", "f8", (2,)),
        ("i_rms", "f8"),
        ("omega_v", "f8"),
        # the irradiance on the PV array, where it goes, and how fast, 1/s; the largest power there
        ("irradiance", "f8"),
        ("irradiance_to", "f8"),
        ("irradiance_rate", "f8"),
        ("P_array", "f8"),
    ],
    align=True,
)
