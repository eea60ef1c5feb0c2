"""From options to records: computes once all constants that a tick needs."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from gfm_plant.bridge import TOPOLOGIES, bands
from gfm_plant.circuit import GROUND, Branch, Capacitor, Shunt
from gfm_plant.components import DYNAMIC, NetworkParts
from gfm_plant.components.finite_grid import FiniteGrid
from gfm_plant.components.grid_following import GridFollowing
from gfm_plant.components.line import Line
from gfm_plant.components.part import Component, Dynamic, Fed, Terminal
from gfm_plant.components.plant_controller import PlantController
from gfm_plant.components.saturation import Saturation
from gfm_plant.components.swing import pack_swing
from gfm_plant.layout import Record, make_net_and_now
from gfm_plant.model import V_DC
from gfm_plant.names import TRIPS
from gfm_plant.network import Network, connect_new
from gfm_plant.options import COMMANDS, MEASURED, Grid, Overload, Phases, Plant, Protection
from gfm_plant.parameters import ConverterParameters, load_converter
from gfm_plant.pv_array import diode
from gfm_plant.records import (
    ACROSS,
    BEHIND,
    COMPARE,
    N_RING,
    converter_par_dtype,
    converter_state_dtype,
)
from gfm_plant.sparse import entries_of
from gfm_plant.wiring import ConverterCircuit, Wiring
from gfm_runtime.signals import CHANNELS, COUNT_BITS, SPACE_VECTOR

CONVERTER, FAR, LOAD = "converter", "far", "load"
"""Names in a plant of one converter: itself, the far end of its line, and the load there."""
MOST_BY_MODES = 32
"""States of a circuit up to which it is solved by its modes, and beyond which by its series, unless
a bridge is switched: about where both take as long."""
_MOST_OF_A_PORT = 60
"""States of a circuit up to which one switched bridge beside averaged ones goes on by a `port`."""
CONNECTION, LINE = "connection", "line"
"""With a second inductor: the point of connection behind it, and the line from there."""


def make_plant(options: Plant, T_s: float) -> Network:
    """Return the plant that `options` describe: one converter on its line, load and grid.

    Its state is a de-energised converter on a closed grid breaker; `Network.start` puts it into an
    operating point.

    Args:
        options: The plant; see `gfm_plant.options`.
        T_s: Sampling period in s.

    Raises:
        ValueError: If the converter is unknown, or the DC source's control is too fast for T_s.
    """
    converter, branches, node = load_converter(options.converter), list[Branch](), FAR
    if options.lcl is not None:
        line, node = converter.pu(options.real_factors()), CONNECTION
        branches.append(Branch(LINE, CONNECTION, FAR, line["L_g"], line["R_g"]))
    if options.grid.load_R is not None and options.grid.load_L is not None:
        bases = converter.bases
        L, R = bases.to_pu(options.grid.load_L, "L"), bases.to_pu(options.grid.load_R, "R")
        branches.append(Branch(LOAD, FAR, GROUND, L, R))
    cores = _cores({CONVERTER: (options, node)})
    plant = _make({CONVERTER: (options, node)}, T_s, options.grid, FAR, cores, branches=branches)
    if options.lcl is not None:  # all that lies between capacitor and grid
        plant.par["L_g"] += line["L_g"]
        plant.par["R_g"] += line["R_g"]
    return plant


def make_network(
    converters: Mapping[str, tuple[Plant, str]], T_s: float, grid: Grid, parts: NetworkParts
) -> Network:
    """Return a plant of several converters, each with its line to a node of a network.

    Args:
        converters: By name, the options of each, of which `grid` is not used, and its node.
        T_s: Sampling period in s.
        grid: The grid simulator, p.u., if `parts` has a node for it.
        parts: What connects them.

    Raises:
        ValueError: If there are too many parts, two of one name, converters of different voltages
            or frequencies, a node without a path, or a rate that is too fast for T_s.
    """
    each = [*parts.components(), *_cores(converters)]
    elements = [element for _, name, one in each for element in one.elements(name)]
    names = [*converters, *(element.name for element in elements), *parts.plant_controllers]
    if twice := sorted(name for name, count in Counter(names).items() if count > 1):
        raise ValueError(f"network: {twice[0]} is the name of two parts")
    opened = frozenset(name for _, name, one in each if not getattr(one, "closed", True))
    recorded = parts.recorded({name: node for name, (_, node) in converters.items()})
    network = _make(converters, T_s, grid, parts.grid, each, opened, recorded=recorded)
    network.net["joins"] = 1
    return network


def _cores(converters: Mapping[str, tuple[Plant, str]]) -> list[tuple[str, str, Saturation]]:
    """Table, name and options of the cores of the converters' own transformers."""
    found, first = [], load_converter(next(iter(converters.values()))[0].converter).S_n
    for name, (options, _) in converters.items():
        if options.lcl is not None and (core := options.lcl.saturation) is not None:
            S = load_converter(options.converter).S_n / first
            terminal = ConverterCircuit.terminal_of(name)
            own = Saturation(node=terminal, S=S, knee=core.knee, X_air=core.X_air)
            found.append(("saturations", f"{name}.core", own))
    return found


def _make(
    converters: Mapping[str, tuple[Plant, str]],
    T_s: float,
    grid: Grid,
    grid_node: str | None,
    each: Sequence[tuple[str, str, Component]] = (),
    opened: frozenset[str] = frozenset(),
    branches: Sequence[Branch] = (),
    recorded: tuple[Terminal, ...] = (),
) -> Network:
    """Return a plant.

    Args:
        each: table, name and options of each component.
        opened: names of those whose breaker is open.
        branches: more of them, p.u. of the converter.
        recorded: where the run records currents and powers.
    """
    if not (math.isfinite(T_s) and T_s > 0):
        raise ValueError(f"T_s = {T_s}: must be finite and > 0 s")
    par = np.zeros(len(converters), converter_par_dtype)
    st = np.zeros(len(converters), converter_state_dtype)
    units = []
    measured = any(options.lcl is not None for options, _ in converters.values())
    first = load_converter(next(iter(converters.values()))[0].converter)
    for k, (name, (options, node)) in enumerate(converters.items()):
        where = "plant" if len(converters) == 1 else f"{name}: plant"
        units.append(_pack_unit(par[k : k + 1], name, node, options, first, T_s, where))
    passive = [p for _, n, x in each if not isinstance(x, Fed) for p in x.elements(n)]
    fed = sorted(
        ((name, one) for _, name, one in each if isinstance(one, Fed)),
        key=lambda item: not item[1].is_voltage,
    )
    supervisors = [(name, one) for _, name, one in each if isinstance(one, PlantController)]
    wiring = Wiring(
        first.bases.omega_b,
        tuple(units),
        (*branches, *(part for part in passive if isinstance(part, Branch))),
        tuple(part for part in passive if isinstance(part, Shunt)),
        _together(each, grid_node),
        tuple(fed),
        grid_node,
        opened=opened,
        recorded=recorded,
        supervisors=tuple(name for name, _ in supervisors),
    )
    _check_paths(wiring)
    dynamic = [(f"network.{table}", n, x) for table, n, x in each if isinstance(x, Dynamic)]
    if grid.finite is not None and grid_node is not None:
        dynamic.append(("plant.grid.finite", "", grid.finite))
    carriers, updates = _carrier(converters, T_s)
    if carriers:
        _check_beside(converters, carriers * updates)
    conversions = int(max(par["phase_samples"]))
    if (par["phase_samples"] != conversions).any():
        raise ValueError("phases.samples: must be the same for all converters of a network")
    large = not carriers and len(wiring.order) > MOST_BY_MODES
    entries = entries_of(wiring) if large else 0
    switched = np.flatnonzero(par["levels"])
    port = len(switched) == 1 < len(par) and len(wiring.order) <= _MOST_OF_A_PORT
    port = port and not par["filtered"][par["levels"] == 0].any()
    network = _network(par, st, wiring, T_s, dynamic, measured, carriers * updates, entries, port)
    network.net["updates"], network.net["switched"] = updates, switched[0] if port else -1
    network.net["batteries"] = par["energy"].any()
    now = network.now
    st["x"][:, V_DC] = st["sensed"][:, 0] = 1.0
    now["unit"] = now["sequence"][:, 0] = 1.0
    st["u"][:, :, COMPARE:] = st["u_now"][:, COMPARE:] = -1.0
    st["phase_seen"] = st["phase_sums"] = math.nan
    network.net["conversions"] = conversions
    _number_followers(network, supervisors)
    st["u"][:, :, 1] = st["u_now"][:, 1] = grid.omega_g
    now["closed"], now["frame_tick"] = grid_node is not None, -1
    now["omega_g"] = now["omega_g_to"] = grid.omega_g
    now["V_g"] = now["V_g_to"] = grid.V_g
    connect_new(network, wiring)
    return network


def make_part(whole: Network, units: Sequence[int], wiring: Wiring) -> Network:
    """Return a plant of some converters of another one, in memory of its own and not connected yet.

    Args:
        whole: without switched bridges.
        units: which of its converters.
        wiring: what of its wiring belongs to them.
    """
    par, st, net = whole.par[units], whole.st[units], whole.net[0]
    entries = entries_of(wiring) if len(wiring.order) > MOST_BY_MODES else 0
    fed = [("network", name, one) for name, one in wiring.fed]
    part = _network(
        par, st, wiring, float(net["T_s"]), fed, bool(net["connections"]), 0, entries, False
    )
    if wiring.grid is not None and len(finite := whole.of(FiniteGrid)):
        k = DYNAMIC.index(FiniteGrid)
        part.parts = (*part.parts[:k], finite.copy(), *part.parts[k + 1 :])
        part.net["n_dynamic"] += 1
    for name in ("joins", "updates", "switched", "batteries", "conversions"):
        part.net[name] = net[name]
    part.now["unit"] = part.now["sequence"][:, 0] = 1.0
    part.at_least = whole.fastest
    return part


def _together(
    each: Sequence[tuple[str, str, Component]], grid_node: str | None
) -> tuple[Capacitor, ...]:
    """One capacitor for all at a node, with the name of the first; the charging of lines at the
    node of the grid changes nothing there."""
    found: dict[str, Capacitor] = {}
    for _, name, part in each:
        for one in part.elements(name):
            if isinstance(one, Capacitor) and not (
                isinstance(part, Line) and one.node == grid_node
            ):
                before = found.get(one.node)
                found[one.node] = one if before is None else replace(before, C=before.C + one.C)
    return tuple(found.values())


def _number_followers(network: Network, supervisors: Sequence[tuple[str, PlantController]]) -> None:
    """Say of each converter and neighbour which plant controller commands it."""
    supervisor, N = network.net["supervisor"][0], len(network.par)
    for number, (name, controller) in enumerate(supervisors, 1):
        controller.supervise(name, number, network.wiring, supervisor)
    network.net["followers"] = supervisor[:N].any()
    follow = np.flatnonzero(supervisor[N:])
    network.of(GridFollowing)["follower"][follow] = N + follow


def _network(
    par: Record,
    st: Record,
    wiring: Wiring,
    T_s: float,
    dynamic: Sequence[tuple[str, str, Dynamic]],
    measured: bool,
    units_of_carrier: int,
    entries: int,
    port: bool,
) -> Network:
    """Return a plant whose circuits are still to be made.

    Args:
        dynamic: table, name and options of each component with a record.
        measured: whether p, q and V of the connection points are looked at.
        units_of_carrier: see ``net_dtype``.
        entries: of the sums of a large plant, 0: it is solved by its modes.
        port: whether units of the carrier may go on behind a `gfm_plant.port`.
    """
    cuts = [0.0, *sorted({float(f) for f in par["fraction"]} - {0.0}), 1.0]
    places = wiring.sources()
    lags = [name for _, name, one in dynamic if one.lag() is not None]
    carry_zero = len(wiring.units) + len(wiring.branches) + 2  # with a split line and a fault's own
    net, now = make_net_and_now(
        len(par),
        len(wiring.order) + 2 + carry_zero,
        len(places) + 1,
        len(cuts) - 1,
        len(par) + len(lags),
        measured,
        units_of_carrier,
        carry_zero,
        len(wiring.breakers()) + 2,  # the grid's, and the second end of a line with a fault inside
        len(wiring.nodes),
        entries,
        (
            sum(1 for one in wiring.recorded if one.node),
            len(wiring.recorded_nodes),
            sum(len(one.parts) or len(wiring.order) for one in wiring.recorded),
            sum(len(one.columns) for one in wiring.recorded),
        ),
        len(par) + 1 if port else 0,
        len(par) + len(wiring.neighbours) if wiring.supervisors else 0,
    )  # two states more for a fault within a branch
    net["omega_b"], net["T_s"] = wiring.omega_b, T_s
    _pack_timing(par, net, cuts)
    if units_of_carrier:
        _pack_units(net, cuts)
    parts = []
    for kind in DYNAMIC:
        those = [item for item in dynamic if isinstance(item[2], kind)]
        parts.append(records := np.zeros(len(those), kind.record))
        for k, (record, (table, name, one)) in enumerate(zip(records, those, strict=True)):
            where = f"{table}.{name}" if name else table
            if isinstance(one, FiniteGrid):
                X = 1 / sum(1 / (unit.L_f + unit.L_g) for unit in wiring.units)
                pack_swing(one, record, X, where, T_s, wiring.omega_b)
                continue
            one.pack(record, where, T_s, wiring.omega_b)
            if name in lags:
                record["lag"] = len(par) + lags.index(name)
            if isinstance(one, Fed):
                record["source"] = places[one.sources(name)[0]]
            elif isinstance(one, PlantController):
                one.place(name, record, wiring)
                record["number"] = k + 1
    net["n_dynamic"] = len(dynamic)
    return Network(par, st, net, now, tuple(parts), wiring)


def _check_paths(wiring: Wiring) -> None:
    """Raise ValueError if a part has no path to a converter."""
    terminals = {unit.terminal for unit in wiring.units}
    reached = {unit.node for unit in wiring.units}
    while True:
        lines = [(b.start, b.end) for b in wiring.branches if b.end != GROUND]
        more = {node for ends in [*lines, *wiring.by_waves] if {*ends} & reached for node in ends}
        if more <= reached:
            break
        reached |= more
    ends = [(unit.name, unit.node) for unit in wiring.units]
    ends += [(b.name, node) for b in wiring.branches for node in (b.start, b.end)]
    ends += [(shunt.name, shunt.node) for shunt in wiring.shunts]
    ends += [(capacitor.name, capacitor.node) for capacitor in wiring.capacitors]
    ends += [(name, node) for name, one in wiring.fed for node in one.nodes]
    ends += [] if wiring.grid is None else [("the grid", wiring.grid)]
    for name, node in ends:
        if node not in reached | terminals | {GROUND}:
            raise ValueError(
                f"network: {name} is at node {node!r}, which has no path to a converter; nodes with"
                f" one are {sorted(reached)}"
            )


def _pack_unit(
    one: Record,
    name: str,
    node: str,
    options: Plant,
    first: ConverterParameters,
    T_s: float,
    where: str,
) -> ConverterCircuit:
    """Set what belongs to one converter alone, whose options the messages name ``where``; returns
    its circuit."""
    unit = _pack_converter_circuit(one, name, node, options, first)
    _pack_measurement(one, options, T_s)
    one["T_s"], one["delay"], one["fraction"] = T_s, options.delay.samples, options.delay.fraction
    _pack_protection(one, options.protection, T_s)
    _pack_bridge(one, where, options, T_s)
    return unit


def _pack_converter_circuit(
    par: Record, name: str, node: str, options: Plant, first: ConverterParameters
) -> ConverterCircuit:
    """Pack the elements of a converter, and return them in p.u. of the first one."""
    converter = load_converter(options.converter)
    for what in ("omega_n", "V_n"):
        if getattr(converter, what) != getattr(first, what):
            raise ValueError(
                f"{name}: {what} = {getattr(converter, what):g}: must be that of the first"
                f" converter, {getattr(first, what):g}"
            )
    bases = converter.bases
    par["omega_b"] = bases.omega_b
    elements = converter.pu(options.real_factors())
    if options.lcl is not None:
        elements["L_g"], elements["R_g"] = options.lcl.L, options.lcl.R
    for element, value in elements.items():
        par[element] = value
    nominal = converter.pu()
    par["L_line_n"], par["R_line_n"] = nominal["L_g"], nominal["R_g"]
    ratio = first.S_n / converter.S_n
    par["current"] = ratio

    per_v_dc = {"unlimited": math.inf, "space-vector": SPACE_VECTOR, "sine": math.sqrt(3 / 8)}
    par["m_max"] = per_v_dc[options.modulation] * bases.V_dcref / bases.V_n
    par["i_peak"] = math.inf if options.i_peak is None else options.i_peak

    source = options.dc_source
    par["tau_dc"] = source.tau_s or 0.0
    par["i_max"] = math.inf if source.i_max is None else source.i_max
    if (battery := source.battery) is not None:
        par["energy"], par["R_battery"] = battery.energy_s, battery.R
        par["soc"] = battery.soc, battery.soc_min, battery.soc_max
        par["P_most"] = battery.P_discharge, battery.P_charge
    if (chopper := source.chopper) is not None:
        par["chopper"] = chopper.P, chopper.v_on, chopper.v_off
    if (pv := source.pv) is not None:
        par["I_0"], par["v_T"] = diode(pv.V_oc, pv.I_sc, pv.V_mp, pv.I_mp)
        par["I_sc"], par["irradiance"] = pv.I_sc, pv.irradiance
        par["array"] = ACROSS if source.mode == "array" else BEHIND
    if source.mode == "controlled":
        par["i_u_gain"] = 1.0
    elif source.mode == "regulated":
        par["k_p"], par["k_i"] = source.k_p, source.k_i
    return ConverterCircuit(
        name, node,
        elements["L_f"] * ratio, elements["R_f"] * ratio, elements["C_f"] / ratio,
        elements["L_g"] * ratio, elements["R_g"] * ratio,
        "end" if options.lcl is not None and options.lcl.earthed else "",
        at_end=options.lcl is not None,
    )  # fmt: skip


def _pack_timing(par: Record, net: Record, cuts: Sequence[float]) -> None:
    """Cut the period where a command begins to act."""
    net["stretch"] = np.diff(cuts) * net[0]["T_s"]
    # a plant that is delayed as a whole goes on before the commands of the tick are in the line
    newest = par["delay"] - (1 if min(par["delay"]) > 0 else 0)
    for part, begin in enumerate(cuts[:-1]):
        net["age"][0, part] = newest + (begin < par["fraction"])


_LEAST_COUNTS = 50
"""Of a timer in half a period of the carrier: a count is then 2 % of v_dc."""


def _pack_bridge(par: Record, where: str, options: Plant, T_s: float) -> None:
    """Pack a switched bridge, if it is one. Raises ValueError: its times or its timer do not
    fit."""
    bridge, where = options.bridge, f"{where}.bridge"
    bases = load_converter(options.converter).bases
    par["leg"] = math.sqrt(2 / 3) * bases.V_dcref / bases.V_n
    carriers = 1.0 if bridge.carrier_hz is None else bridge.carrier_hz * T_s
    par["counts"] = max(1, round(bridge.timer_hz * T_s / max(1, round(carriers)) / 2))
    if bridge.kind == "average":
        return
    if par[0]["array"] == ACROSS:
        raise ValueError(
            f"{where}.kind = {bridge.kind!r}: a PV array straight across C_dc (dc_source.mode ="
            " 'array') needs an averaged bridge"
        )
    if min(abs(carriers - 1), abs(carriers - 2)) > 1e-9:
        raise ValueError(
            f"{where}.carrier_hz = {bridge.carrier_hz:g}: must be {1 / T_s:g} or {2 / T_s:g} Hz, so"
            " that a tick samples where the ripple passes zero"
        )
    period = T_s / round(carriers)
    counts = bridge.timer_hz * period / 2
    if abs(counts - round(counts)) > 1e-6 * counts:
        raise ValueError(
            f"{where}.timer_hz = {bridge.timer_hz:g}: must be a multiple of {2 / period:g} Hz, so"
            " that half a period of the carrier is a whole number of counts"
        )
    if counts < _LEAST_COUNTS:
        raise ValueError(
            f"{where}.timer_hz = {bridge.timer_hz:g}: too coarse, {counts:g} counts in half a"
            f" period of the carrier; must be at least {_LEAST_COUNTS * 2 / period:g} Hz"
        )
    for name, most in (("dead_time_s", period / 2), ("min_pulse_s", period)):
        if not (value := getattr(bridge, name)) < most:
            raise ValueError(
                f"{where}.{name} = {value:g}: must be less than {most:g} s,"
                f" {'half a' if name == 'dead_time_s' else 'a'} period of the carrier"
            )
    topology = TOPOLOGIES[bridge.kind]
    par["levels"], par["off"] = topology.levels, topology.off
    par["counts"], par["count_s"] = round(counts), 1 / bridge.timer_hz
    par["dead"] = bridge.dead_time_s
    par["least"] = round(bridge.min_pulse_s / 2 * bridge.timer_hz)
    V, R = bases.V_dcref, bases.base_of("R")
    drops = bridge.V_switch / V, bridge.V_diode / V, bridge.R_switch / R, bridge.R_diode / R
    par["band"] = found = bands(bridge.kind, drops)
    par["wide"] = [bool((out != into).any()) for out, into in found]
    kinds = np.unique(found.reshape(-1, 4), axis=0, return_inverse=True)[1]
    par["band_kind"] = kinds.reshape(1, -1, 2)
    par["cancels"] = not any(drops)


def _carrier(converters: Mapping[str, tuple[Plant, str]], T_s: float) -> tuple[int, int]:
    """Return the periods of the carrier in T_s, 0 if no bridge is switched, and how often compare
    values are loaded in one. Raises ValueError: the bridges differ."""
    found = {
        (round((b.carrier_hz or 1 / T_s) * T_s), b.updates)
        for b in (options.bridge for options, _ in converters.values())
        if b.kind != "average"
    }
    if len(found) > 1:
        raise ValueError(
            "bridge: all switched bridges of a network must have one carrier_hz and one updates"
        )
    return found.pop() if found else (0, 1)


def _check_beside(converters: Mapping[str, tuple[Plant, str]], units: int) -> None:
    """Raise ValueError if the commands of a converter, averaged ones included, do not begin with a
    unit of the carrier, or an averaged bridge has what it cannot have beside a switched one."""
    for name, (options, _) in converters.items():
        plant = "plant" if len(converters) == 1 else f"{name}: plant"
        fraction = options.delay.fraction
        if abs(fraction * units - round(fraction * units)) > 1e-9:
            raise ValueError(
                f"{plant}.delay.fraction = {fraction:g}: compare values are loaded"
                f" {units} times a period, so it must be a multiple of {1 / units:g}"
            )
        if options.bridge.kind == "average" and options.i_peak is not None:
            raise ValueError(
                f"{plant}.i_peak = {options.i_peak:g}: an averaged bridge beside a switched one has"
                " no such limit; leave it out, or give it a bridge.kind of 'two-level' or 't-type'"
            )


def _pack_units(net: Record, cuts: Sequence[float]) -> None:
    """Say which command acts in each unit of the carrier."""
    units = int(net["n_units"][0])
    net["unit_s"] = net["T_s"] / units
    begins = np.arange(units) / units
    net["unit_part"] = np.searchsorted(cuts, begins + 1e-9, "right") - 1


def _pack_measurement(par: Record, options: Plant, T_s: float) -> None:
    sensors = options.sensors
    par["filtered"] = sensors.bandwidth_hz is not None
    par["omega_s"] = 2 * math.pi * (sensors.bandwidth_hz or 0.0)
    par["gain"] = [sensors.gain.get(name, 1.0) for name in MEASURED]
    par["offset"] = [sensors.offset.get(name, 0.0) for name in MEASURED]
    par["noise_std"] = [sensors.noise_std.get(name, 0.0) for name in MEASURED]
    par["noisy"] = any(par["noise_std"][0] > 0.0)
    par["seed"] = sensors.seed
    _pack_phases(par, options.phases, T_s)
    _pack_converter(par, "adc", options.adc.bits, options.adc.range, MEASURED)
    _pack_converter(par, "dac", options.dac.bits, options.dac.range, COMMANDS)


def _pack_phases(par: Record, phases: Phases, T_s: float) -> None:
    for name, values, default in (
        ("gain", phases.gain, 1.0), ("offset", phases.offset, 0.0),
        ("noise", phases.noise_std, 0.0), ("skew", phases.skew_s, 0.0),
    ):  # fmt: skip
        par[f"phase_{name}"] = [values.get(channel, default) for channel in CHANNELS]
    par["skewed"] = (par["phase_skew"] != 0).any()
    ends = [phases.ends(channel) for channel in CHANNELS]
    par["phase_lo"] = [low for low, _ in ends]
    par["phase_per_lsb"] = [2**phases.bits / (high - low) for low, high in ends]
    par["phase_top"] = 2**phases.bits - 1
    par["phase_samples"], par["phase_weights"] = phases.samples, (0.0, 0.0, 1.0)
    if phases.samples << phases.bits > 1 << COUNT_BITS:
        raise ValueError(
            f"plant.phases.samples = {phases.samples}: their sum must fit {COUNT_BITS} bits, so "
            f"with bits = {phases.bits} at most {1 << COUNT_BITS - phases.bits}"
        )
    if phases.bandwidth_hz is not None:
        x = 2 * math.pi * phases.bandwidth_hz * T_s / phases.samples
        mean = -math.expm1(-x) / x
        par["phase_weights"] = math.exp(-x), mean - math.exp(-x), 1.0 - mean
    for name, skew in phases.skew_s.items():
        if not skew < T_s:
            raise ValueError(
                f"plant.phases.skew_s.{name} = {skew:g}: must be less than {T_s:g} s, a period"
            )


def _pack_protection(par: Record, protection: Protection, T_s: float) -> None:
    par["trip_ticks"] = -1
    trips = [getattr(protection, name) for name, *_ in TRIPS]
    for k, trip in enumerate([*trips, *protection.overload]):
        par["trip_limit"][0, k] = trip.threshold
        if isinstance(trip, Overload) or trip.enabled:
            par["trip_ticks"][0, k] = math.ceil(trip.delay_s / T_s - 1e-6)
    par["by_voltage"] = protection.frequency == "voltage"
    if protection.overload or protection.frequency == "voltage":
        cycle = 2 * math.pi / (par[0]["omega_b"] * T_s)  # ticks
        par["place_ticks"] = math.ceil(cycle / N_RING)
        par["places"] = max(1, round(cycle / par[0]["place_ticks"]))


def _pack_converter(
    par: Record,
    prefix: str,
    bits: int | None,
    ranges: Mapping[Any, tuple[float, float]],
    channels: Iterable[str],
) -> None:
    for j, name in enumerate(channels):
        lo, hi = ranges.get(name, (-math.inf, math.inf))
        lsb = (hi - lo) / 2**bits if bits and name in ranges else 0.0
        par[f"{prefix}_lo"][0, j] = lo
        par[f"{prefix}_hi"][0, j] = hi - lsb  # the highest code is one step below full scale
        par[f"{prefix}_lsb"][0, j] = lsb
