"""From options to records: computes once all constants that a tick needs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from gfm_plant.circuit import GROUND, Branch, Capacitor, Modes, Shunt, Source, find_modes
from gfm_plant.model import V_DC
from gfm_plant.names import TRIPS
from gfm_plant.options import COMMANDS, MEASURED, Overload, Plant, Protection
from gfm_plant.parameters import load_converter
from gfm_plant.records import (
    BLOCKED,
    FAULTED,
    N_RING,
    OPERATING,
    PlantRecord,
    plant_par_dtype,
    plant_state_dtype,
)
from gfm_plant.solution import BRIDGE, GRID, NEGATIVE, STATES

_DC_STEP = 0.1  # largest rate of the DC source's control times a step of the DC link's RK4
_SWING_STEP = 0.1  # largest rate of a finite grid times T_s
_PIECE = 0.5  # largest angle through which a mode turns in half a piece of Simpson's rule
_LOOK = 10e-6  # s; how often a peak-current limit looks at the current
_MOST = 500  # steps, or pieces, in a period


def make_plant(options: Plant, T_s: float) -> tuple[PlantRecord, PlantRecord]:
    """Return the parameter and the state record of the plant that `options` describe.

    The state is a de-energised converter on a closed grid breaker; `plant_init` puts it into an
    operating point.

    Args:
        options: The plant; see `gfm_plant.options`.
        T_s: Sampling period in s.

    Raises:
        ValueError: If the converter is unknown, or the DC source's control is too fast for T_s.
    """
    if not (math.isfinite(T_s) and T_s > 0):
        raise ValueError(f"T_s = {T_s}: must be finite and > 0 s")
    par = np.zeros(1, plant_par_dtype)
    par["fault_at"] = -1.0
    _pack_circuit(par, options)
    _pack_grid(par, options, T_s)
    _pack_measurement(par, options)
    _pack_timing(par, options, T_s)
    _pack_protection(par, options.protection, T_s)
    connect(par, closed=True)

    st = np.zeros(1, plant_state_dtype)
    st["x"][0, V_DC] = 1.0
    st["unit"][0, :, 0] = st["sequence"][0, 0, 0] = 1.0
    st["sensed"][0, 0] = 1.0
    st["u"][0, :, 1] = st["u_now"][0, 1] = options.grid.omega_g
    st["closed"] = 1
    st["omega_g"] = st["omega_g_to"] = options.grid.omega_g
    st["V_g"] = st["V_g_to"] = options.grid.V_g
    return par, st


def connect(par: PlantRecord, closed: bool) -> None:
    """Set the modes of all circuits, with the grid's breaker closed or open.

    Raises:
        ValueError: If the modes cannot be told apart (`gfm_plant.circuit`), or one is too fast for
            the DC link.
    """
    r = par[0]
    last = "i_g" if r["fault_at"] > 0 else "i_load" if r["L_load"] > 0 else "i_o"
    par["n_states"] = STATES.index(last) + 1
    faults = (0, FAULTED) if r["fault_at"] >= 0 else (0,)
    found = {c + f: _modes(r, closed, c, f) for c in (OPERATING, BLOCKED) for f in faults}
    _pack_pieces(par, max(np.abs(modes.rates.imag).max() for modes, _ in found.values()))
    for circuit, (modes, sources) in found.items():
        n = par["n_modes"][0, circuit] = len(modes.rates)
        _set(par["rate"][0, circuit, :n], modes.rates)
        for part, half in enumerate(par["half_h"][0]):
            _set(par["decay"][0, circuit, part, :n], np.exp(modes.rates * half))
        _set(par["states"][0, circuit, :, :n], modes.states)
        _set(par["modes"][0, circuit, :n], modes.modes)
        par["drive"][0, circuit] = 0.0
        for k, source in enumerate(sources):
            for place in (BRIDGE,) if source.name == "bridge" else (GRID, NEGATIVE):
                _set(par["drive"][0, circuit, :n, place], modes.drive[:, k])


def _modes(r: Any, closed: bool, bridge: int, fault: int) -> tuple[Modes, list[Source]]:
    """The modes of one of the circuits, and its sources."""
    at = r["fault_at"]
    branches, shunts, sources = [], [], []
    if at > 0:  # the line in two pieces
        branches.append(Branch("i_o", "terminal", "fault", at * r["L_g"], at * r["R_g"]))
        branches.append(Branch("i_g", "fault", "far", (1 - at) * r["L_g"], (1 - at) * r["R_g"]))
    else:
        branches.append(Branch("i_o", "terminal", "far", r["L_g"], r["R_g"]))
    if fault:
        shunts.append(Shunt("fault", "fault" if at > 0 else "terminal", r["fault_R"]))
    if bridge == OPERATING:
        branches.append(Branch("i_f", "bridge", "terminal", r["L_f"], r["R_f"]))
        sources.append(Source("bridge", "bridge"))
    if r["L_load"] > 0:
        branches.append(Branch("i_load", "far", GROUND, r["L_load"], r["R_load"]))
    if closed:
        sources.append(Source("grid", "far"))
    capacitor = Capacitor("v", "terminal", r["C_f"])
    modes = find_modes(branches, [capacitor], sources, r["omega_b"], STATES, shunts)
    return modes, sources


def _set(field: NDArray[np.float64], values: NDArray[np.complex128]) -> None:
    field[..., 0], field[..., 1] = values.real, values.imag


def _pack_circuit(par: PlantRecord, options: Plant) -> None:
    converter = load_converter(options.converter)
    bases = converter.bases
    par["omega_b"] = bases.omega_b
    for name, value in converter.pu(options.real_factors()).items():
        par[name] = value
    nominal = converter.pu()
    par["L_line_n"], par["R_line_n"] = nominal["L_g"], nominal["R_g"]
    if options.grid.load_R is not None and options.grid.load_L is not None:
        par["R_load"] = bases.to_pu(options.grid.load_R, "R")
        par["L_load"] = bases.to_pu(options.grid.load_L, "L")

    per_v_dc = {"unlimited": math.inf, "space-vector": 1 / math.sqrt(2), "sine": math.sqrt(3 / 8)}
    par["m_max"] = per_v_dc[options.modulation] * bases.V_dcref / bases.V_n

    par["i_peak"] = math.inf if options.i_peak is None else options.i_peak

    source = options.dc_source
    par["tau_dc"] = source.tau_s or 0.0
    par["i_max"] = math.inf if source.i_max is None else source.i_max
    if source.mode == "controlled":
        par["i_u_gain"] = 1.0
    else:
        par["k_p"], par["k_i"] = source.k_p, source.k_i


def _pack_grid(par: PlantRecord, options: Plant, T_s: float) -> None:
    grid = options.grid.finite
    if grid is None:
        return
    par["H_grid"], par["D_grid"], par["droop_grid"] = grid.H, grid.D, grid.droop
    par["T_gov"], par["S_grid"] = grid.T_gov, grid.S
    r = par[0]
    swing = math.sqrt(r["omega_b"] / (2 * grid.H * grid.S * (r["L_f"] + r["L_g"])))
    governor = math.sqrt(1 / (2 * grid.H * grid.droop * grid.T_gov))
    rate = max(swing, governor, grid.D / (2 * grid.H), 1 / grid.T_gov)
    if rate * T_s > _SWING_STEP:
        raise ValueError(
            f"plant.grid.finite: it swings at {rate:.6g} rad/s; allowed are"
            f" {_SWING_STEP / T_s:.6g} rad/s at this T_s; raise S, H, T_gov or droop"
        )


def _pack_measurement(par: PlantRecord, options: Plant) -> None:
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


def _pack_protection(par: PlantRecord, protection: Protection, T_s: float) -> None:
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
    par: PlantRecord,
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


def _pack_timing(par: PlantRecord, options: Plant, T_s: float) -> None:
    fraction = options.delay.fraction
    par["T_s"], par["delay"] = T_s, options.delay.samples
    par["stretch"] = [[fraction * T_s, (1 - fraction) * T_s]]


def _pack_pieces(par: PlantRecord, fastest: float) -> None:
    """Choose the pieces of Simpson's rule, and the DC link's steps in them, by the fastest mode."""
    r = par[0]
    longest = max(r["stretch"])
    if fastest * longest > 2 * _PIECE * _MOST:
        raise ValueError(
            f"the circuit's fastest mode = {fastest:.6g} rad/s: too fast for the DC link; allowed"
            f" are {2 * _PIECE * _MOST / longest:.6g} rad/s at this T_s; raise L_f, C_f, L_g or"
            " plant.grid.load_L"
        )
    least = 1.0
    if r["i_peak"] < math.inf:  # the hardware looks at the current once a piece
        least = math.ceil(longest / _LOOK)
    pieces = np.maximum(np.ceil(r["stretch"] * (fastest / (2 * _PIECE))), least)
    par["pieces"], par["half_h"] = pieces, r["stretch"] / pieces / 2
    per_C = r["omega_b"] / r["C_dc"]
    rate = max(per_C * r["k_p"], math.sqrt(per_C * r["k_i"]))
    if r["tau_dc"] > 0.0:
        rate = max(rate, 1 / r["tau_dc"], math.sqrt(per_C * r["k_p"] / r["tau_dc"]))
    if rate * longest > 2 * _DC_STEP * _MOST:
        raise ValueError(
            f"plant.dc_source k_p, k_i, tau_s: with C_dc they are as fast as {rate:.6g}"
            f" rad/s; allowed are {2 * _DC_STEP * _MOST / longest:.6g} rad/s at this T_s"
        )
    par["dc_steps"] = max(1, math.ceil(rate * max(par["half_h"][0]) / _DC_STEP))
    for part, half in enumerate(par["half_h"][0]):
        par["sensor_weights"][0, part] = _low_pass(float(r["omega_s"] * 2 * half))


def _low_pass(x: float) -> list[float]:
    """Weights of a first-order low-pass after a stretch of x time constants: of its state, and of
    its input at the beginning, the middle and the end, between which the input is a parabola."""
    A = np.diag([1.0, 1.0, 1.0], 1)
    A[0, 0] = -x
    whole, f_1, f_2, f_3 = expm(A)[0]  # f_k: integrals of e^(-x (1 - t)) t^(k - 1) / (k - 1)!
    return [whole, x * (f_1 - 3 * f_2 + 4 * f_3), x * (4 * f_2 - 8 * f_3), x * (4 * f_3 - f_2)]
