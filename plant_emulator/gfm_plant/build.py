"""From options to records: computes once all constants that a tick needs."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from gfm_plant.circuit import GROUND, Branch, Capacitor, Shunt, Sink
from gfm_plant.model import V_DC
from gfm_plant.names import TRIPS
from gfm_plant.network import Network
from gfm_plant.options import (
    COMMANDS,
    MEASURED,
    ConstantPowerLoad,
    FiniteGrid,
    Grid,
    Machine,
    NetworkParts,
    Overload,
    Plant,
    Protection,
)
from gfm_plant.parameters import ConverterParameters, load_converter
from gfm_plant.records import (
    N_OWN,
    N_RING,
    PlantRecords,
    Record,
    converter_par_dtype,
    converter_state_dtype,
    network_dtypes,
    size_for,
)
from gfm_plant.wiring import MAGNETISING, Unit, Wiring
from gfm_plant.wiring import Machine as MachineParts
from gfm_runtime.signals import SPACE_VECTOR

CONVERTER, FAR, LOAD = "converter", "far", "load"
"""Names in a plant of one converter: itself, the far end of its line, and the load there."""
CONNECTION, LINE = "connection", "line"
"""With a second inductor: the point of connection behind it, and the line from there."""

_LAG = 5.0  # shortest lag of a load of constant power, in sampling periods
_SWING_STEP = 0.1  # largest rate of a finite grid times T_s


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
    converter, parts, node = load_converter(options.converter), [], FAR
    if options.lcl is not None:
        line, node = converter.pu(options.real_factors()), CONNECTION
        parts.append(Branch(LINE, CONNECTION, FAR, line["L_g"], line["R_g"]))
    if options.grid.load_R is not None and options.grid.load_L is not None:
        bases = converter.bases
        L, R = bases.to_pu(options.grid.load_L, "L"), bases.to_pu(options.grid.load_R, "R")
        parts.append(Branch(LOAD, FAR, GROUND, L, R))
    plant = _make({CONVERTER: (options, node)}, T_s, options.grid, FAR, parts)
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
    names = [*converters, *parts.lines, *parts.loads, *parts.capacitors, *parts.machines]
    names += [*parts.constant_power, *parts.transformers]
    names += [f"{name}{MAGNETISING}" for name, x in parts.transformers.items() if x.X_m]
    if twice := sorted(name for name, count in Counter(names).items() if count > 1):
        raise ValueError(f"network: {twice[0]} is the name of two parts")
    branches = [Branch(name, x.start, x.end, x.L, x.R) for name, x in parts.lines.items()]
    for name, one in parts.transformers.items():
        branches.append(Branch(name, one.start, one.end, one.X / one.S, one.R / one.S))
        if one.X_m is not None:
            inductor = Branch(f"{name}{MAGNETISING}", one.start, GROUND, one.X_m / one.S, 0.0)
            branches.append(inductor)
    shunts = []
    for name, load in parts.loads.items():
        size = load.P**2 + load.Q**2
        if load.Q > 0:
            branches.append(Branch(name, load.node, GROUND, load.Q / size, load.P / size))
        else:
            shunts.append(Shunt(name, load.node, 1 / load.P))
    banks = tuple(Capacitor(name, x.node, x.Q) for name, x in parts.capacitors.items())
    opened = {name for name, line in parts.lines.items() if not line.closed}
    opened |= {name for name, one in parts.transformers.items() if not one.closed}
    opened |= {name for name, load in parts.loads.items() if not load.closed}
    opened |= {name for name, load in parts.constant_power.items() if not load.closed}
    network = _make(
        converters, T_s, grid, parts.grid, branches, tuple(shunts), banks,
        frozenset(opened), parts.machines, parts.constant_power,
        tuple((name, one.earthed) for name, one in parts.transformers.items()),
    )  # fmt: skip
    network.net["joins"] = 1
    return network


def _make(
    converters: Mapping[str, tuple[Plant, str]],
    T_s: float,
    grid: Grid,
    grid_node: str | None,
    branches: Sequence[Branch],
    shunts: Sequence[Shunt] = (),
    capacitors: Sequence[Capacitor] = (),
    opened: frozenset[str] = frozenset(),
    machines: Mapping[str, Machine] = MappingProxyType({}),
    constant_power: Mapping[str, ConstantPowerLoad] = MappingProxyType({}),
    transformers: tuple[tuple[str, str], ...] = (),
) -> Network:
    """Return a plant; elements in p.u. of the first converter."""
    if not (math.isfinite(T_s) and T_s > 0):
        raise ValueError(f"T_s = {T_s}: must be finite and > 0 s")
    N = len(converters)
    # two more for a fault within a branch
    states = N_OWN * N + len(branches) + len(capacitors) + len(machines) + 2
    net_dtype, now_dtype = network_dtypes(size_for(N, states, len(machines), len(constant_power)))
    records = PlantRecords(
        np.zeros(N, converter_par_dtype),
        np.zeros(N, converter_state_dtype),
        np.zeros(1, net_dtype),
        np.zeros(1, now_dtype),
    )
    par, st, net, now = records
    units = []
    first = load_converter(next(iter(converters.values()))[0].converter)
    for k, (name, (options, node)) in enumerate(converters.items()):
        one = par[k : k + 1]
        units.append(_pack_converter_circuit(one, name, node, options, first))
        _pack_measurement(one, options)
        one["T_s"], one["delay"] = T_s, options.delay.samples
        one["fraction"] = options.delay.fraction
        _pack_protection(one, options.protection, T_s)
    net["omega_b"], net["T_s"], net["n_converters"] = first.bases.omega_b, T_s, N
    _pack_timing(records)
    net["n_machines"], net["n_sinks"] = len(machines), len(constant_power)
    for j, (name, load) in enumerate(constant_power.items()):
        if load.tau_s < _LAG * T_s:
            raise ValueError(
                f"network.constant_power.{name}: tau_s = {load.tau_s:g}: must be >="
                f" {_LAG * T_s:g} s at this T_s"
            )
        net["S_sink"][0, j] = load.P, load.Q
        net["tau_sink"][0, j], net["least_v2"][0, j] = load.tau_s, load.V_least**2
    if grid.finite is not None and grid_node is not None:
        _pack_grid(records, units, grid.finite)
    for j, (name, machine) in enumerate(machines.items(), 1):
        _pack_swing(records, j, machine, machine.X / machine.S, f"network.machines.{name}")
        net["E"][0, j], now["P_set"][0, j] = machine.E, machine.P

    st["x"][:, V_DC] = 1.0
    now["unit"][0, :, 0] = now["sequence"][0, 0, 0] = 1.0
    st["sensed"][:, 0] = 1.0
    st["u"][:, :, 1] = st["u_now"][:, 1] = grid.omega_g
    now["closed"] = grid_node is not None
    now["omega_g"] = now["omega_g_to"] = grid.omega_g
    now["V_g"] = now["V_g_to"] = grid.V_g
    wiring = Wiring(
        first.bases.omega_b,
        tuple(units),
        tuple(branches),
        tuple(shunts),
        tuple(capacitors),
        tuple(Sink(name, load.node) for name, load in constant_power.items()),
        tuple(MachineParts(name, m.node, m.X / m.S, m.R / m.S) for name, m in machines.items()),
        grid_node,
        opened=opened,
        transformers=transformers,
    )
    _check_paths(wiring)
    network = Network(records, wiring)
    network.connect(wiring)
    return network


def _check_paths(wiring: Wiring) -> None:
    """Raise ValueError if a part has no path to a converter."""
    reached = {unit.node for unit in wiring.units}
    while True:
        more = {
            node
            for branch in wiring.branches
            if branch.end != GROUND and {branch.start, branch.end} & reached
            for node in (branch.start, branch.end)
        }
        if more <= reached:
            break
        reached |= more
    ends = [(unit.name, unit.node) for unit in wiring.units]
    ends += [(b.name, node) for b in wiring.branches for node in (b.start, b.end)]
    ends += [(shunt.name, shunt.node) for shunt in wiring.shunts]
    ends += [(capacitor.name, capacitor.node) for capacitor in wiring.capacitors]
    ends += [(sink.name, sink.node) for sink in wiring.sinks]
    ends += [(machine.name, machine.node) for machine in wiring.machines]
    ends += [] if wiring.grid is None else [("the grid", wiring.grid)]
    for name, node in ends:
        if node not in reached | {GROUND}:
            raise ValueError(
                f"network: {name} is at node {node!r}, which has no path to a converter; nodes with"
                f" one are {sorted(reached)}"
            )


def _pack_converter_circuit(
    par: Record, name: str, node: str, options: Plant, first: ConverterParameters
) -> Unit:
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
    if source.mode == "controlled":
        par["i_u_gain"] = 1.0
    else:
        par["k_p"], par["k_i"] = source.k_p, source.k_i
    return Unit(
        name, node,
        elements["L_f"] * ratio, elements["R_f"] * ratio, elements["C_f"] / ratio,
        elements["L_g"] * ratio, elements["R_g"] * ratio,
    )  # fmt: skip


def _pack_grid(records: PlantRecords, units: Sequence[Unit], grid: FiniteGrid) -> None:
    L = 1 / sum(1 / (unit.L_f + unit.L_g) for unit in units)
    _pack_swing(records, 0, grid, L, "plant.grid.finite")


def _pack_swing(
    records: PlantRecords, j: int, swings: FiniteGrid | Machine, L: float, where: str
) -> None:
    """Pack a swing equation; L is the reactance, p.u. of the network, against which it swings."""
    net, T_s = records.net, float(records.net[0]["T_s"])
    for name in ("H", "D", "droop", "T_gov", "S"):
        net[name][0, j] = getattr(swings, name)
    swing = math.sqrt(net[0]["omega_b"] / (2 * swings.H * swings.S * L))
    governor = math.sqrt(1 / (2 * swings.H * swings.droop * swings.T_gov))
    rate = max(swing, governor, swings.D / (2 * swings.H), 1 / swings.T_gov)
    if rate * T_s > _SWING_STEP:
        raise ValueError(
            f"{where}: it swings at {rate:.6g} rad/s; allowed are"
            f" {_SWING_STEP / T_s:.6g} rad/s at this T_s; raise S, H, T_gov or droop"
        )


def _pack_timing(records: PlantRecords) -> None:
    """Cut the period where a command begins to act."""
    par, net = records.par, records.net
    cuts = [0.0, *sorted({float(f) for f in par["fraction"]} - {0.0}), 1.0]
    parts = len(cuts) - 1
    net["n_parts"] = parts
    net["stretch"][0, :parts] = np.diff(cuts) * net[0]["T_s"]
    # a plant that is delayed as a whole goes on before the commands of the tick are in the line
    newest = par["delay"] - (1 if min(par["delay"]) > 0 else 0)
    for part, begin in enumerate(cuts[:-1]):
        net["age"][0, part, : len(par)] = newest + (begin < par["fraction"])


def _pack_measurement(par: Record, options: Plant) -> None:
    sensors = options.sensors
    par["filtered"] = sensors.bandwidth_hz is not None
    par["omega_s"] = 2 * math.pi * (sensors.bandwidth_hz or 0.0)
    par["gain"] = [sensors.gain.get(name, 1.0) for name in MEASURED]
    par["offset"] = [sensors.offset.get(name, 0.0) for name in MEASURED]
    par["noise_std"] = [sensors.noise_std.get(name, 0.0) for name in MEASURED]
    par["noisy"] = any(par["noise_std"][0] > 0.0)
    par["seed"] = sensors.seed
    _pack_converter(par, "adc", options.adc.bits, options.adc.range, MEASURED)
    _pack_converter(par, "dac", options.dac.bits, options.dac.range, COMMANDS)


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
