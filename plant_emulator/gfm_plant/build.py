"""From options to records: computes once all constants that a tick needs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from gfm_plant.model import V_DC
from gfm_plant.names import TRIPS
from gfm_plant.options import COMMANDS, MEASURED, Plant
from gfm_plant.parameters import load_converter
from gfm_plant.records import PlantRecord, plant_par_dtype, plant_state_dtype

MAX_RATE = 1.0
"""Largest |eigenvalue| times sub-step. RK4 is stable to 2.8; at 1 a mode is still resolved."""


def make_plant(options: Plant, T_s: float) -> tuple[PlantRecord, PlantRecord]:
    """Return the parameter and the state record of the plant that `options` describe.

    The state is a de-energised converter on a closed grid breaker; `plant_init` puts it into an
    operating point.

    Args:
        options: The plant; see `gfm_plant.options`.
        T_s: Sampling period in s.

    Raises:
        ValueError: If the converter is unknown, or something is too fast for the sub-step.
    """
    if not (math.isfinite(T_s) and T_s > 0):
        raise ValueError(f"T_s = {T_s}: must be finite and > 0 s")
    par = np.zeros(1, plant_par_dtype)
    _pack_circuit(par, options)
    _pack_measurement(par, options)
    _pack_timing(par, options, T_s)
    for k, (name, *_) in enumerate(TRIPS):
        trip = getattr(options.protection, name)
        par["trip_limit"][0, k] = trip.threshold
        par["trip_ticks"][0, k] = math.ceil(trip.delay_s / T_s - 1e-6) if trip.enabled else -1
    check_sub_step(par)

    st = np.zeros(1, plant_state_dtype)
    st["x"][0, V_DC] = 1.0
    st["sensed"][0, 0] = 1.0
    st["u"][0, :, 1] = st["u_now"][0, 1] = options.grid.omega_g
    st["closed"] = 1
    st["omega_g"] = st["omega_g_to"] = options.grid.omega_g
    st["V_g"] = st["V_g_to"] = options.grid.V_g
    return par, st


def check_sub_step(par: PlantRecord) -> None:
    """Check that one RK4 sub-step resolves the fastest mode of every part of the plant.

    An open grid breaker only slows the line down, so the line alone is what counts.

    Raises:
        ValueError: If one is too fast; it names the option, its value and what is allowed.
    """
    r = par[0]
    limit = MAX_RATE / max(r["h_old"], r["h_new"])  # rad/s
    at = f"at this sub-step: allowed are {limit:.6g} rad/s; raise plant.substeps"
    if r["omega_s"] > limit:
        raise ValueError(
            f"plant.sensors.bandwidth_hz = {r['omega_s'] / (2 * math.pi):.6g}: too fast {at}"
            f" or stay below {limit / (2 * math.pi):.6g} Hz"
        )
    w = r["omega_b"]
    parts = {
        "LC resonance of L_f, C_f and L_g": w
        * math.sqrt((1 / r["L_f"] + 1 / r["L_line"]) / r["C_f"]),
        "filter R_f/L_f": w * r["R_f"] / r["L_f"],
        "line R_g/L_g": w * r["R_line"] / r["L_line"],
        "plant.grid load_R/load_L": w * r["R_load"] / r["L_load"] if r["L_load"] else 0.0,
        "plant.dc_source.k_p on C_dc": w * r["k_p"] / r["C_dc"],
    }
    for name, rate in parts.items():
        if rate > limit:
            raise ValueError(f"{name} = {rate:.6g} rad/s: too fast {at}")


def _pack_circuit(par: PlantRecord, options: Plant) -> None:
    converter = load_converter(options.converter)
    bases = converter.bases
    par["omega_b"] = bases.omega_b
    for name, value in converter.pu(options.real_factors()).items():
        par[name] = value
    par["L_line"], par["R_line"] = par["L_g"], par["R_g"]
    nominal = converter.pu()
    par["L_line_n"], par["R_line_n"] = nominal["L_g"], nominal["R_g"]
    if options.grid.load_R is not None and options.grid.load_L is not None:
        par["R_load"] = bases.to_pu(options.grid.load_R, "R")
        par["L_load"] = bases.to_pu(options.grid.load_L, "L")

    source = options.dc_source
    par["i_max"] = math.inf if source.i_max is None else source.i_max
    if source.mode == "controlled":
        par["i_u_gain"] = 1.0
    else:
        par["k_p"], par["k_i"] = source.k_p, source.k_i


def _pack_measurement(par: PlantRecord, options: Plant) -> None:
    sensors = options.sensors
    par["filtered"] = sensors.bandwidth_hz is not None
    par["omega_s"] = 2 * math.pi * (sensors.bandwidth_hz or 0.0)
    par["gain"] = [sensors.gain.get(name, 1.0) for name in MEASURED]
    par["offset"] = [sensors.offset.get(name, 0.0) for name in MEASURED]
    par["noise_std"] = [sensors.noise_std.get(name, 0.0) for name in MEASURED]
    par["seed"] = sensors.seed
    _pack_converter(par, "adc", options.adc.bits, options.adc.range, MEASURED)
    _pack_converter(par, "dac", options.dac.bits, options.dac.range, COMMANDS)


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
    n, fraction = options.substeps, options.delay.fraction
    par["T_s"], par["delay"] = T_s, options.delay.samples
    if fraction > 0:
        par["steps_old"] = steps = math.ceil(n * fraction)
        par["h_old"] = fraction * T_s / steps
    par["steps_new"] = steps = math.ceil(n * (1 - fraction))
    par["h_new"] = (1 - fraction) * T_s / steps
