"""A plant in equilibrium, the start of most tests of the plant."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from gfm_plant import (
    TRUTH,
    Plant,
    make_plant,
    plant_advance,
    plant_equilibrium,
    plant_init,
    plant_sample,
    plant_truth,
)


class Rest(NamedTuple):
    """A plant in the equilibrium x, u."""

    par: NDArray[np.void]
    st: NDArray[np.void]
    x: NDArray[np.float64]
    u: NDArray[np.float64]

    def near(self, i_u: float = 0.0, omega_u: float = 0.0, E_u: float = 0.0) -> NDArray[np.float64]:
        """Return the command of the equilibrium plus these offsets."""
        return self.u + np.array([i_u, omega_u, E_u])

    def advance(self, ticks: int = 1, u: NDArray[np.float64] | None = None) -> None:
        for _ in range(ticks):
            plant_advance(self.par, self.st, self.u if u is None else u)

    def sample(self) -> NDArray[np.float64]:
        y = np.empty(5)
        plant_sample(self.par, self.st, y)
        return y

    def truth(self) -> dict[str, float]:
        out = np.empty(len(TRUTH))
        plant_truth(self.par, self.st, out)
        return dict(zip(TRUTH, out, strict=True))


@pytest.fixture
def rest() -> Callable[..., Rest]:
    """Return a factory: options of the plant as keywords, T_s in s, P and V in p.u."""

    def make(T_s: float = 1e-4, P: float = 0.5, V: float = 1.0, **options: Any) -> Rest:
        par, st = make_plant(Plant.model_validate(options), T_s)
        x, u = plant_equilibrium(par, P, V, st[0]["V_g"], st[0]["omega_g"])
        plant_init(par, st, x, u)
        return Rest(par, st, x, u)

    return make
