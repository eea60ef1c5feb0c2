"""ST2CUT, a stabiliser with two inputs, here both the deviation w of the speed:

    V_s = (K1/(1 + s T1) + K2/(1 + s T2)) w  s T3/(1 + s T4)
          (1 + s T5)/(1 + s T6)  (1 + s T7)/(1 + s T8)  (1 + s T9)/(1 + s T10),
    L_Smin <= V_s <= L_Smax.

It is not cut off outside V_CU and V_CL.
"""

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

from pydantic import Field

from gfm_plant.components.controls.control import Stabiliser
from gfm_plant.parameters import NonNegative, Positive
from gfm_runtime.compiled import compiled


@compiled
def _rates(p: Any, x: Any, at: int, seen: float, asked: float, out: Any) -> float:
    T3, T4 = p[4], p[5]
    y = 0.0
    for k in range(2):
        K, T = p[k], p[2 + k]
        behind = K * seen
        if T > 0.0:
            out[at + k] = (behind - x[at + k]) / T
            behind = x[at + k]
        y += behind
    out[at + 2] = (y - x[at + 2]) / T4
    y = T3 / T4 * (y - x[at + 2])
    for k in range(3):
        lead, lag, behind = p[6 + 2 * k], p[7 + 2 * k], x[at + 3 + k]
        if lag > 0.0:
            out[at + 3 + k] = (y - behind) / lag
            y = behind + lead / lag * (y - behind)
    return min(max(y, p[12]), p[13])


class St2cut(Stabiliser):
    """A stabiliser by the speed of the rotor with three leads and lags, ST2CUT. The defaults are
    those of a machine of IEEE's case of 14 buses (ANDES, ieee14.dyr)."""

    states: ClassVar = (
        ("x_1, x_2", "p.u.", "behind the lags T1 and T2"),
        ("x_4", "p.u.", "of the washout"),
        ("x_6, x_8, x_10", "p.u.", "of the three leads and lags"),
    )
    rates: ClassVar = _rates
    leads: ClassVar = ("T5", "T6"), ("T7", "T8"), ("T9", "T10")
    order: ClassVar = "K1", "K2", *(f"T{k}" for k in range(1, 11)), "L_Smin", "L_Smax"
    times: ClassVar = "T1", "T2", "T4", "T6", "T8", "T10"

    type: Literal["ST2CUT"] = Field("ST2CUT", description="which stabiliser")
    K1: float = Field(10.0, ge=-1e4, le=1e4, description="first gain, voltage by speed, p.u./p.u.")
    K2: float = Field(0.0, ge=-1e4, le=1e4, description="second gain, likewise")
    T1: NonNegative = Field(0.0, description="lag of the first input, s; 0: none")
    T2: NonNegative = Field(0.0, description="lag of the second input, s; 0: none")
    T3: Positive = Field(3.0, description="washout: of its lead, s")
    T4: Positive = Field(3.0, description="washout: of its lag, s")
    T5: NonNegative = Field(0.15, description="first lead, s")
    T6: NonNegative = Field(0.05, description="first lag, s; 0: T5 must be 0, too")
    T7: NonNegative = Field(0.15, description="second lead, s")
    T8: NonNegative = Field(0.05, description="second lag, s; 0: T7 must be 0, too")
    T9: NonNegative = Field(0.15, description="third lead, s")
    T10: NonNegative = Field(0.05, description="third lag, s; 0: T9 must be 0, too")
    L_Smax: float = Field(0.05, ge=0.0, le=100.0, description="largest output, p.u.")
    L_Smin: float = Field(-0.05, ge=-100.0, le=0.0, description="least output, p.u.")

    def rest(self, output: float, seen: float) -> tuple[Sequence[float], float]:
        first, second = self.K1 * seen, self.K2 * seen
        kept = (first if self.T1 > 0.0 else 0.0, second if self.T2 > 0.0 else 0.0)
        return (*kept, first + second, 0.0, 0.0, 0.0), 0.0
