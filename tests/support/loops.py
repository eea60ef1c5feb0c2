"""An independent computation of the loop's matrix, from the emulator's record of its delay."""

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.linear import LinearLaw, LinearPlant, hold
from gfm_plant.records import Record
from gfm_runtime.signals import NU

Matrix = NDArray[np.float64]


def reference_loop(par: Record, plant: LinearPlant, law: LinearLaw) -> Matrix:
    """The loop's matrix from tick to tick; state: plant, law, u[k-1], u[k-2], ..."""
    r = par[0]
    old = r["fraction"] * r["T_s"]  # time for which u[k-delay-1] acts, then u[k-delay]
    new = r["T_s"] - old
    to_switch, by_old = hold(plant.A, plant.B, old)
    to_end, by_new = hold(plant.A, plant.B, new)
    delay, n, m = int(r["delay"]), len(plant.A), len(law.A)
    oldest = delay + (old > 0.0)
    size = n + m + NU * oldest
    lines = np.zeros((NU * (oldest + 1), size))  # u[k], u[k-1], ... as maps of the state
    lines[:NU, :n], lines[:NU, n : n + m] = law.D @ plant.C, law.C
    lines[NU:, n + m :] = np.eye(NU * oldest)
    out = np.zeros((size, size))
    out[:n, :n] = to_end @ to_switch
    out[:n] += by_new @ lines[NU * delay : NU * (delay + 1)]
    if old > 0.0:
        out[:n] += to_end @ by_old @ lines[NU * oldest :]
    out[n : n + m, :n], out[n : n + m, n : n + m] = law.B @ plant.C, law.A
    out[n + m :] = lines[: NU * oldest]
    return out
