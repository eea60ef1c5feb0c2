"""EXDC2, a DC commutator exciter (DC2A of IEEE Std 421.5): IEEET1 with a lead and lag before its
regulator, whose limits follow the voltage V of the terminals:

    T_R dV_m/dt = V - V_m,    T_F dx/dt = E_fd - x,    T_B dy/dt = u - y,
    u = V_set - V_m - (E_fd - x) K_F / T_F,
    T_A dV_R/dt = K_A (y + (u - y) T_C / T_B) - V_R,    V_Rmin V <= V_R <= V_Rmax V,
    T_E dE_fd/dt = V_R - K_E E_fd - S(E_fd),

with the saturation S of IEEET1.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

from pydantic import Field

from gfm_plant.components.controls.control import Terminals
from gfm_plant.components.controls.ieeet1 import Ieeet1
from gfm_plant.parameters import NonNegative
from gfm_runtime.compiled import compiled


@compiled
def _rates(p: Any, x: Any, at: int, seen: Terminals, asked: float, out: Any) -> float:
    T_R, K_A, T_A, K_E, T_E = p[0], p[1], p[2], p[3], p[4]
    K_F, T_F, a, b, T_B, T_C = p[5], p[6], p[7], p[8], p[9], p[10]
    V_m, V_R, E_fd, behind, y = x[at], x[at + 1], x[at + 2], x[at + 3], x[at + 4]
    above = max(E_fd - a, 0.0)
    back = (E_fd - behind) / T_F
    u = asked - V_m - K_F * back
    out[at] = (seen.V - V_m) / T_R
    if T_B > 0.0:
        out[at + 4] = (u - y) / T_B
        u = y + T_C / T_B * (u - y)
    rate = (K_A * u - V_R) / T_A
    # a limit without wind-up, which moves
    limited = min(max(V_R, p[11] * seen.V), p[12] * seen.V)
    out[at + 1] = rate if limited == V_R or (rate > 0.0) == (limited > V_R) else 0.0
    out[at + 2] = (limited - K_E * E_fd - b * above * above) / T_E
    out[at + 3] = back
    return E_fd


class Exdc2(Ieeet1):
    """A DC commutator exciter, EXDC2: IEEET1 with a lead and lag, and limits of its regulator that
    follow the voltage of the terminals."""

    states: ClassVar = (*Ieeet1.states, ("y", "p.u.", "of its lead and lag"))
    rates: ClassVar = _rates
    leads: ClassVar = (("T_C", "T_B"),)
    ranges: ClassVar = ("V_R",)
    times: ClassVar = *Ieeet1.times, "T_B"
    stops: ClassVar[Mapping[int, str]] = {}

    type: Literal["EXDC2"] = Field("EXDC2", description="which exciter")  # type: ignore[assignment]
    T_B: NonNegative = Field(0.0, description="lag before the regulator, s; 0: neither it nor T_C")
    T_C: NonNegative = Field(0.0, description="lead before the regulator, s")

    def numbers(self) -> Sequence[float]:
        return *super().numbers(), self.T_B, self.T_C, self.V_Rmin, self.V_Rmax

    def limits_at(self, seen: Terminals) -> Mapping[int, tuple[float, float]]:
        return {1: (self.V_Rmin * seen.V, self.V_Rmax * seen.V)}

    def rest(self, output: float, seen: Terminals) -> tuple[Sequence[float], float]:
        states, asked = super().rest(output, seen)
        return (*states, asked - seen.V), asked
