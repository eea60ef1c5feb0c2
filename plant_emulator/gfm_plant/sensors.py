"""The measurements of the controller: the true quantities through sensors and A/D."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_plant.layout import field
from gfm_plant.model import V_DC, terminal
from gfm_plant.noise import gaussians
from gfm_plant.phases import read_phases
from gfm_plant.quantise import quantise
from gfm_plant.records import PlantRecords
from gfm_runtime.by_address import call_at
from gfm_runtime.compiled import inlined
from gfm_runtime.signals import N_SET, NY, NY_INNER


@inlined
def plant_set_points(plant: PlantRecords, k: int, y: NDArray[np.float64]) -> None:
    """Write the set-points of converter k's plant controller to the end of y, if the network has
    one: (P_set, Q_set, V_set), p.u. of the converter, NaN where it sends none."""
    if plant.net[0].followers > 0:
        points = field(plant.now[0], "set_points")
        for j in range(N_SET):
            y[len(y) - N_SET + j] = points[k, j]


@inlined
def plant_sample(plant: PlantRecords, k: int, y: NDArray[np.float64]) -> None:
    """Write the readings of converter k's A/D at this tick to y (5,): (v_dc, p, omega_u, q, V) in
    p.u. of the converter.

    omega_u is the command that acts at this instant, without error. A y of (11,) gets the currents
    and voltages of an inner stage besides, (i_d, i_q, v_d, v_q, i_od, i_oq), which pass no filter;
    one of (21,) the counts of the A/D at the phases too.
    """
    call_at(plant.net[0].sample, plant.net[0].records, k, len(y))
    s = plant.st[k]
    for j in range(min(len(y), NY_INNER)):
        y[j] = s.reads[j]
    for j in range(NY_INNER, len(y)):
        y[j] = s.phase_sums[j - NY_INNER]


@inlined
def read_sensors(plant: PlantRecords, k: int, size: int) -> None:
    """``plant_sample`` for a y of (size,), into ``reads`` and ``phase_sums``."""
    r, s = plant.par[k], plant.st[k]
    if r.filtered:
        v_dc, p, q, V = s.sensed[0], s.sensed[1], s.sensed[2], s.sensed[3]
    else:
        v_dc = s.x[V_DC]
        p, q, V = terminal(s.x[2], s.x[3], s.x[4], s.x[5])
    n_0 = n_1 = n_2 = n_3 = 0.0
    if r.noisy:
        n_0, n_1 = gaussians(r.seed, s.tick, 0)
        n_2, n_3 = gaussians(r.seed, s.tick, 1)
    s.reads[0] = _measure(r, 0, v_dc, n_0)
    s.reads[1] = _measure(r, 1, p, n_1)
    s.reads[2] = s.u_now[1]
    s.reads[3] = _measure(r, 2, q, n_2)
    s.reads[4] = _measure(r, 3, V, n_3)
    if size > NY:
        for j in range(0, 6, 2):
            n_0 = n_1 = 0.0
            if r.noisy:
                n_0, n_1 = gaussians(r.seed, s.tick, 2 + j // 2)
            s.reads[NY + j] = _measure(r, 4 + j, s.x[j], n_0)
            s.reads[NY + j + 1] = _measure(r, 5 + j, s.x[j + 1], n_1)
    if size > NY_INNER:
        read_phases(plant, k)


@inlined
def _measure(r: Any, j: int, value: float, noise: float) -> float:
    """Return a quantity as channel j reads it; ``noise`` is a sample of N(0, 1)."""
    value = r.gain[j] * value + r.offset[j] + r.noise_std[j] * noise
    return quantise(value, r.adc_lo[j], r.adc_hi[j], r.adc_lsb[j])
