"""The source of static exciters that the voltage and the current of the terminals feed (ST3A and
ST4B of IEEE Std 421.5):

    V_B = min(V_E F(K_C I_fd / V_E), V_Bmax),    K_Pp = K_P e^(j theta_P),
    V_E = |K_Pp v + j (K_I + K_Pp X_L) i|.

F is what a rectifier of six pulses keeps of its voltage under the field's current: 1 - 0.577 I up
to I = 0.433, sqrt(0.75 - I^2) up to 0.75, 1.732 (1 - I) up to 1, and 0 beyond.
"""

import math
from collections.abc import Sequence
from typing import Any, Self

from pydantic import Field, model_validator

from gfm_plant.components.controls.control import Exciter, Terminals
from gfm_plant.parameters import NonNegative, Positive
from gfm_runtime.compiled import compiled

_LEAST = 1e-6  # p.u.; of V_E, by which the field's current is divided


@compiled
def rectified(p: Any, at: int, seen: Terminals) -> float:
    """Return V_B; the numbers of its source are p from ``at`` on."""
    K_P, K_I, X_L, K_C, V_Bmax = (
        complex(p[at], p[at + 1]),
        p[at + 2],
        p[at + 3],
        p[at + 4],
        p[at + 5],
    )
    feeds = K_P * seen.v + 1j * (K_I + K_P * X_L) * seen.i
    V_E = math.sqrt(feeds.real * feeds.real + feeds.imag * feeds.imag)
    load = K_C * seen.I_fd / max(V_E, _LEAST)
    if load <= 0.433:
        keeps = min(1.0 - 0.577 * load, 1.0)
    elif load < 0.75:
        keeps = math.sqrt(0.75 - load * load)
    else:
        keeps = max(1.732 * (1.0 - load), 0.0)
    V_B: float = min(V_E * keeps, V_Bmax)
    return V_B


class CompoundExciter(Exciter):
    """One with such a source. The defaults are those of IEEE's case of 14 buses (ANDES,
    ieee14.dyr)."""

    K_P: NonNegative = Field(3.67, description="what the voltage gives to the rectifier")
    K_I: NonNegative = Field(0.435, description="what the current gives to it")
    V_Bmax: Positive = Field(5.48, description="largest voltage behind the rectifier, p.u.")
    K_C: NonNegative = Field(0.01, description="how the field's current loads the rectifier")
    X_L: NonNegative = Field(0.0098, description="reactance of the source of voltage, p.u.")
    theta_P: float = Field(3.33, ge=-180.0, le=180.0, description="angle of that source, degrees")

    @model_validator(mode="after")
    def _is_fed(self) -> Self:
        if self.K_P == 0.0 and self.K_I == 0.0:
            raise ValueError("K_P and K_I are 0: nothing would feed it")
        return self

    def source(self) -> Sequence[float]:
        """The numbers of the source."""
        angle = math.radians(self.theta_P)
        K_P = self.K_P * math.cos(angle), self.K_P * math.sin(angle)
        return *K_P, self.K_I, self.X_L, self.K_C, self.V_Bmax
