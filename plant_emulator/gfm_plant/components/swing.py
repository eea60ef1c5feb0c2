"""The swing equation of a machine or a finite grid, with one governor, on its own rating:

    2 H d(omega)/dt = P_turbine + p / S - P_load - D (omega - 1)
    T_gov d(P_turbine)/dt = P_set - (omega - 1) / droop - P_turbine

where p is the power that comes, p.u. of the network, and S the rating over that of the network.
Within a tick omega is held at its value in the middle, extrapolated.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_plant.layout import field
from gfm_runtime.compiled import compiled

STEP = 0.1  # largest rate times T_s

SWING_PARAMETERS = ("H", "D", "droop", "T_gov", "S")
SWING = [
    *((name, "f8") for name in SWING_PARAMETERS),
    # p.u. of its rating: power of the turbines, set point of the governor, load
    *((name, "f8") for name in ("P_turbine", "P_set", "P_load")),
    ("energy", "f8"),  # that came since the last tick, p.u. of the network and s
    ("energy_kept", "f8"),
]
"""Fields of a record that swings."""


def pack_swing(swings: Any, record: Any, X: float, where: str, T_s: float, omega_b: float) -> None:
    """Write the parameters to a record.

    Args:
        swings: options with H, D, droop, T_gov and S.
        X: the reactance, p.u. of the network, against which it swings.
        where, T_s, omega_b: as for `Dynamic.pack`.

    Raises:
        ValueError: it is too fast for T_s.
    """
    for name in SWING_PARAMETERS:
        record[name] = getattr(swings, name)
    swing = math.sqrt(omega_b / (2 * swings.H * swings.S * X))
    governor = math.sqrt(1 / (2 * swings.H * swings.droop * swings.T_gov))
    rate = max(swing, governor, swings.D / (2 * swings.H), 1 / swings.T_gov)
    if rate * T_s > STEP:
        raise ValueError(
            f"{where}: it swings at {rate:.6g} rad/s; allowed are"
            f" {STEP / T_s:.6g} rad/s at this T_s; raise S, H, T_gov or droop"
        )


def swing_matrix(
    H: float, D: float, droop: float, T_gov: float, S: float
) -> tuple[NDArray[np.float64], float]:
    """d/dt of (omega, power of the turbines) by themselves, (2, 2), and d(omega)/dt by a power that
    comes, p.u. of the network."""
    own = np.array([[-D / (2 * H), 1 / (2 * H)], [-1 / (droop * T_gov), -1 / T_gov]])
    return own, 1 / (2 * H * S)


@compiled
def _keep(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    one.energy_kept = one.energy


@compiled
def _go_back(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    one.energy = one.energy_kept


@compiled
def lead(now: Any, one: Any) -> None:
    """Set the frequency of a network without a grid by the machine that leads there."""
    if one.leads:
        now.omega_g = now.omega_g_to = one.omega
        now.omega_g_slope = one.slope


@compiled
def record_speed(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    """Give the speed that a run records."""
    field(now, "flow_omega")[one.source] = one.omega


KEPT = {"keep": _keep, "go_back": _go_back}
"""Hooks of a record that swings."""


@compiled
def swing_at_rest(one: Any, off: float, power: float) -> None:
    """Set turbines and governor so that nothing moves at a speed of 1 + off and a power that
    comes, p.u. of the network."""
    one.P_turbine = one.P_load + one.D * off - power / one.S
    one.P_set = one.P_turbine + off / one.droop


@compiled
def swing(one: Any, T_s: float, w: float) -> float:
    """Integrate over a tick by RK4 under the mean power of that tick, from an omega of 1 + w;
    returns the new w."""
    h = T_s
    power = one.energy / (h * one.S) - one.P_load
    P = one.P_turbine
    w_1, P_1 = slopes(one, w, P, power)
    w_2, P_2 = slopes(one, w + 0.5 * h * w_1, P + 0.5 * h * P_1, power)
    w_3, P_3 = slopes(one, w + 0.5 * h * w_2, P + 0.5 * h * P_2, power)
    w_4, P_4 = slopes(one, w + h * w_3, P + h * P_3, power)
    one.P_turbine = P + h / 6.0 * (P_1 + 2.0 * (P_2 + P_3) + P_4)
    one.energy = 0.0
    return w + h / 6.0 * (w_1 + 2.0 * (w_2 + w_3) + w_4)


@compiled
def slopes(one: Any, w: float, P: float, power: float) -> tuple[float, float]:
    """Return d/dt of omega - 1 = w and of the turbines' power P, under a power p.u. of the
    rating."""
    return ((P + power - one.D * w) / (2.0 * one.H), (one.P_set - w / one.droop - P) / one.T_gov)
