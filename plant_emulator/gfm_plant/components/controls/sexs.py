"""SEXS, a simplified excitation system:

T_R dV_m/dt = V - V_m,    T_B dx/dt = V_set - V_m - x,
T_E dE_fd/dt = K (x + (V_set - V_m - x) T_A / T_B) - E_fd,    E_min <= E_fd <= E_max.
"""

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

from pydantic import Field

from gfm_plant.components.controls.control import Exciter, Terminals
from gfm_plant.parameters import NonNegative, Positive
from gfm_runtime.compiled import compiled


@compiled
def _rates(p: Any, x: Any, at: int, seen: Terminals, asked: float, out: Any) -> float:
    K, T_R, T_A, T_B, T_E = p[0], p[1], p[2], p[3], p[4]
    V_m, lead, E_fd = x[at], x[at + 1], x[at + 2]
    off = asked - V_m
    out[at], out[at + 1] = (seen.V - V_m) / T_R, (off - lead) / T_B
    ahead = lead + T_A / T_B * (off - lead)
    out[at + 2] = (K * ahead - E_fd) / T_E
    return E_fd


class Sexs(Exciter):
    """A voltage regulator with its exciter, SEXS. Its set-point is what the voltage at the start
    needs."""

    states: ClassVar = (
        ("V_m", "p.u.", "voltage that it has measured"),
        ("x", "p.u.", "of its lead and lag"),
        ("E_fd", "p.u.", "excitation"),
    )
    rates: ClassVar = _rates
    order: ClassVar = "K", "T_R", "T_A", "T_B", "T_E"
    times: ClassVar = "T_R", "T_B", "T_E"
    stops: ClassVar = {2: "E_"}

    type: Literal["SEXS"] = Field("SEXS", description="which exciter")
    K: Positive = Field(200.0, description="gain, p.u. of excitation by p.u. of voltage")
    T_R: Positive = Field(0.02, description="lag of its measurement of the voltage, s")
    T_A: NonNegative = Field(1.0, description="lead, s")
    T_B: Positive = Field(10.0, description="lag, s")
    T_E: Positive = Field(0.05, description="lag of the exciter, s")
    E_min: float = Field(0.0, ge=-100.0, le=100.0, description="least excitation E_fd, p.u.")
    E_max: float = Field(5.0, ge=-100.0, le=100.0, description="largest excitation E_fd, p.u.")

    def rest(self, output: float, seen: Terminals) -> tuple[Sequence[float], float]:
        ahead = output / self.K
        return (seen.V, ahead, output), seen.V + ahead
