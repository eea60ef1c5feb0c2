"""The memory of a network's circuits: two records, each as long as the scenario needs.

A record begins with scalars, the same for all plants, and goes on with arrays. Compiled functions
know the scalars alone and reach an array by its name with `field`, so that they are compiled once
for plants of any size, and a call passes no more than a pointer. Python sees the whole record, with
every array under its name. Currents and voltages are complex: space vectors in the common frame.
"""

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from llvmlite import ir
from numba import from_dtype, types
from numba.core import cgutils
from numpy.typing import NDArray

from gfm_plant.names import WAYS
from gfm_runtime.compiled import intrinsic

MOST_CONTACTS = 8
"""None, one of three phases, and what is left of it as these open: two of them, or one."""

MOST_OF_SEVERAL = 500
"""States up to which a large plant may have several contacts at a time, whose modes it makes."""

CHECK_SIDES = 2
"""Nodes whose voltage a synchro-check looks at."""

Record = NDArray[np.void]
_Arrays = Mapping[str, tuple[type, tuple[str | int, ...]]]

TERMS = 24
"""Of the series of a switched bridge, at most."""
POWERS, ORDER, SLOTS = 5, 16, 256
"""How many powers of a matrix `powers` keeps, of which order, and of how many matrices."""

LARGEST = 0.6
"""Of the norm of A times the length of an interval that a series goes through."""

COARSE, FINE = 160, 128
"""How many matrices of `strides` there are for steps of FINE counts, and for those of one."""

EDGES = 16
"""How many ends of intervals `walk` goes along at a time."""

SPEEDS, MOMENTS, DRIVES, LANES = 6, 5, 24, 16
"""Behind a `port`: powers of time that a source has, moments of a current, powers of time in a
unit, and those in an interval, at most."""

_LINE = 64  # bytes of a line of the processor's cache, at which every array begins

_NET: _Arrays = {
    "to_grid": (float, ("n_w",)),  # what each state of w brings to the grid, as a current
    # one sampling period in stretches, between the instants at which a command begins to act; each
    # is cut into pieces for Simpson's rule, and each piece in halves. Another cut of each, n_parts
    # places further on, lets a peak-current limit look at the current; the last one is for what
    # ends where a phase of a fault or breaker opens, see `clearing`
    "stretch": (float, ("n_parts",)),  # s
    "pieces": (int, ("n_cuts",)),
    "half_h": (float, ("n_cuts",)),  # s
    "age": (int, ("n_parts", "n_converters")),  # place in `u` of the command that acts
    # of first-order lags over a piece, the sensors of each converter first: weights of the last
    # value, and of the parabola through the input
    "lag_weights": (float, ("n_cuts", "n_lags", 4)),
    "lag_rate": (float, ("n_lags",)),  # 1/s
    # the modes of each circuit
    "n_modes": (int, ("n_c",)),
    "rate": (complex, ("n_m", "n_z")),  # 1/s
    "decay": (complex, ("n_m", "n_cuts", "n_z")),  # in half a piece of each cut
    # by the sources and by w, and by the mirror images of both, see `circuit.Modes`
    "drive": (complex, ("n_m", 2, "n_z", "n_s")),
    "states": (complex, ("n_m", "n_w", "n_z")),
    "modes": (complex, ("n_m", 2, "n_z", "n_w")),
    "unbalanced": (int, ("n_c",)),
    # of the contacts: the current of each phase by w, and what is left when it opens (-1:
    # it carries none), see `Wiring.contacts`
    "contact_current": (complex, ("n_contacts", 3, "n_w")),
    "opens_to": (int, ("n_contacts", 3)),
    "contact_of": (int, (8,)),  # the contact by its phases: 1 for a, 2 for b, 4 for c
    # of several contacts, see `joint.Joint`: its matrices, in the order of their names, and the
    # currents of each phase by w, as ``contact_current``
    "flow": (float, (8, "n_q", "n_q")),
    "fault_bars": (float, (8, 3, "n_q")),
    "fault_carries": (complex, (8, 3, "n_w")),
    "pole_bars": (float, ("n_poles", 3, "n_q")),
    "pole_carries": (complex, ("n_poles", 3, "n_w")),
    "zero_shares": (float, ("n_joint", "n_w")),  # w by the zero sequence of a contact's current
    "to_w": (float, ("n_w", 2, "n_q")),
    "from_w": (float, ("n_w", 2, "n_q")),
    "from_s": (float, ("n_s", 2, "n_q")),
    "node_q": (float, ("n_nodes", 2, 2, "n_q")),
    # of nodes whose voltage is looked at, the two sides of a synchro-check first and then the
    # connection points: their voltages by w and by the sources, and by the mirror images of both;
    # what turns the latter; and the place in w of the current that reaches the node
    "node_w": (complex, ("n_m", "n_nodes", 2, "n_w")),
    "node_s": (complex, ("n_m", "n_nodes", 2, "n_s")),
    "node_turn": (complex, ("n_c",)),
    "node_i": (int, ("n_nodes",)),
    # of recorded terminals, see `flows`: the places of nodes in ``flow_v``, whether the grid holds
    # a node; where the currents of each begin among ``flow_from``, which are places in w, or
    # after those of sources, and ``flow_by``, their factors; and its conductance to ground
    "flow_node": (int, ("n_flows",)),
    "flow_held": (int, ("n_flow_nodes",)),
    "flow_begin": (int, ("n_flow_ends",)),
    "flow_from": (int, ("n_flow_sums",)),
    "flow_by": (float, ("n_flow_sums",)),
    "flow_G": (float, ("n_flows",)),
    "flow_turns": (int, ("n_flows",)),  # the source whose speed is recorded; -1: it has none
    "flow_more": (int, ("n_flows",)),  # columns after these that a component writes
    # by converter, then by grid-following neighbour, its plant controller, from 1 on; 0: none
    "supervisor": (int, ("n_commanded",)),
    # of a large plant, see `sparse.Sparse`, of each contact its axis alpha and its axis beta: how
    # many states, sums for the voltages, rows of ``extra_at``, sums on the way in, and sums of no
    # more than two, of three and of four entries; and of each node whose voltage is looked at its
    # column, -1: it is zero
    "n_sums": (int, ("n_sparse", 7)),
    "norm": (float, ("n_sparse",)),
    "least": (float, ("n_sparse",)),
    "own_by": (float, ("n_sparse", 6, "n_converters")),
    "line_to": (int, ("n_sparse", "n_converters")),
    "state_at": (int, ("n_sparse", "n_w")),
    "x_of": (int, ("n_sparse", "n_w")),
    "x_by": (float, ("n_sparse", "n_w")),
    "extra_at": (int, ("n_sparse", "n_w")),
    "sum_begin": (int, ("n_sparse", "n_columns")),
    "sum_column": (int, ("n_sparse", "n_sum")),
    "sum_value": (float, ("n_sparse", "n_sum")),
    "enter_begin": (int, ("n_sparse", "n_columns")),
    "enter_column": (int, ("n_sparse", "n_sum")),
    "enter_value": (float, ("n_sparse", "n_sum")),
    "node_column": (int, ("n_sparse", "n_nodes")),
    "contact_axis": (complex, ("n_contacts",)),  # e^(-j angle) of alpha
    # with switched bridges, see `series`: which cut of the period each unit of the carrier belongs
    # to; of each circuit e^(-j angle) of its axis alpha, the axes of the legs, its fastest rate,
    # 1/s; of each converter what i_f, v, i_o and v, i_o of itself do to its v and i_o, on both
    # axes, 1/s; the other entries of w' = A w + B s: how many, row and column, values on both axes,
    # and what beta does to alpha and alpha to beta; whether there are none but what the grid does
    # to the only line
    "unit_part": (int, ("n_units",)),
    "axis": (complex, ("n_rates",)),
    "leg_axis": (complex, ("n_rates", 3)),
    "fastest": (float, ("n_rates",)),
    "own_rates": (float, ("n_rates", "n_converters", 2, 5)),
    "n_links": (int, ("n_rates", 2)),
    "alone": (int, ("n_rates",)),
    "link_place": (int, ("n_rates", 2, "n_entries", 2)),
    "link": (float, ("n_rates", 2, "n_entries", 4)),
    # with one switched bridge in a network, see `port`, of each row of circuits without a contact:
    # how many powers of time (0: it has no tables), rows, and states and sources that give all
    # else, whose places follow; what these do, by columns, and what the moments of the bridge's
    # voltage do, to the powers of what drives its line, to all other states at the end of a unit,
    # and to the moments of the currents of averaged bridges
    "port_powers": (int, ("n_ports",)),
    "port_rows": (int, ("n_ports",)),
    "port_states": (int, ("n_ports",)),
    "port_sources": (int, ("n_ports",)),
    "port_state": (int, ("n_ports", "n_w")),
    "port_source": (int, ("n_ports", "n_s")),
    "port_table": (float, ("n_ports", "n_port_columns", "n_port_rows")),
    "port_moment": (float, ("n_ports", DRIVES, "n_port_rows")),
    "port_most": (float, ("n_ports", DRIVES)),  # of its first row, the largest from here on
}
_NOW: _Arrays = {
    # modes, what drives them in the first and in the second half of the present piece, and states
    "z": (complex, ("n_z",)),
    "forced": (complex, ("n_z", 2)),
    # for each cut, each source's gain on the modes at the speed that it had last (inf: not known
    # yet), and its turn in half a piece
    "gain": (complex, ("n_cuts", "n_phasors", "n_z")),
    "gain_omega": (float, ("n_cuts", "n_phasors")),
    "turn": (complex, ("n_cuts", "n_phasors")),
    "w": (complex, ("n_w",)),
    "emf": (complex, ("n_s",)),  # p.u.; of a component with a voltage, over its unit phasor
    "unit": (complex, ("n_phasors",)),  # the sources' unit phasors, then those of their mirrors
    # of recorded terminals the voltages of their nodes; the currents of components with such
    "flow_v": (complex, ("n_flow_nodes",)),
    "flow_i": (complex, ("n_flow_sources",)),
    "flow_omega": (float, ("n_flow_sources",)),  # the speeds of components with such, p.u.
    "flow_row": (float, ("n_flow_columns",)),  # as recorded at the last look
    # set-points of plant controllers by converter, then by grid-following neighbour, p.u. of it:
    # P, Q, V; NaN: none
    "set_points": (float, ("n_commanded", 3)),
    "set_begin": (float, ("n_commanded", 3)),  # its references at the start
    "halfway": (complex, ("n_phasors",)),  # in the middle of a piece
    "w_before": (complex, ("n_w",)),  # at the last tick
    "unit_before": (complex, ("n_s",)),
    # with switched bridges: the terms of the series of w and of the DC links (v_dc, i_reg,
    # i_source, mid), for the length of an interval; of the sources the values, the last term, and
    # their speeds, 1/s; of a converter alone on its grid, see `powers`, matrices by their keys,
    # with what else they were made for, the speed of the grid and the limit of the DC source, and
    # the voltage of the bridge by v_dc; and x, its products with the powers, and where it leads
    "terms": (complex, ("n_terms", "n_w")),
    "dc_terms": (float, ("n_terms", "n_converters", 4)),
    "slot_key": (int, ("n_slots",)),
    "slot_for": (float, ("n_slots", 2)),
    "slot_by_dc": (complex, ("n_slots",)),
    "power": (float, ("n_slots", POWERS, ORDER, ORDER)),
    "vector": (float, (POWERS + 1, ORDER)),
    # of `strides`, without and with a voltage, matrices by columns; what they were made for, the
    # equations and the speed of the grid, and what they were last wanted for, and how often
    "strides": (float, ("n_strides", COARSE + FINE, 9, 8)),
    "stride_for": (float, ("n_strides", 5)),
    "walked": (float, (27, EDGES + 8)),  # see `walk`
    "source": (complex, ("n_s",)),
    "source_term": (complex, ("n_s",)),
    "source_speed": (float, ("n_s",)),
    # behind a port: states and powers of the sources at the beginning of a unit; the sums that they
    # give; the moments of the bridge's voltage, in this unit and in an interval; and in an interval
    # the terms of that voltage and of what drives the line
    "port_x": (float, (2, "n_port_columns")),
    "port_y": (float, (2, "n_port_rows")),
    "port_moments": (float, (2, DRIVES)),
    "port_more": (float, (2, DRIVES)),
    "port_E": (float, (2, TERMS)),
    "port_g": (float, (2, LANES)),
    # of a large plant: the sources in the middle of a piece, and along it; the present term and the
    # next of states, sources and voltages; and the states in the middle and at the end of a piece
    "source_next": (complex, ("n_s",)),
    "s_now": (float, (2, "n_s")),
    "columns": (float, (2, 2, "n_columns")),
    "x_middle": (float, (2, 2, "n_w")),
    "x_end": (float, (2, 2, "n_w")),
    # of several contacts, the fault first and then the poles: which phases conduct, whether each of
    # them opens as soon as its current passes zero; and memory of `joint.make_joint`
    "conducts": (int, ("n_joint", 3)),
    "opens": (int, ("n_joint",)),
    "carried": (float, (2, "n_joint", 3)),  # by each phase at the beginning and at the end
    "bars": (float, ("n_q", "n_q")),
    "square": (float, (2, "n_q", "n_q")),
    "eigen": (float, (2, "n_q")),
    "solved": (complex, (2, "n_q", "n_q")),
}


def _header(scalars: list[tuple[Any, ...]], arrays: _Arrays) -> np.dtype[np.void]:
    """Scalars, and then the lengths of the arrays and the bytes at which they begin."""
    lengths = {name for _, shape in arrays.values() for name in shape if isinstance(name, str)}
    lengths -= {name for name, *_ in scalars}
    counts = [(name, "i8") for name in (*sorted(lengths), *(f"{name}_at" for name in arrays))]
    return np.dtype([*scalars, *counts], align=True)


_MOST_WORDS = 7 * 16  # of a tuple of so many arrays

net_dtype = _header(
    [
        ("omega_b", "f8"),  # rad/s
        ("T_s", "f8"),
        *((name, "i8") for name in WAYS),
        # the address of the records themselves, as a tuple of arrays, and that tuple
        ("records", "i8"),
        ("in_memory", "i8", (_MOST_WORDS,)),
        ("followers", "i8"),  # whether converters have set-points of plant controllers
        ("conversions", "i8"),  # of the A/D at the phases in a period
        ("sparse", "i8"),  # whether it is large: solved by `sparse`, and without modes
        ("joins", "i8"),  # a converter that is reset starts in the network as it is by then
        ("n_converters", "i8"),
        ("n_dynamic", "i8"),  # components with records
        # units of a switched bridge's carrier in a period, between two loads of compare values (0:
        # no bridge is switched); how many go into a period of the carrier; s of one
        ("n_units", "i8"),
        ("updates", "i8"),
        ("unit_s", "f8"),
        ("switched", "i8"),  # the only converter with a switched bridge in a network, -1: none
        # whether p, q and V of the connection points, and the charge of batteries, are recorded
        ("connections", "i8"),
        ("batteries", "i8"),
        # of recorded terminals, see `flows`: the place of the first of their nodes among those
        # whose voltage is looked at, and whether the currents of a fault are recorded, and there
        # may be one: 0, 1 or 2
        ("flow_first", "i8"),
        ("flow_fault", "i8"),
        ("n_states", "i8"),  # of w, without those at its end that the plant does not have
        ("contact_w", "i8"),  # place of the contact's own current, -1: it has none
        # of several contacts: how many states, breakers' ends; whether the fault opens at zeros
        ("reals", "i8"),
        ("poles", "i8"),
        ("at_zeros", "i8"),
        # of a synchro-check: the largest difference of voltage, p.u., speed, rad/s, and angle, rad;
        # for how long, s
        ("check_limits", "f8", (3,)),
        ("check_lasting", "f8"),
    ],
    _NET,
)
"""Of the parameters of a network.

Circuits come in groups, one for each of `Wiring.contacts`, the first of which is none: row 0 of a
group as the converters are, and row 1 + k with the bridge of converter k blocked besides. The last
circuit is made in the loop, for several contacts at a time. A large plant has that one first, and
then one circuit for each contact. Sources
are the bridges, then the positive and the negative sequence of the grid, then the voltages and the
currents of components; in an unbalanced circuit their mirror images follow in the same order. Such
a circuit has up to two modes a state.
"""

now_dtype = _header(
    [
        ("row", "i8"),  # in the group of circuits
        # of a large plant: whether a source is held at two values in a piece; e^(j omega_b t) at
        # its beginning, which unbalanced circuits need, and e^(-j omega_b h) of half of it
        ("held", "i8"),
        ("upright", "c16"),
        ("back", "c16"),
        ("order", "i8"),  # of the matrices of `powers`
        ("behind", "i8"),  # whether the network goes on behind a `port` in this unit
        # e^(j omega_b t) at the beginning of a period, and its tick
        ("frame_turn", "c16"),
        ("frame_tick", "i8"),
        # grid simulator: values now, where ramps lead, and p.u./s (inf: a step)
        ("closed", "i8"),
        ("omega_g", "f8"),
        ("omega_g_slope", "f8"),  # 1/s
        ("omega_g_to", "f8"),
        ("omega_g_rate", "f8"),
        ("V_g", "f8"),
        ("V_g_to", "f8"),
        ("V_g_rate", "f8"),
        ("sag_left", "f8"),  # s until a sag recovers (0: no sag)
        ("V_g_after", "f8"),  # voltage it recovers to
        # positive and negative sequence over V_g, and s until they are 1 and 0 again
        ("sequence", "c16", (2,)),
        ("unbalance_left", "f8"),
        ("contact", "i8"),  # place in `Wiring.contacts`
        ("fault_left", "f8"),  # s until the fault is cleared
        ("clearing", "i8"),  # whether each of its phases opens as soon as its current passes zero
        ("joint", "i8"),  # whether there is more than one contact, see `conducts`
        ("made", "i8"),  # whether the circuit of several contacts is that of the present ones
        # of a synchro-check: see `synchro_check.NONE`; the differences now, in the order of
        # `check_limits`, for how long they have been within, and the time that is left, s; ticks in
        # a row in which both sides were alive
        ("check", "i8"),
        ("check_looks", "i8"),
        ("check_seen", "f8", (3,)),
        ("check_lasted", "f8"),
        ("check_left", "f8"),
        ("connection", "f8", (3,)),  # p, q and V of a converter's connection point, p.u.
    ],
    _NOW,
)
"""Of the state of a network, values in p.u. and s."""


def make_net_and_now(
    converters: int,
    states: int,
    sources: int,
    parts: int,
    lags: int,
    connections: bool,
    units: int = 0,
    zeros: int = 0,
    breakers: int = 0,
    nodes: int = 0,
    entries: int = 0,
    flows: tuple[int, int, int, int] = (0, 0, 0, 0),
    ports: int = 0,
    commanded: int = 0,
) -> tuple[Record, Record]:
    """Return a network's parameters and state, shape (1,) each, zero but for lengths and places.

    Args:
        converters: how many.
        states: of the circuit, at most.
        sources: the bridges, two of the grid, and those of components.
        parts: stretches of the sampling period.
        lags: first-order lags, one of each converter's sensors included.
        connections: whether p, q and V of the converters' connection points are looked at.
        units: of a switched bridge's carrier in a period, 0: none is switched.
        zeros: states of a zero sequence among these, which have one axis.
        breakers: how many ends of lines may open at a time.
        nodes: between the parts.
        entries: of the sums of a large plant, see `sparse`; 0: it is solved by its modes.
        flows: recorded terminals, their nodes, and currents that these are sums of, at most, and
            columns of all.
        ports: rows of circuits with tables of a `port`.
        commanded: converters and neighbours that may have set-points of plant controllers.
    """
    modes, circuits = 2 * states - zeros, MOST_CONTACTS * (converters + 1) + 1
    if entries:
        modes, circuits = modes if states <= MOST_OF_SEVERAL else 0, MOST_CONTACTS + 1
    lengths = {
        "n_converters": converters, "n_w": states, "n_z": modes, "n_s": sources,
        "n_phasors": 2 * sources, "n_contacts": MOST_CONTACTS,
        "n_c": circuits, "n_m": 1 if entries else circuits,
        "n_parts": parts, "n_cuts": 2 * parts + 1,
        "n_lags": lags, "n_nodes": CHECK_SIDES + (converters if connections else 0) + flows[1],
        "n_flows": flows[0], "n_flow_nodes": flows[1], "n_flow_sums": flows[2],
        "n_flow_sources": sources if flows[0] else 0, "n_flow_columns": flows[3],
        "n_flow_ends": flows[0] + 1 if flows[0] else 0,
        "n_commanded": commanded,
        "n_units": units, "n_rates": circuits if units else 0,
        "n_q": modes, "n_poles": breakers if modes else 0, "n_joint": breakers + 1,
        "n_sparse": 2 * MOST_CONTACTS if entries else 0, "n_sum": entries,
        "n_columns": 4 * states + 2 * sources + 4 * (nodes + 4) if entries else 0,
        "n_entries": states * max(states, sources) if units else 0,
        "n_terms": TERMS if units else 0,
        "n_ports": ports,
        "n_port_rows": DRIVES + -(-(states + MOMENTS * converters) // 12) * 12 if ports else 0,
        "n_port_columns": states + SPEEDS * sources if ports else 0,
        "n_slots": SLOTS if units and converters == 1 else 0,
        "n_strides": 2 if units and converters == 1 else 0,
    }  # fmt: skip
    net, now = (_allocate(kind, tuple(lengths.items())) for kind in (net_dtype, now_dtype))
    net["connections"], net["sparse"] = connections, entries > 0
    net["flow_first"] = CHECK_SIDES + (converters if connections else 0)
    return net, now


def _allocate(header: np.dtype[np.void], lengths: tuple[tuple[str, int], ...]) -> Record:
    whole, numbers = _laid_out(header, lengths)
    memory = np.zeros(whole.itemsize + _LINE, np.uint8)
    first = -memory.ctypes.data % _LINE
    record: Record = np.ndarray(1, whole, memory, first)
    for name, value in numbers:
        record[name] = value
    return record


@lru_cache(maxsize=16)
def _laid_out(
    header: np.dtype[np.void], lengths: tuple[tuple[str, int], ...]
) -> tuple[np.dtype[np.void], list[tuple[str, int]]]:
    """The type of a record, and the lengths and places of its arrays; most plants of a campaign
    have the same."""
    fields, of = dict(header.fields or {}), dict(lengths)
    formats, offsets = [f[0] for f in fields.values()], [f[1] for f in fields.values()]
    places, end = dict[str, int](), header.itemsize
    arrays = _NET if header is net_dtype else _NOW
    for name, (kind, shape) in arrays.items():
        places[f"{name}_at"] = end = -(-end // _LINE) * _LINE
        formats.append(np.dtype((kind, tuple(of.get(str(n), n) for n in shape))))
        offsets.append(end)
        end += formats[-1].itemsize
    whole: Any = {
        "names": [*fields, *arrays], "formats": formats, "offsets": offsets, "itemsize": end
    }  # fmt: skip
    return np.dtype(whole), [(n, value) for n, value in (of | places).items() if n in fields]


def head(record: Record) -> Record:
    """The same memory as compiled functions see it, shape (1,): its scalars."""
    header = now_dtype if "w" in (record.dtype.names or ()) else net_dtype
    return np.ndarray(1, header, record)


@intrinsic
def field(typingctx: Any, record: Any, name: Any) -> Any:
    """Return the array of this name of ``net`` or ``now``, inside compiled functions."""
    if not isinstance(name, types.StringLiteral):  # numba tries the type without the value too
        return None
    kind, dims = {**_NET, **_NOW}[name.literal_value]
    array = types.Array(from_dtype(np.dtype(kind)), len(dims), "C")

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        base = builder.bitcast(arguments[0], ir.IntType(8).as_pointer())
        word = ir.IntType(64)

        def scalar(of: str) -> Any:
            at = builder.gep(base, [word(record.offset(of))])
            return builder.load(builder.bitcast(at, word.as_pointer()))

        shape = [scalar(n) if isinstance(n, str) else word(n) for n in dims]
        strides = [word(np.dtype(kind).itemsize)]
        for length in reversed(shape):
            strides.insert(0, builder.mul(strides[0], length))
        size = strides.pop(0)  # bytes of the whole
        made = context.make_array(array)(context, builder)
        data = builder.gep(base, [scalar(f"{name.literal_value}_at")])
        made.data = builder.bitcast(data, made.data.type)
        made.shape, made.strides = (cgutils.pack_array(builder, v) for v in (shape, strides))
        made.itemsize = word(np.dtype(kind).itemsize)
        made.nitems = builder.udiv(size, strides[-1])
        return made._getvalue()

    return array(record, name), make
