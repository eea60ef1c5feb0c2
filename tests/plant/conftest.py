"""A plant in equilibrium, the start of most tests of the plant."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from gfm_plant import (
    TRUTH,
    Network,
    Plant,
    make_plant,
    plant_advance,
    plant_equilibrium,
    plant_sample,
    plant_truth,
)


class Rest(NamedTuple):
    """A plant in the equilibrium x, u."""

    plant: Network
    x: NDArray[np.float64]
    u: NDArray[np.float64]

    @property
    def par(self) -> NDArray[np.void]:
        return self.plant.par

    @property
    def st(self) -> NDArray[np.void]:
        return self.plant.st

    @property
    def now(self) -> NDArray[np.void]:
        return self.plant.now

    def phasor(self, state: str) -> complex:
        """A current or voltage in the converter's own frame."""
        w = self.now["w"][0, self.plant.wiring.order.index(state)]
        return complex(w) / complex(self.now["unit"][0, 0])

    def near(self, i_u: float = 0.0, omega_u: float = 0.0, E_u: float = 0.0) -> NDArray[np.float64]:
        """Return the command of the equilibrium plus these offsets."""
        return self.u + np.array([i_u, omega_u, E_u])

    def advance(self, ticks: int = 1, u: NDArray[np.float64] | None = None) -> None:
        for _ in range(ticks):
            plant_advance(self.plant.records, self.u if u is None else u)

    def sample(self) -> NDArray[np.float64]:
        y = np.empty(5)
        plant_sample(self.plant.records, 0, y)
        return y

    def truth(self) -> dict[str, float]:
        out = np.empty(len(TRUTH))
        plant_truth(self.plant.records, 0, out)
        return dict(zip(TRUTH, out, strict=True))


@pytest.fixture
def rest() -> Callable[..., Rest]:
    """Return a factory: options of the plant as keywords, T_s in s, P and V in p.u."""

    def make(T_s: float = 1e-4, P: float = 0.5, V: float = 1.0, **options: Any) -> Rest:
        plant = make_plant(Plant.model_validate(options), T_s)
        now = plant.now[0]
        x, u = plant_equilibrium(plant.par, P, V, now["V_g"], now["omega_g"])
        plant.start(x, u)
        return Rest(plant, x, u)

    return make
