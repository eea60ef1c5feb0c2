"""ESST4B, a static exciter fed by the voltage and the current of the terminals, with two regulators
of proportion and integral (ST4B of IEEE Std 421.5):

    T_R dV_m/dt = V - V_m,    e = V_set - V_m,
    V_R = K_PR e + x_R,    dx_R/dt = K_IR e,    V_Rmin <= V_R <= V_Rmax,
    T_A dV_A/dt = V_R - V_A,    u = V_A - K_G E_fd,
    V_M = K_PM u + x_M,    dx_M/dt = K_IM u,    V_Mmin <= V_M <= V_Mmax,    E_fd = V_B V_M,

with V_B of `rectifier`. At its limit the integral of a regulator stops, unless it moves back. The
gate for a limiter of over-excitation is left out.
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
    T_R, K_PR, K_IR, V_Rmax, V_Rmin, T_A = p[0], p[1], p[2], p[3], p[4], p[5]
    K_PM, K_IM, V_Mmax, V_Mmin, K_G = p[6], p[7], p[8], p[9], p[10]
    V_m, V_A, V_B = x[at], x[at + 2], rectified(p, 11, seen)
    e = asked - V_m
    out[at] = (seen.V - V_m) / T_R
    free = K_PR * e + (x[at + 1] if K_IR > 0.0 else 0.0)
    V_R = min(max(free, V_Rmin), V_Rmax)
    out[at + 1] = K_IR * e if free == V_R or (e > 0.0) == (free < V_R) else 0.0
    if T_A > 0.0:
        out[at + 2] = (V_R - V_A) / T_A
        V_R = V_A
    # V_M by u, in which it is itself
    free = (K_PM * V_R + (x[at + 3] if K_IM > 0.0 else 0.0)) / (1.0 + K_PM * K_G * V_B)
    V_M = min(max(free, V_Mmin), V_Mmax)
    E_fd: float = V_B * V_M
    u = V_R - K_G * E_fd
    out[at + 3] = K_IM * u if free == V_M or (u > 0.0) == (free < V_M) else 0.0
    return E_fd


class Esst4b(CompoundExciter):
    """A static exciter fed by voltage and current, with two regulators of proportion and integral,
    ESST4B. The defaults are those of OpenIPSL, and the source is that of ESST3A."""

    states: ClassVar = (
        ("V_m", "p.u.", "voltage that it has measured"),
        ("x_R", "p.u.", "integral of the outer regulator"),
        ("V_A", "p.u.", "behind the lag T_A"),
        ("x_M", "p.u.", "integral of the inner regulator"),
    )
    rates: ClassVar = _rates
    ranges: ClassVar = "V_R", "V_M"
    order: ClassVar = ("T_R", "K_PR", "K_IR", "V_Rmax", "V_Rmin", "T_A", "K_PM", "K_IM", "V_Mmax",
                       "V_Mmin", "K_G")  # fmt: skip
    times: ClassVar = "T_R", "T_A"

    type: Literal["ESST4B"] = Field("ESST4B", description="which exciter")
    T_R: Positive = Field(0.02, description="lag of its measurement of the voltage, s")
    K_PR: Positive = Field(2.97, description="gain of the outer regulator")
    K_IR: NonNegative = Field(2.97, description="its gain of the integral, 1/s; 0: none")
    V_Rmax: float = Field(1.0, ge=-1e4, le=1e4, description="largest output of it, p.u.")
    V_Rmin: float = Field(-0.87, ge=-1e4, le=1e4, description="least output of it, p.u.")
    T_A: NonNegative = Field(0.01, description="lag of the outer regulator, s; 0: none")
    K_PM: Positive = Field(1.0, description="gain of the inner regulator")
    K_IM: NonNegative = Field(0.2, description="its gain of the integral, 1/s; 0: none")
    V_Mmax: float = Field(1.0, ge=-1e4, le=1e4, description="largest output of it, p.u.")
    V_Mmin: float = Field(-0.87, ge=-1e4, le=1e4, description="least output of it, p.u.")
    K_G: NonNegative = Field(0.1, description="gain of the feedback of E_fd")

    def numbers(self) -> Sequence[float]:
        return *super().numbers(), *self.source()

    def limits_at(self, seen: Terminals) -> Mapping[int, tuple[float, float]]:
        return {2: (self.V_Rmin, self.V_Rmax), 3: (self.V_Mmin, self.V_Mmax)}

    def rest(self, output: float, seen: Terminals) -> tuple[Sequence[float], float]:
        V_B = rectified.py_func(self.source(), 0, seen)
        V_M = output / V_B if V_B > 0.0 else math.inf
        V_R = self.K_G * output + (0.0 if self.K_IM > 0.0 else V_M / self.K_PM)
        error = 0.0 if self.K_IR > 0.0 else V_R / self.K_PR
        return (seen.V, V_R, V_R, V_M), seen.V + error
