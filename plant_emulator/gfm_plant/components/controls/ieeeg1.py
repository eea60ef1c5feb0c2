"""IEEEG1, the IEEE's governor with a steam turbine, of one shaft:

    T1 dy/dt = K w - y,    s = y + (K w - y) T2 / T1,
    T3 dg/dt = P_ref - s - g,    U_c <= dg/dt <= U_o,    P_min <= g <= P_max,
    T4 dx_4/dt = g - x_4,    T5 dx_5/dt = x_4 - x_5,    T6 dx_6/dt = x_5 - x_6,
    T7 dx_7/dt = x_6 - x_7,    P_m = K1 x_4 + K3 x_5 + K5 x_6 + K7 x_7,

where w is the deviation of the speed and g the valves. A time constant of 0 leaves its block out;
the shaft of low pressure, K2, K4, K6 and K8, is not there.
"""

from collections.abc import Sequence
from typing import Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from gfm_plant.components.controls.control import Governor, Shaft
from gfm_plant.parameters import NonNegative, Positive
from gfm_runtime.compiled import compiled

_SHARES = ("K1", "K3", "K5", "K7")
_LAGS = ("T4", "T5", "T6", "T7")


@compiled
def _rates(p: Any, x: Any, at: int, seen: Shaft, asked: float, out: Any) -> float:
    K, T1, T2, T3, U_o, U_c = p[0], p[1], p[2], p[3], p[4], p[5]
    s = K * seen.w
    if T1 > 0.0:
        out[at] = (s - x[at]) / T1
        s = x[at] + T2 / T1 * (s - x[at])
    y = x[at + 1]
    out[at + 1] = min(max((asked - s - y) / T3, U_c), U_o)
    power = 0.0
    for k in range(4):
        T, here = p[6 + k], x[at + 2 + k]
        if T > 0.0:
            out[at + 2 + k] = (y - here) / T
            y = here
        power += p[10 + k] * y
    return power


class Ieeeg1(Governor):
    """A governor with a steam turbine of one shaft, IEEEG1."""

    states: ClassVar = (
        ("y", "p.u.", "of its lead and lag"),
        ("g", "p.u.", "position of the valves"),
        ("x_4 … x_7", "p.u.", "power behind chest, reheater and crossovers"),
    )
    rates: ClassVar = _rates
    leads: ClassVar = (("T2", "T1"),)
    order: ClassVar = "K", "T1", "T2", "T3", "U_o", "U_c", *_LAGS, *_SHARES
    times: ClassVar = "T1", "T3", *_LAGS
    stops: ClassVar = {1: "P_"}

    type: Literal["IEEEG1"] = Field("IEEEG1", description="which governor")
    K: Positive = Field(20.0, description="gain, power by speed, p.u./p.u.")
    T1: NonNegative = Field(0.0, description="lag of the governor, s; 0: neither it nor T2")
    T2: NonNegative = Field(0.0, description="lead of the governor, s")
    T3: Positive = Field(0.1, description="lag of the valves, s")
    U_o: Positive = Field(0.5, description="how fast they open at most, p.u./s")
    U_c: float = Field(-0.5, lt=0.0, ge=-1000.0, description="how fast they close, p.u./s")
    P_max: float = Field(1.0, ge=-100.0, le=100.0, description="largest opening of them, p.u.")
    P_min: float = Field(0.0, ge=-100.0, le=100.0, description="least opening of them, p.u.")
    T4: NonNegative = Field(0.3, description="lag of the steam chest, s")
    K1: NonNegative = Field(0.3, description="share of the power behind it")
    T5: NonNegative = Field(7.0, description="second lag, s: its reheater")
    K3: NonNegative = Field(0.7, description="share of the power behind it")
    T6: NonNegative = Field(0.0, description="third lag, s")
    K5: NonNegative = Field(0.0, description="share of the power behind it")
    T7: NonNegative = Field(0.0, description="fourth lag, s")
    K7: NonNegative = Field(0.0, description="share of the power behind it")

    @model_validator(mode="after")
    def _turns(self) -> Self:
        if not self.gain() > 0.0:
            raise ValueError("K1, K3, K5 and K7 are 0: it would bring no power")
        return self

    def gain(self) -> float:
        """The power by the position of the valves."""
        return sum(getattr(self, name) for name in _SHARES)

    def per_speed(self) -> float:
        return self.K * self.gain()

    def rest(self, output: float, seen: Shaft) -> tuple[Sequence[float], float]:
        g, s = output / self.gain(), self.K * seen.w
        return (s if self.T1 > 0.0 else 0.0, g, g, g, g, g), g + s
