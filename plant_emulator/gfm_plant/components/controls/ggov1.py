"""GGOV1, the general governor with a gas turbine or a diesel engine (WECC), by the electric power:

    T_pelec dP/dt = P_e - P,    e = R (P_ref - P) - w,
    e beyond the dead band db,    minerr <= e <= maxerr,
    f_n = K_pgov e + x_I + K_dgov de_d/dt,    T_dgov de_d/dt = e - e_d,
    f_t = min(x_L + K_pload (L_dref / K_turb + W_fnl - t), 1),    f = min(f_n, f_t),
    V_min <= f <= V_max,
    dx_I/dt = (f - x_I) K_igov / K_pgov,    dx_L/dt = (f - x_L) K_iload / K_pload,
    T_act dv/dt = f - v,    R_close <= dv/dt <= R_open,    v_f = v (1 + w) if flag, else v,
    T_b dy/dt = K_turb (v_f - W_fnl) - y,
    P_m = y + (K_turb (v_f - W_fnl) - y) T_c / T_b - D_m w,
    T_sb ds/dt = v_f - s,    T_fload dt/dt = s + (v_f - s) T_sa / T_sb - t,

where w is the deviation of the speed, f the fuel that is wanted, v the valve and t the temperature
of the exhaust, all in p.u. of the turbine's rating T_rate. The integrals x_I and x_L follow the
lesser one of f_n and f_t, so that none winds up. The limit by the acceleration, which depends on
the step of a program, the controller of the power by K_imw, the delay T_eng, the rates of the load
limiter R_up and R_down, and D_m < 0 are left out.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

from pydantic import Field

from gfm_plant.components.controls.control import Governor, Shaft
from gfm_plant.parameters import NonNegative, Positive
from gfm_runtime.compiled import compiled


@compiled
def _rates(p: Any, x: Any, at: int, seen: Shaft, asked: float, out: Any) -> float:
    R, T_pelec, maxerr, minerr, K_pgov, K_igov, K_dgov = p[0], p[1], p[2], p[3], p[4], p[5], p[6]
    T_dgov, V_max, V_min, T_act, K_turb, W_fnl = p[7], p[8], p[9], p[10], p[11], p[12]
    T_b, T_c, T_fload, K_pload, K_iload, D_m = p[13], p[14], p[15], p[16], p[17], p[18]
    R_open, R_close, T_rate, db, T_sa, T_sb = p[19], p[20], p[21], p[22], p[23], p[24]
    flag, allowed = p[25], p[26]
    P, e_d, x_I, x_L = x[at], x[at + 1], x[at + 2], x[at + 3]
    v, y, s, t = x[at + 4], x[at + 5], x[at + 6], x[at + 7]
    out[at] = (seen.P_e / T_rate - P) / T_pelec
    e = R * (asked - P) - seen.w
    e -= min(max(e, -db), db)
    e = min(max(e, minerr), maxerr)
    f = K_pgov * e + x_I
    if K_dgov > 0.0:
        out[at + 1] = (e - e_d) / T_dgov
        f += K_dgov * out[at + 1]
    f = min(f, x_L + K_pload * (allowed - t), 1.0)
    f = min(max(f, V_min), V_max)
    out[at + 2] = (f - x_I) * K_igov / K_pgov
    out[at + 3] = (f - x_L) * K_iload / K_pload
    out[at + 4] = min(max((f - v) / T_act, R_close), R_open)
    burns = v * (1.0 + seen.w) if flag > 0.0 else v
    power = K_turb * (burns - W_fnl)
    out[at + 5] = (power - y) / T_b
    if T_sb > 0.0:
        out[at + 6] = (burns - s) / T_sb
        burns = s + T_sa / T_sb * (burns - s)
    out[at + 7] = (burns - t) / T_fload
    return T_rate * (y + T_c / T_b * (power - y) - D_m * seen.w)


class Ggov1(Governor):
    """The general governor with a gas turbine, GGOV1, whose droop is by the electric power. The
    defaults are those of OpenIPSL; the turbine has the rating of the machine."""

    states: ClassVar = (
        ("P", "p.u.", "electric power as measured"),
        ("e_d", "p.u.", "of its derivative"),
        ("x_I", "p.u.", "integral of the governor"),
        ("x_L", "p.u.", "integral of the load limiter"),
        ("v", "p.u.", "stroke of the valve"),
        ("y", "p.u.", "of the turbine's lead and lag"),
        ("s", "p.u.", "of the lead and lag of the temperature"),
        ("t", "p.u.", "temperature of the exhaust, as a flow of fuel"),
    )
    rates: ClassVar = _rates
    opens: ClassVar = ("T_rate",)
    ranges: ClassVar = ("V_",)
    leads: ClassVar = (("T_sa", "T_sb"),)
    order: ClassVar = (
        "R", "T_pelec", "maxerr", "minerr", "K_pgov", "K_igov", "K_dgov", "T_dgov", "V_max",
        "V_min", "T_act", "K_turb", "W_fnl", "T_b", "T_c", "T_fload", "K_pload", "K_iload", "D_m",
        "R_open", "R_close", "T_rate", "db", "T_sa", "T_sb", "flag",
    )  # fmt: skip
    times: ClassVar = "T_pelec", "T_dgov", "T_act", "T_b", "T_fload", "T_sb"

    type: Literal["GGOV1"] = Field("GGOV1", description="which governor")
    flag: bool = Field(True, description="whether the flow of fuel follows the speed")
    R: Positive = Field(0.04, description="droop, frequency by electric power, p.u./p.u.")
    T_pelec: Positive = Field(1.0, description="lag of the measurement of the power, s")
    maxerr: float = Field(0.05, ge=0.0, le=10.0, description="largest error of the speed, p.u.")
    minerr: float = Field(-0.05, ge=-10.0, le=0.0, description="least error of the speed, p.u.")
    K_pgov: Positive = Field(10.0, description="gain of the governor")
    K_igov: NonNegative = Field(2.0, description="gain of its integral, 1/s")
    K_dgov: NonNegative = Field(0.0, description="gain of its derivative, s")
    T_dgov: Positive = Field(1.0, description="lag of its derivative, s")
    V_max: float = Field(1.0, ge=-100.0, le=100.0, description="largest stroke, p.u.")
    V_min: float = Field(0.15, ge=-100.0, le=100.0, description="least stroke, p.u.")
    T_act: Positive = Field(0.5, description="lag of the valve, s")
    K_turb: Positive = Field(1.5, description="gain of the turbine, power by fuel")
    W_fnl: NonNegative = Field(0.2, description="flow of fuel without load, p.u.")
    T_b: Positive = Field(0.1, description="lag of the turbine, s")
    T_c: NonNegative = Field(0.0, description="lead of the turbine, s")
    T_fload: Positive = Field(3.0, description="lag of the temperature, s")
    K_pload: Positive = Field(2.0, description="gain of the load limiter")
    K_iload: NonNegative = Field(0.67, description="gain of its integral, 1/s")
    L_dref: Positive = Field(1.0, description="power that the load limiter allows, p.u.")
    D_m: NonNegative = Field(0.0, description="damping of the turbine by frequency, p.u./p.u.")
    R_open: Positive = Field(0.1, description="how fast the valve opens at most, p.u./s")
    R_close: float = Field(-0.1, lt=0.0, ge=-1000.0, description="how fast it closes, p.u./s")
    T_rate: Positive = Field(1.0, description="rating of the turbine, p.u. of the machine's")
    db: NonNegative = Field(0.0, description="dead band of the error, p.u.")
    T_sa: NonNegative = Field(4.0, description="lead of the temperature, s")
    T_sb: NonNegative = Field(5.0, description="lag of it, s; 0: neither it nor T_sa")

    def _allowed(self) -> float:
        """The flow of fuel that the load limiter allows."""
        return self.L_dref / self.K_turb + self.W_fnl

    def numbers(self) -> Sequence[float]:
        return *super().numbers(), self._allowed()

    def lags(self) -> Mapping[str, float]:
        own = {**super().lags()}
        for one in ("gov", "load"):
            K_p, K_i = getattr(self, f"K_p{one}"), getattr(self, f"K_i{one}")
            if K_i > 0.0:
                own[f"K_p{one} / K_i{one}"] = K_p / K_i
        return own

    def limits_at(self, seen: Shaft) -> Mapping[int, tuple[float, float]]:
        return {4: (self.V_min, min(self.V_max, self._allowed(), 1.0))}

    def per_speed(self) -> float:
        return self.T_rate / self.R

    def rest(self, output: float, seen: Shaft) -> tuple[Sequence[float], float]:
        P, power = seen.P_e / self.T_rate, output / self.T_rate + self.D_m * seen.w
        burns = power / self.K_turb + self.W_fnl
        v = burns / (1.0 + seen.w) if self.flag else burns
        return (P, 0.0, v, v, v, power, burns, burns), P + seen.w / self.R
