"""A PV array: current by voltage, after the single-diode model, from four values of a data sheet.

Without its resistances the model is i = I_sc (G - C_1 (exp(v / (C_2 V_oc)) - 1)). Its two constants
follow from the point of maximum power, C_2 = (V_mp / V_oc - 1) / ln(1 - I_mp / I_sc) and
C_1 = (1 - I_mp / I_sc) exp(-V_mp / (C_2 V_oc)); it is usually cited from H. S. Rauschenbach, Solar
Cell Array Design Handbook, 1980. The irradiance G moves the photocurrent alone, so that the
open-circuit voltage follows ln G. An array has no blocking diode: above that voltage it takes
current.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from gfm_plant.ramps import towards
from gfm_runtime.compiled import compiled, inlined

if TYPE_CHECKING:
    from gfm_plant.network import Network

MOST_IRRADIANCE = 1.5
"""Of 1000 W/m2: at the edge of a cloud it may exceed 1 by up to a half."""

_ROUNDS = 4  # of Newton's method for the point of maximum power, which is then exact to rounding


def diode(V_oc: float, I_sc: float, V_mp: float, I_mp: float) -> tuple[float, float]:
    """Return the saturation current C_1 I_sc and the voltage C_2 V_oc of the diode, both p.u."""
    v_T = (V_mp - V_oc) / math.log1p(-I_mp / I_sc)
    return (I_sc - I_mp) * math.exp(-V_mp / v_T), v_T


@compiled
def array_current(r: Any, irradiance: float, v: float) -> float:
    """Return the current of the array at v p.u.; ``r``: an element of ``par``."""
    return r["I_sc"] * irradiance - r["I_0"] * (math.exp(v / r["v_T"]) - 1.0)


def open_circuit_voltage(r: Any, irradiance: float) -> float:
    """Return the voltage of the array without current, p.u."""
    return float(r["v_T"] * math.log1p(r["I_sc"] * irradiance / r["I_0"]))


def array_slope(r: Any, v: float) -> float:
    """Return the derivative of that current by v."""
    return float(-r["I_0"] / r["v_T"] * math.exp(v / r["v_T"]))


@compiled
def most_power(r: Any, irradiance: float) -> tuple[float, float]:
    """Return the largest power of the array at an irradiance, and the voltage there, p.u.

    There d(v i)/dv = 0, which is x + ln(1 + x) = ln(1 + I_sc G / I_0) with x = v / v_T.
    """
    goal = math.log1p(r["I_sc"] * irradiance / r["I_0"])
    x = goal / (1.0 + 0.5 * goal)
    for _ in range(_ROUNDS):
        x += (goal - x - math.log1p(x)) * (1.0 + x) / (2.0 + x)
    return r["I_0"] * r["v_T"] * x * x * math.exp(x), x * r["v_T"]


@inlined
def move_irradiance(r: Any, s: Any) -> None:
    """Move a ramp of the irradiance on by one tick."""
    if s.irradiance != s.irradiance_to:
        s.irradiance = towards(s.irradiance, s.irradiance_to, s.irradiance_rate * r.T_s)
        s.P_array = most_power(r, s.irradiance)[0]


def set_irradiance(
    plant: Network, irradiance: float, rate: float | None = None, converter: str | None = None
) -> None:
    """Step the irradiance, of 1000 W/m2, or ramp it at `rate`, 1/s.

    Args:
        plant: The plant.
        irradiance: Where it goes, in [0, MOST_IRRADIANCE].
        rate: > 0; a step if None.
        converter: Name of the one whose array it shines on; all arrays if None.

    Raises:
        ValueError: If a value is out of range, or there is no such array. The plant is unchanged.
    """
    if not 0.0 <= irradiance <= MOST_IRRADIANCE:
        raise ValueError(f"irradiance = {irradiance}: must lie in [0, {MOST_IRRADIANCE:g}]")
    if rate is not None and not 0.0 < rate < math.inf:
        raise ValueError(f"rate = {rate}: must be > 0 1/s")
    names = [unit.name for unit in plant.wiring.units]
    arrays = [k for k in range(len(names)) if plant.par[k]["array"]]
    those = [k for k in arrays if converter in (None, names[k])]
    if not those and not plant.elsewhere:  # a part of a plant may have none
        of = "" if converter is None else f" of {converter}"
        raise ValueError(f"plant.dc_source.pv{of}: not set; there is no PV array")
    for k in those:
        s = plant.st[k]
        s["irradiance_to"], s["irradiance_rate"] = irradiance, math.inf if rate is None else rate
        if rate is None:
            s["irradiance"] = irradiance
            s["P_array"] = most_power.py_func(plant.par[k], irradiance)[0]
