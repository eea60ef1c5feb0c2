"""HYGOV, a governor with a hydraulic turbine:

    T_f de/dt = set - w - R c - e,    dc/dt = (de/dt + e / T_r) / r,
    |dc/dt| <= VELM,    G_min <= c <= G_max,    T_g dg/dt = c - g,
    T_W dq/dt = 1 - h,    h = (q / g)^2,    P_m = A_t h (q - q_NL) - D_turb g w,

where w is the deviation of the speed, c the gate that is wanted, g the gate, q the flow and h the
head. Its permanent droop is R, the temporary one r.
"""

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

from pydantic import Field

from gfm_plant.components.controls.control import Governor, Shaft
from gfm_plant.parameters import NonNegative, Positive
from gfm_runtime.compiled import compiled

_LEAST = 0.01  # p.u.; of the gate by which the flow is divided


@compiled
def _rates(p: Any, x: Any, at: int, seen: Shaft, asked: float, out: Any) -> float:
    R, r, T_r, T_f, T_g, VELM = p[0], p[1], p[2], p[3], p[4], p[5]
    T_W, A_t, D_turb, q_NL = p[6], p[7], p[8], p[9]
    e, c, g, q = x[at], x[at + 1], x[at + 2], x[at + 3]
    slope = (asked - seen.w - R * c - e) / T_f
    out[at] = slope
    out[at + 1] = min(max((slope + e / T_r) / r, -VELM), VELM)
    out[at + 2] = (c - g) / T_g
    flow = q / max(g, _LEAST)
    h = flow * flow
    out[at + 3] = (1.0 - h) / T_W
    return A_t * h * (q - q_NL) - D_turb * g * seen.w


class Hygov(Governor):
    """A governor with a hydraulic turbine, HYGOV. The defaults are our choice."""

    states: ClassVar = (
        ("e", "p.u.", "error behind its filter"),
        ("c", "p.u.", "gate that is wanted"),
        ("g", "p.u.", "gate"),
        ("q", "p.u.", "flow of the water"),
    )
    rates: ClassVar = _rates
    order: ClassVar = "R", "r", "T_r", "T_f", "T_g", "VELM", "T_W", "A_t", "D_turb", "q_NL"
    times: ClassVar = "T_r", "T_f", "T_g", "T_W"
    stops: ClassVar = {1: "G_"}

    type: Literal["HYGOV"] = Field("HYGOV", description="which governor")
    R: Positive = Field(0.05, description="permanent droop, frequency by gate, p.u./p.u.")
    r: Positive = Field(0.5, description="temporary droop, p.u./p.u.")
    T_r: Positive = Field(5.0, description="time constant of the temporary droop, s")
    T_f: Positive = Field(0.05, description="lag of the filter, s")
    T_g: Positive = Field(0.2, description="lag of the gate, s")
    VELM: Positive = Field(0.2, description="how fast the gate moves at most, p.u./s")
    G_max: float = Field(1.0, ge=0.0, le=100.0, description="largest gate, p.u.")
    G_min: float = Field(0.0, ge=0.0, le=100.0, description="least gate, p.u.")
    T_W: Positive = Field(1.0, description="starting time of the water, s")
    A_t: Positive = Field(1.2, description="gain of the turbine")
    D_turb: NonNegative = Field(0.5, description="damping of the turbine, p.u./p.u.")
    q_NL: NonNegative = Field(0.08, description="flow without load, p.u.")

    def per_speed(self) -> float:
        return self.A_t / self.R

    def rest(self, output: float, seen: Shaft) -> tuple[Sequence[float], float]:
        g = (output + self.A_t * self.q_NL) / (self.A_t - self.D_turb * seen.w)
        return (0.0, g, g, g), seen.w + self.R * g
