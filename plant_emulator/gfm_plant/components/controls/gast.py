"""GAST, a governor with a gas turbine, whose temperature limits it:

    T1 dx_1/dt = min(P_ref - w / R, A_T + K_T (A_T - x_3)) - x_1,    V_min <= x_1 <= V_max,
    T2 dx_2/dt = x_1 - x_2,    T3 dx_3/dt = x_2 - x_3,    P_m = x_2 - D_turb w,

where w is the deviation of the speed, x_1 the valve, x_2 the power of the combustion and x_3 stands
for the temperature of the exhaust.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

from pydantic import Field

from gfm_plant.components.controls.control import Governor, Shaft
from gfm_plant.parameters import NonNegative, Positive
from gfm_runtime.compiled import compiled


@compiled
def _rates(p: Any, x: Any, at: int, seen: Shaft, asked: float, out: Any) -> float:
    R, T1, T2, T3, A_T, K_T, D_turb = p[0], p[1], p[2], p[3], p[4], p[5], p[6]
    valve, power, heat = x[at], x[at + 1], x[at + 2]
    out[at] = (min(asked - seen.w / R, A_T + K_T * (A_T - heat)) - valve) / T1
    out[at + 1], out[at + 2] = (valve - power) / T2, (power - heat) / T3
    return power - D_turb * seen.w


class Gast(Governor):
    """A governor with a gas turbine, GAST. The defaults are those of IEEE's case of 14 buses
    (PowerSystems.jl, dyn_data.dyr)."""

    states: ClassVar = (
        ("x_1", "p.u.", "position of the valve"),
        ("x_2", "p.u.", "power of the combustion"),
        ("x_3", "p.u.", "temperature of the exhaust, as a power"),
    )
    rates: ClassVar = _rates
    opens: ClassVar = "V_max", "A_T"
    order: ClassVar = "R", "T1", "T2", "T3", "A_T", "K_T", "D_turb"
    times: ClassVar = "T1", "T2", "T3"
    stops: ClassVar = {0: "V_"}

    type: Literal["GAST"] = Field("GAST", description="which governor")
    R: Positive = Field(0.05, description="droop, frequency by power, p.u./p.u.")
    T1: Positive = Field(0.2, description="lag of the valve, s")
    T2: Positive = Field(0.2, description="lag of the combustion, s")
    T3: Positive = Field(2.0, description="lag of the temperature, s")
    A_T: Positive = Field(1.0, description="power that the temperature allows for long, p.u.")
    K_T: NonNegative = Field(2.5, description="gain of the limit by the temperature")
    V_max: float = Field(1.1, ge=-100.0, le=100.0, description="largest opening of it, p.u.")
    V_min: float = Field(0.0, ge=-100.0, le=100.0, description="least opening of it, p.u.")
    D_turb: NonNegative = Field(0.0, description="damping of the turbine by frequency, p.u./p.u.")

    def limits_at(self, seen: Shaft) -> Mapping[int, tuple[float, float]]:
        return {0: (self.V_min, min(self.V_max, self.A_T))}

    def per_speed(self) -> float:
        return 1.0 / self.R + self.D_turb

    def rest(self, output: float, seen: Shaft) -> tuple[Sequence[float], float]:
        valve = output + self.D_turb * seen.w
        return (valve, valve, valve), valve + seen.w / self.R
