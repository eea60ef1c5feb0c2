"""The memory of a plant: NumPy records that the compiled functions read and write.

``par`` and ``st`` have one element for each converter, ``net`` and ``now`` one for the network that
connects them. Compiled code reaches a field by plain pointer arithmetic, nothing is allocated in a
tick, and a run can be saved or compared as bytes. Units are p.u. and s unless stated: those of a
converter are p.u. of its own rating, those of the network p.u. of the first converter's. The order
of measured channels is (v_dc, p, q, V), then those of an inner stage.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Record = NDArray[np.void]

MAX_DELAY = 5  # samples; a fraction of one may come on top
N_OWN = 3  # states of the circuit that a converter brings: i_f, v, i_o
N_MEASURED, N_COMMANDS = 10, 4  # channels of A/D and D/A, see `options.MEASURED`, `COMMANDS`
N_TRIPS = 7  # protections with a threshold, in the order of `protection.TRIP_REASONS`
N_OVERLOADS = 4  # steps of the overload profile, at most; their thresholds follow
N_RING = 256  # places of a ring that holds one cycle

SIZES = {1: 7, 2: 17, 4: 33, 12: 97}
"""Records come in sizes, because each is compiled once a computer: converters, and states of the
circuit, that fit in."""
N_SINKS = 4  # loads of constant power that fit; into the records of one converter, one
N_MACHINES = 4  # that fit into the records of two converters and more; into those of one, none


def size_for(converters: int, states: int, machines: int = 0, sinks: int = 0) -> int:
    """Return the key of `SIZES` for so many converters, states of the circuit, machines, and loads
    of constant power.

    Raises:
        ValueError: If there are too many.
    """
    for size, most in SIZES.items():
        fits = machines <= N_MACHINES * (size > 1) and sinks <= (N_SINKS if size > 1 else 1)
        if size >= converters and most >= states and fits:
            return size
    if sinks > N_SINKS:
        raise ValueError(f"network.constant_power: {sinks}; at most {N_SINKS}")
    if machines > N_MACHINES:
        raise ValueError(f"network.machines: {machines}; at most {N_MACHINES}")
    raise ValueError(
        f"network: {converters} converters and {states} currents and voltages; at most"
        f" {max(SIZES)} and {max(SIZES.values())}"
    )


class PlantRecords(NamedTuple):
    """A plant: converters and the network between them, see ``gfm_plant.make_plant``.

    Attributes:
        par, st: parameters and state of the converters, shape (N,), of `converter_par_dtype` and
            `converter_state_dtype`.
        net, now: parameters and state of the network, shape (1,), of `network_dtypes`.
    """

    par: Record
    st: Record
    net: Record
    now: Record

    def copy(self) -> PlantRecords:
        """Return the same plant at the same instant, in memory of its own."""
        return PlantRecords(*(record.copy() for record in self))

    def restore(self, kept: PlantRecords) -> None:
        """Take the parameters and the instant of a copy."""
        for record, old in zip(self, kept, strict=True):
            record[:] = old


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
        # the line as the converter file has it
        ("L_line_n", "f8"),
        ("R_line_n", "f8"),
        ("current", "f8"),  # p.u. of the network in p.u. of the converter: ratio of their ratings
        # DC source: i_dc = i_u_gain i_u + k_p (1 - v_dc) + k_i integral, |i_dc| <= i_max
        ("i_u_gain", "f8"),
        ("k_p", "f8"),
        ("k_i", "f8"),
        ("i_max", "f8"),
        ("tau_dc", "f8"),  # its lag, s (0: none)
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
    ],
    align=True,
)

converter_state_dtype = np.dtype(
    [
        ("tick", "i8"),
        ("x", "f8", (8,)),  # the state of Eq. (1)-(8), in the converter's frame
        ("i_reg", "f8"),  # integral part of the regulated DC source's current
        ("i_source", "f8"),  # current of a DC source with a lag
        ("E", "f8", (2,)),  # the bridge's voltage at this instant, d and q
        ("sensed", "f8", (4,)),  # the sensors' low-pass states
        ("u", "f8", (MAX_DELAY + 2, N_COMMANDS)),  # commands behind the D/A, u[k] first
        ("u_now", "f8", (N_COMMANDS,)),  # the command that acts at this instant
        # in a piece of time: power that the bridge draws, and what the sensors see, at its
        # beginning, middle and end; the command's voltage and the largest that v_dc gives
        ("drawn", "f8", (3,)),
        ("seen", "f8", (3, 3)),
        ("E_commanded", "f8", (2,)),
        ("E_most", "f8"),
        ("before", "f8", (8,)),  # at the last tick: delta, v_dc, DC source (2), sensors (4)
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
        # of a bridge that is to start again, see `protection.start_condition`; the speed of the
        # capacitor's voltage that a blocked one sees
        ("waits", "i8"),
        ("omega_seen", "f8"),
    ],
    align=True,
)


@cache
def network_dtypes(converters: int) -> tuple[np.dtype[np.void], np.dtype[np.void]]:
    """Return the dtypes of a network's parameters and state; ``converters`` is a key of `SIZES`.

    Circuits come in pairs of one row each without and with the fault: row 0 as the converters are,
    and row 1 + k with the bridge of converter k blocked besides. Sources are the bridges, then the
    positive and the negative sequence of the grid, then the machines, then the currents of the
    loads of constant power; in an unbalanced circuit their mirror images follow in the same
    order. Such a circuit has up to two modes a state. What swings is the grid, if it is finite, in
    place 0, and the machines.
    """
    n_m = N_MACHINES * (converters > 1)
    n_l = N_SINKS if converters > 1 else 1
    n_w, n_s, n_parts = SIZES[converters], converters + 2 + n_m + n_l, converters + 1
    n_z = 2 * n_w
    n_c, n_swing = 2 * (converters + 1), 1 + n_m
    par = np.dtype(
        [
            ("omega_b", "f8"),  # rad/s
            ("joins", "i8"),  # a converter that is reset starts in the network as it is by then
            # swing equations and governors, on their own ratings (H = 0: an ideal grid); their
            # ratings over the network's
            ("n_machines", "i8"),
            ("H", "f8", (n_swing,)),
            ("D", "f8", (n_swing,)),
            ("droop", "f8", (n_swing,)),
            ("T_gov", "f8", (n_swing,)),
            ("S", "f8", (n_swing,)),
            # a machine's voltage behind its reactance, and the place of its current in w
            ("E", "f8", (n_swing,)),
            ("current_at", "i8", (n_swing,)),
            ("reference", "i8"),  # without a grid: the machine whose speed is omega_g (0: none)
            # loads of constant power: P and Q, p.u. of the network; the lag of their measurement,
            # s, and its weights as below; the square of their least voltage; its place in w
            ("n_sinks", "i8"),
            ("S_sink", "f8", (n_l, 2)),
            ("tau_sink", "f8", (n_l,)),
            ("sink_weights", "f8", (2 * n_parts, n_l, 4)),
            ("least_v2", "f8", (n_l,)),
            ("voltage_at", "i8", (n_l,)),
            ("to_grid", "f8", (n_w,)),  # what each state of w brings to the grid, as a current
            # one sampling period in stretches, between the instants at which a command begins to
            # act; each is cut into pieces for Simpson's rule, and each piece in halves. Another cut
            # of each, n_parts places further on, lets a peak-current limit look at the current
            ("T_s", "f8"),
            ("n_converters", "i8"),
            ("n_parts", "i8"),
            ("stretch", "f8", (n_parts,)),  # s
            ("pieces", "i8", (2 * n_parts,)),
            ("half_h", "f8", (2 * n_parts,)),  # s
            ("age", "i8", (n_parts, converters)),  # place in `u` of the command that acts
            # of the last reading, and of a piece's parabola
            ("sensor_weights", "f8", (2 * n_parts, converters, 4)),
            # the modes of each circuit
            ("n_states", "i8"),  # of w, without those at its end that the plant does not have
            ("n_modes", "i8", (n_c,)),
            ("rate", "f8", (n_c, n_z, 2)),  # real and imaginary part, also below; 1/s
            ("decay", "f8", (n_c, 2 * n_parts, n_z, 2)),  # in half a piece of each cut
            ("drive", "f8", (n_c, n_z, n_s, 2)),
            ("states", "f8", (n_c, n_w, n_z, 2)),
            ("modes", "f8", (n_c, n_z, n_w, 2)),
            ("unbalanced", "i8", (n_c,)),
            ("mirror", "f8", (n_c, n_z, 2)),  # see `circuit.Modes`
            # of a synchro-check: the voltages of its two sides by w and by the sources; the largest
            # difference of voltage, p.u., speed, rad/s, and angle, rad; how long, and until when, s
            ("check_w", "f8", (n_c, 2, n_w)),
            ("check_s", "f8", (n_c, 2, n_s)),
            ("check_limits", "f8", (3,)),
            ("check_lasting", "f8"),
        ],
        align=True,
    )
    state = np.dtype(
        [
            # in the common frame, real and imaginary parts: modes, what drives them in the present
            # stretch (in its first and its second half), states, and the sources' unit phasors
            ("z", "f8", (n_z, 2)),
            ("forced", "f8", (n_z, 4)),
            # for each cut, each source's gain on the modes at the speed that it had last (inf: not
            # known yet), and its turn in half a piece
            ("gain", "f8", (2 * n_parts, 2 * n_s, n_z, 2)),
            ("gain_omega", "f8", (2 * n_parts, 2 * n_s)),
            ("turn", "f8", (2 * n_parts, 2 * n_s, 2)),
            ("w", "f8", (n_w, 2)),
            ("unit", "f8", (2 * n_s, 2)),
            ("halfway", "f8", (2 * n_s, 2)),  # the unit phasors in the middle of a piece
            ("w_before", "f8", (n_w, 2)),  # w at the last tick
            ("unit_before", "f8", (n_s, 2)),
            # the voltage that a load of constant power has measured, now, at the last tick, and
            # the true one at the beginning and in the middle of a piece
            ("v_sink", "f8", (n_l, 2)),
            ("v_sink_before", "f8", (n_l, 2)),
            ("v_seen", "f8", (n_l, 2, 2)),
            ("row", "i8"),  # of the circuits, without the fault
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
            # what swings, p.u. of its rating: power of turbines, set point of governors, load; its
            # d/dt omega, 1/s; energy that came since the last tick, p.u. of the network and s
            ("P_turbine", "f8", (n_swing,)),
            ("P_set", "f8", (n_swing,)),
            ("P_load", "f8", (n_swing,)),
            ("omega_g_slope", "f8"),
            ("omega", "f8", (n_swing,)),  # of the machines; that of the grid is omega_g
            ("slope", "f8", (n_swing,)),
            ("energy", "f8", (n_swing,)),
            # of a synchro-check: see `synchro_check.NONE`; the differences now, in the order of
            # `check_limits`, for how long they have been within, and the time that is left, s;
            # ticks in a row in which both sides were alive
            ("check", "i8"),
            ("check_looks", "i8"),
            ("check_seen", "f8", (3,)),
            ("check_lasted", "f8"),
            ("check_left", "f8"),
        ],
        align=True,
    )
    return par, state
