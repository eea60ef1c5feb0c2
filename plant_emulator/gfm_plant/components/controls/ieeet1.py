"""IEEET1, the IEEE's exciter of type 1 of 1968, a rotating one with a stabilising feedback:

    T_R dV_m/dt = V - V_m,    T_F dx/dt = E_fd - x,
    T_A dV_R/dt = K_A (V_set - V_m - (E_fd - x) K_F / T_F) - V_R,    V_Rmin <= V_R <= V_Rmax,
    T_E dE_fd/dt = V_R - K_E E_fd - S(E_fd),

where S(E) = b (E - a)^2 above a and 0 below it is the saturation, whose two numbers follow from two
points of it, S(E_1) = S_E1 E_1 and S(E_2) = S_E2 E_2.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from gfm_plant.components.controls.control import Exciter, Terminals, parabola
from gfm_plant.parameters import NonNegative, Positive
from gfm_runtime.compiled import compiled


@compiled
def _rates(p: Any, x: Any, at: int, seen: Terminals, asked: float, out: Any) -> float:
    T_R, K_A, T_A, K_E, T_E = p[0], p[1], p[2], p[3], p[4]
    K_F, T_F, a, b = p[5], p[6], p[7], p[8]
    V_m, V_R, E_fd, behind = x[at], x[at + 1], x[at + 2], x[at + 3]
    above = max(E_fd - a, 0.0)
    back = (E_fd - behind) / T_F
    out[at] = (seen.V - V_m) / T_R
    out[at + 1] = (K_A * (asked - V_m - K_F * back) - V_R) / T_A
    out[at + 2] = (V_R - K_E * E_fd - b * above * above) / T_E
    out[at + 3] = back
    return E_fd


class Ieeet1(Exciter):
    """The IEEE's exciter of type 1, IEEET1: a regulator, a rotating exciter that saturates, and a
    feedback of the rate of its voltage. Its set-point is what the voltage at the start needs. The
    defaults are those of the WSCC's system of nine buses (Anderson and Fouad), without its
    saturation."""

    states: ClassVar[Sequence[tuple[str, str, str]]] = (
        ("V_m", "p.u.", "voltage that it has measured"),
        ("V_R", "p.u.", "output of the regulator"),
        ("E_fd", "p.u.", "excitation"),
        ("x", "p.u.", "of the stabilising feedback"),
    )
    rates: ClassVar = _rates
    order: ClassVar[Sequence[str]] = "T_R", "K_A", "T_A", "K_E", "T_E", "K_F", "T_F"
    times: ClassVar[Sequence[str]] = "T_R", "T_A", "T_E", "T_F"
    stops: ClassVar[Mapping[int, str]] = {1: "V_R"}

    type: Literal["IEEET1"] = Field("IEEET1", description="which exciter")
    T_R: Positive = Field(0.02, description="lag of its measurement of the voltage, s")
    K_A: Positive = Field(20.0, description="gain of the regulator")
    T_A: Positive = Field(0.2, description="lag of the regulator, s")
    V_Rmax: float = Field(5.0, ge=-100.0, le=100.0, description="largest output of it, p.u.")
    V_Rmin: float = Field(-5.0, ge=-100.0, le=100.0, description="least output of it, p.u.")
    K_E: float = Field(1.0, ge=-100.0, le=100.0, description="of the exciter's own field")
    T_E: Positive = Field(0.314, description="time constant of the exciter, s")
    K_F: NonNegative = Field(0.063, description="gain of the stabilising feedback, s")
    T_F: Positive = Field(0.35, description="time constant of the stabilising feedback, s")
    E_1: NonNegative = Field(0.0, description="first excitation at which S_E is known, p.u.")
    S_E1: NonNegative = Field(0.0, description="saturation S_E there")
    E_2: NonNegative = Field(0.0, description="second one, p.u.")
    S_E2: NonNegative = Field(0.0, description="saturation S_E there; 0: none at all")

    @model_validator(mode="after")
    def _saturates(self) -> Self:
        if self.S_E2 == 0.0 and self.S_E1 > 0.0:
            raise ValueError(f"S_E1 = {self.S_E1:g}: S_E2 must be above 0, too")
        if self.S_E2 > 0.0 and not self.E_1 < self.E_2:
            raise ValueError(f"E_1 = {self.E_1:g}: must be less than E_2, {self.E_2:g}")
        if self.S_E2 > 0.0 and not self.S_E1 <= self.S_E2:
            raise ValueError(f"S_E1 = {self.S_E1:g}: must be at most S_E2, {self.S_E2:g}")
        return self

    def saturation(self) -> tuple[float, float]:
        """Its numbers a and b."""
        return parabola(self.E_1, self.S_E1, self.E_2, self.S_E2)

    def field(self, E_fd: float) -> float:
        """The output of the regulator that an excitation needs at rest."""
        a, b = self.saturation()
        return self.K_E * E_fd + b * max(E_fd - a, 0.0) ** 2

    def numbers(self) -> Sequence[float]:
        return *super().numbers(), *self.saturation()

    def rest(self, output: float, seen: Terminals) -> tuple[Sequence[float], float]:
        V_R = self.field(output)
        return (seen.V, V_R, output, output), seen.V + V_R / self.K_A
