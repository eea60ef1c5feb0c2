"""The stable region over the line: the loop's largest sigma over L_g and R_g."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gfm_design.case import Case
from gfm_design.tolerance import CEILING, FLOOR, radius

Matrix = NDArray[np.float64]

POINTS = 40


@dataclass(frozen=True)
class Region:
    """sigma[i, j] in 1/s at R_g[i] and L_g[j], factors of nominal; NaN: no operating point."""

    L_g: Matrix
    R_g: Matrix
    sigma: Matrix


def stable_region(
    case: Case, points: int = POINTS, progress: Callable[[int], None] = lambda done: None
) -> Region:
    """Map the region, ``points`` each way, evenly by ratio; ``progress`` is told the rows done."""
    factors = np.geomspace(FLOOR, CEILING, points)
    sigma = np.empty((points, points))
    for i, R_g in enumerate(factors):
        for j, L_g in enumerate(factors):
            found = radius(case, {"L_g": float(L_g), "R_g": float(R_g)})
            sigma[i, j] = np.log(found) / case.law.T_s if np.isfinite(found) else np.nan
        progress(i + 1)
    return Region(factors, factors, sigma)
