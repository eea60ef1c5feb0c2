"""TGOV1, a governor with a steam turbine:

    T1 dx_1/dt = P_ref - w / R - x_1,    V_min <= x_1 <= V_max,
    T3 dx_2/dt = x_1 - x_2,    P_m = x_2 + (x_1 - x_2) T2 / T3 - D_t w,

where w is the deviation of the speed, x_1 the valve, and T2 / T3 the part of the power that does
not pass the reheater. P_ref is in p.u. of power, that of PSS/E times R.
"""

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

from pydantic import Field

from gfm_plant.components.controls.control import Governor, Shaft
from gfm_plant.parameters import NonNegative, Positive
from gfm_runtime.compiled import compiled


@compiled
def _rates(p: Any, x: Any, at: int, seen: Shaft, asked: float, out: Any) -> float:
    R, T1, T2, T3, D_t = p[0], p[1], p[2], p[3], p[4]
    valve, behind = x[at], x[at + 1]
    out[at] = (asked - seen.w / R - valve) / T1
    out[at + 1] = (valve - behind) / T3
    return behind + T2 / T3 * (valve - behind) - D_t * seen.w


class Tgov1(Governor):
    """A governor with a steam turbine, TGOV1."""

    states: ClassVar = (
        ("x_1", "p.u.", "position of the valve"),
        ("x_2", "p.u.", "power behind the reheater"),
    )
    rates: ClassVar = _rates
    order: ClassVar = "R", "T1", "T2", "T3", "D_t"
    times: ClassVar = "T1", "T3"
    stops: ClassVar = {0: "V_"}

    type: Literal["TGOV1"] = Field("TGOV1", description="which governor")
    R: Positive = Field(0.05, description="droop, frequency by power, p.u./p.u.")
    T1: Positive = Field(0.5, description="lag of the valve, s")
    V_max: float = Field(1.2, ge=-100.0, le=100.0, description="largest opening of it, p.u.")
    V_min: float = Field(0.0, ge=-100.0, le=100.0, description="least opening of it, p.u.")
    T2: NonNegative = Field(3.0, description="lead of the turbine, s")
    T3: Positive = Field(10.0, description="lag of the turbine, s: its reheater")
    D_t: NonNegative = Field(0.0, description="damping of the turbine by frequency, p.u./p.u.")

    def per_speed(self) -> float:
        return 1.0 / self.R + self.D_t

    def rest(self, output: float, seen: Shaft) -> tuple[Sequence[float], float]:
        valve = output + self.D_t * seen.w
        return (valve, valve), valve + seen.w / self.R
