"""ESST3A, a static exciter fed by the voltage and the current of the terminals, with a regulator of
the field's voltage inside (ST3A of IEEE Std 421.5):

    T_R dV_m/dt = V - V_m,    V_I = V_set - V_m,    V_Imin <= V_I <= V_Imax,
    T_B dy/dt = V_I - y,
    T_A dV_R/dt = K_A (y + (V_I - y) T_C / T_B) - V_R,    V_Rmin <= V_R <= V_Rmax,
    T_M dV_M/dt = K_M (V_R - min(K_G E_fd, V_Gmax)) - V_M,    V_Mmin <= V_M <= V_Mmax,
    E_fd = V_B V_M,

with V_B of `rectifier`. The gate for a limiter of under-excitation is left out.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

from pydantic import Field

from gfm_plant.components.controls.control import Terminals
from gfm_plant.components.controls.rectifier import CompoundExciter, rectified
from gfm_plant.parameters import NonNegative, Positive
from gfm_runtime.compiled import compiled


@compiled
def _rates(p: Any, x: Any, at: int, seen: Terminals, asked: float, out: Any) -> float:
    T_R, V_Imax, V_Imin, T_C, T_B, K_A, T_A = p[0], p[1], p[2], p[3], p[4], p[5], p[6]
    V_Rmax, V_Rmin, K_G, K_M, T_M, V_Gmax = p[7], p[8], p[9], p[10], p[11], p[18]
    V_m, y, V_R, V_M = x[at], x[at + 1], x[at + 2], x[at + 3]
    V_I = min(max(asked - V_m, V_Imin), V_Imax)
    out[at] = (seen.V - V_m) / T_R
    if T_B > 0.0:
        out[at + 1] = (V_I - y) / T_B
        V_I = y + T_C / T_B * (V_I - y)
    if T_A > 0.0:
        out[at + 2] = (K_A * V_I - V_R) / T_A
    else:
        V_R = min(max(K_A * V_I, V_Rmin), V_Rmax)
    E_fd: float = rectified(p, 12, seen) * V_M
    out[at + 3] = (K_M * (V_R - min(K_G * E_fd, V_Gmax)) - V_M) / T_M
    return E_fd


class Esst3a(CompoundExciter):
    """A static exciter fed by voltage and current, with a regulator inside, ESST3A. The defaults
    are those of IEEE's case of 14 buses (ANDES, ieee14.dyr)."""

    states: ClassVar = (
        ("V_m", "p.u.", "voltage that it has measured"),
        ("y", "p.u.", "of its lead and lag"),
        ("V_R", "p.u.", "output of the outer regulator"),
        ("V_M", "p.u.", "output of the inner regulator"),
    )
    rates: ClassVar = _rates
    ranges: ClassVar = ("V_I",)
    leads: ClassVar = (("T_C", "T_B"),)
    order: ClassVar = ("T_R", "V_Imax", "V_Imin", "T_C", "T_B", "K_A", "T_A", "V_Rmax", "V_Rmin",
                       "K_G", "K_M", "T_M")  # fmt: skip
    times: ClassVar = "T_R", "T_B", "T_A"
    stops: ClassVar = {2: "V_R", 3: "V_M"}

    type: Literal["ESST3A"] = Field("ESST3A", description="which exciter")
    T_R: Positive = Field(0.02, description="lag of its measurement of the voltage, s")
    V_Imax: float = Field(0.2, ge=0.0, le=1e4, description="largest error of the voltage, p.u.")
    V_Imin: float = Field(-0.2, ge=-1e4, le=0.0, description="least error of it, p.u.")
    K_M: Positive = Field(8.0, description="gain of the inner regulator")
    T_C: NonNegative = Field(1.0, description="lead before the outer regulator, s")
    T_B: NonNegative = Field(5.0, description="lag before it, s; 0: neither it nor T_C")
    K_A: Positive = Field(20.0, description="gain of the outer regulator")
    T_A: NonNegative = Field(0.0, description="lag of the outer regulator, s; 0: none")
    V_Rmax: float = Field(99.0, ge=-1e4, le=1e4, description="largest output of it, p.u.")
    V_Rmin: float = Field(-99.0, ge=-1e4, le=1e4, description="least output of it, p.u.")
    K_G: NonNegative = Field(1.0, description="gain of the feedback of E_fd")
    V_Gmax: Positive = Field(3.86, description="largest feedback of E_fd, p.u.")
    T_M: Positive = Field(0.4, description="lag of the inner regulator, s")
    V_Mmax: float = Field(99.0, ge=-1e4, le=1e4, description="largest output of it, p.u.")
    V_Mmin: float = Field(0.0, ge=-1e4, le=1e4, description="least output of it, p.u.")

    def numbers(self) -> Sequence[float]:
        return *super().numbers(), *self.source(), self.V_Gmax

    def lags(self) -> Mapping[str, float]:
        V_B = min(self.K_P * (1.0 + self.X_L) + self.K_I, self.V_Bmax)  # at 1 p.u. of both
        inner = self.T_M / (1.0 + self.K_M * self.K_G * V_B)
        return {**super().lags(), "T_M / (1 + K_M K_G V_B)": inner}

    def limits_at(self, seen: Terminals) -> Mapping[int, tuple[float, float]]:
        return {1: (self.V_Imin, self.V_Imax), **self.limits()}

    def rest(self, output: float, seen: Terminals) -> tuple[Sequence[float], float]:
        V_B = rectified.py_func(self.source(), 0, seen)
        V_M = output / V_B if V_B > 0.0 else math.inf
        V_R = V_M / self.K_M + min(self.K_G * output, self.V_Gmax)
        error = V_R / self.K_A
        return (seen.V, error, V_R, V_M), seen.V + error
