"""The measurements of the controller: the true quantities through sensors and A/D."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_plant.model import V_DC, terminal
from gfm_plant.noise import gaussian
from gfm_plant.quantise import quantise
from gfm_plant.records import PlantRecord
from gfm_runtime.compiled import compiled


@compiled
def plant_sample(par: PlantRecord, st: PlantRecord, y: NDArray[np.float64]) -> None:
    """Write the readings of the A/D at this tick to y (5,): (v_dc, p, omega_u, q, V) in p.u.

    omega_u is the command that acts at this instant, without error.
    """
    r, s = par[0], st[0]
    if r.filtered:
        v_dc, p, q, V = s.sensed[0], s.sensed[1], s.sensed[2], s.sensed[3]
    else:
        v_dc = s.x[V_DC]
        p, q, V = terminal(s.x[2], s.x[3], s.x[4], s.x[5])
    y[0] = _measure(r, s, 0, v_dc)
    y[1] = _measure(r, s, 1, p)
    y[2] = s.u_now[1]
    y[3] = _measure(r, s, 2, q)
    y[4] = _measure(r, s, 3, V)


@compiled
def _measure(r: Any, s: Any, j: int, value: float) -> float:
    """Return a quantity as channel j reads it."""
    value = r.gain[j] * value + r.offset[j]
    if r.noise_std[j] > 0.0:
        value += r.noise_std[j] * gaussian(r.seed, s.tick, j)
    return quantise(value, r.adc_lo[j], r.adc_hi[j], r.adc_lsb[j])
