"""PSS1A, a stabiliser with one input (IEEE Std 421.5), here the deviation of the speed:

V_s = K_S  1/(1 + s T6)  s T5/(1 + s T5)  1/(1 + A1 s + A2 s^2)
      (1 + s T1)/(1 + s T2)  (1 + s T3)/(1 + s T4),    V_STmin <= V_s <= V_STmax.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

from pydantic import Field

from gfm_plant.components.controls.control import Stabiliser
from gfm_plant.parameters import NonNegative, Positive
from gfm_runtime.compiled import compiled


@compiled
def _rates(p: Any, x: Any, at: int, seen: float, asked: float, out: Any) -> float:
    K_S, T5, T6, A1, A2 = p[0], p[1], p[2], p[3], p[4]
    y = seen
    if T6 > 0.0:
        out[at] = (y - x[at]) / T6
        y = x[at]
    out[at + 1] = (K_S * y - x[at + 1]) / T5
    y = K_S * y - x[at + 1]
    if A2 > 0.0:
        out[at + 2] = x[at + 3]
        out[at + 3] = (y - x[at + 2] - A1 * x[at + 3]) / A2
        y = x[at + 2]
    elif A1 > 0.0:
        out[at + 2] = (y - x[at + 2]) / A1
        y = x[at + 2]
    for k in range(2):
        lead, lag, behind = p[5 + 2 * k], p[6 + 2 * k], x[at + 4 + k]
        if lag > 0.0:
            out[at + 4 + k] = (y - behind) / lag
            y = behind + lead / lag * (y - behind)
    return min(max(y, p[9]), p[10])


class Pss1a(Stabiliser):
    """A stabiliser by the speed of the rotor, PSS1A. The defaults are those of the machines of
    Kundur's two areas (Power System Stability and Control, example 12.6)."""

    states: ClassVar = (
        ("x_6", "p.u.", "behind the lag T6"),
        ("x_5", "p.u.", "of the washout T5"),
        ("x_A, dx_A/dt", "p.u., 1/s", "of the filter A1, A2"),
        ("x_2, x_4", "p.u.", "of both leads and lags"),
    )
    rates: ClassVar = _rates
    leads: ClassVar = ("T1", "T2"), ("T3", "T4"), ("A2", "A1")
    order: ClassVar = "K_S", "T5", "T6", "A1", "A2", "T1", "T2", "T3", "T4", "V_STmin", "V_STmax"
    times: ClassVar = "T2", "T4", "T5", "T6"

    type: Literal["PSS1A"] = Field("PSS1A", description="which stabiliser")
    K_S: NonNegative = Field(20.0, description="gain, voltage by speed, p.u./p.u.")
    T1: NonNegative = Field(0.05, description="first lead, s")
    T2: NonNegative = Field(0.02, description="first lag, s; 0: T1 must be 0, too")
    T3: NonNegative = Field(3.0, description="second lead, s")
    T4: NonNegative = Field(5.4, description="second lag, s; 0: T3 must be 0, too")
    T5: Positive = Field(10.0, description="washout, s")
    T6: NonNegative = Field(0.0, description="lag of its measurement, s; 0: none")
    A1: NonNegative = Field(0.0, description="of the filter, s")
    A2: NonNegative = Field(0.0, description="of the filter, s^2")
    V_STmax: float = Field(0.2, ge=0.0, le=100.0, description="largest output, p.u.")
    V_STmin: float = Field(-0.2, ge=-100.0, le=0.0, description="least output, p.u.")

    def lags(self) -> Mapping[str, float]:
        A1 = self.A1 if self.A2 == 0.0 else min(self.A1, self.A2 / self.A1)
        return {**super().lags(), **({"A1": A1} if A1 > 0.0 else {})}

    def rest(self, output: float, seen: float) -> tuple[Sequence[float], float]:
        return (seen if self.T6 > 0.0 else 0.0, self.K_S * seen, 0.0, 0.0, 0.0, 0.0), 0.0
