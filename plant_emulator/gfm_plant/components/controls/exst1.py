"""EXST1, a static exciter fed by the machine's terminals (ST1 of the IEEE, 1981):

    T_R dV_m/dt = V - V_m,    T_F dx/dt = E_fd - x,    T_B dy/dt = V_I - y,
    V_I = V_set - V_m - (E_fd - x) K_F / T_F,    V_Imin <= V_I <= V_Imax,
    T_A dE_fd/dt = K_A (y + (V_I - y) T_C / T_B) - E_fd,
    V_Rmin V - K_C I_fd <= E_fd <= V_Rmax V - K_C I_fd,

with the voltage V of the terminals and the current I_fd of the field, which loads the rectifier.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

from pydantic import Field

from gfm_plant.components.controls.control import Exciter, Terminals
from gfm_plant.parameters import NonNegative, Positive
from gfm_runtime.compiled import compiled


@compiled
def _rates(p: Any, x: Any, at: int, seen: Terminals, asked: float, out: Any) -> float:
    T_R, V_Imax, V_Imin, T_C, T_B, K_A, T_A = p[0], p[1], p[2], p[3], p[4], p[5], p[6]
    V_Rmax, V_Rmin, K_C, K_F, T_F = p[7], p[8], p[9], p[10], p[11]
    V_m, y, regulated, behind = x[at], x[at + 1], x[at + 2], x[at + 3]
    # a limit without wind-up, which moves
    drop = K_C * seen.I_fd
    E_fd: float = min(max(regulated, V_Rmin * seen.V - drop), V_Rmax * seen.V - drop)
    back = (E_fd - behind) / T_F
    V_I = min(max(asked - V_m - K_F * back, V_Imin), V_Imax)
    out[at] = (seen.V - V_m) / T_R
    if T_B > 0.0:
        out[at + 1] = (V_I - y) / T_B
        V_I = y + T_C / T_B * (V_I - y)
    rate = (K_A * V_I - regulated) / T_A
    out[at + 2] = rate if E_fd == regulated or (rate > 0.0) == (E_fd > regulated) else 0.0
    out[at + 3] = back
    return E_fd


class Exst1(Exciter):
    """A static exciter fed by the terminals, EXST1. The defaults are those of the machines of
    IEEE's case of 14 buses that have it (ANDES, ieee14.dyr)."""

    states: ClassVar = (
        ("V_m", "p.u.", "voltage that it has measured"),
        ("y", "p.u.", "of its lead and lag"),
        ("E_fd", "p.u.", "excitation"),
        ("x", "p.u.", "of the stabilising feedback"),
    )
    rates: ClassVar = _rates
    ranges: ClassVar = "V_I", "V_R"
    leads: ClassVar = (("T_C", "T_B"),)
    order: ClassVar = ("T_R", "V_Imax", "V_Imin", "T_C", "T_B", "K_A", "T_A", "V_Rmax", "V_Rmin",
                       "K_C", "K_F", "T_F")  # fmt: skip
    times: ClassVar = "T_R", "T_B", "T_A", "T_F"

    type: Literal["EXST1"] = Field("EXST1", description="which exciter")
    T_R: Positive = Field(0.02, description="lag of its measurement of the voltage, s")
    V_Imax: float = Field(99.0, ge=0.0, le=1e4, description="largest error of the voltage, p.u.")
    V_Imin: float = Field(-99.0, ge=-1e4, le=0.0, description="least error of it, p.u.")
    T_C: NonNegative = Field(0.0, description="lead before the regulator, s")
    T_B: NonNegative = Field(0.02, description="lag before the regulator, s; 0: neither it nor T_C")
    K_A: Positive = Field(50.0, description="gain of the regulator")
    T_A: Positive = Field(0.02, description="lag of the regulator, s")
    V_Rmax: float = Field(9999.0, ge=-1e4, le=1e4, description="largest E_fd at 1 p.u., p.u.")
    V_Rmin: float = Field(-9999.0, ge=-1e4, le=1e4, description="least E_fd at 1 p.u., p.u.")
    K_C: NonNegative = Field(0.0, description="by how much the field's current lowers both")
    K_F: NonNegative = Field(0.01, description="gain of the stabilising feedback, s")
    T_F: Positive = Field(1.0, description="time constant of the stabilising feedback, s")

    def limits_at(self, seen: Terminals) -> Mapping[int, tuple[float, float]]:
        drop = self.K_C * seen.I_fd
        ends = self.V_Rmin * seen.V - drop, self.V_Rmax * seen.V - drop
        return {1: (self.V_Imin, self.V_Imax), 2: ends}

    def rest(self, output: float, seen: Terminals) -> tuple[Sequence[float], float]:
        error = output / self.K_A
        return (seen.V, error, output, output), seen.V + error
