"""The synchro-check of a breaker: it closes when the two sides agree for long enough.

The difference of their voltages, speeds and angles must stay within its limits. The speed is that
of the angle between them over a tick, through a low-pass of 20 ms as in a relay, which looks at
whole cycles. A side below 0.2 p.u. is dead: it has no angle, and the check does not close onto it;
nor does it close while an unbalanced fault is there.
"""

from __future__ import annotations

import math
from typing import Any

from gfm_plant.records import PlantRecords
from gfm_plant.solution import circuit, grid_source, machine_source
from gfm_runtime.compiled import compiled

NONE, WATCHING, AGREED, TIME_OVER = range(4)
"""What a check is doing."""

_FOLLOW_S = 0.02
_LEAST_V = 0.2  # p.u.


@compiled
def watch(plant: PlantRecords) -> None:
    """Look at the two sides after a tick, and say in ``check`` if the time has come."""
    n, now = plant.net[0], plant.now[0]
    a_r, a_i = _voltage(n, now, 0)
    b_r, b_i = _voltage(n, now, 1)
    a, b = math.sqrt(a_r * a_r + a_i * a_i), math.sqrt(b_r * b_r + b_i * b_i)
    angle = math.atan2(a_i * b_r - a_r * b_i, a_r * b_r + a_i * b_i)
    agree = min(a, b) > _LEAST_V and not n.unbalanced[circuit(n, now)]
    if agree and now.check_looks > 0:
        turned = angle - now.check_seen[2]
        turned -= 2.0 * math.pi * math.floor(turned / (2.0 * math.pi) + 0.5)
        part = 1.0 - math.exp(-n.T_s / _FOLLOW_S) if now.check_looks > 1 else 1.0
        now.check_seen[1] += part * (turned / n.T_s - now.check_seen[1])
    now.check_seen[0], now.check_seen[2] = a - b, angle
    now.check_looks = now.check_looks + 1 if agree else 0
    agree = now.check_looks > 1
    for j in range(3):
        agree = agree and abs(now.check_seen[j]) <= n.check_limits[j]
    now.check_lasted = now.check_lasted + n.T_s if agree else 0.0
    now.check_left -= n.T_s
    if now.check_lasted >= n.check_lasting - 0.5 * n.T_s:
        now.check = AGREED
    elif now.check_left < 0.5 * n.T_s:
        now.check = TIME_OVER


@compiled
def _voltage(n: Any, now: Any, side: int) -> tuple[float, float]:
    """Return the voltage of a side in the common frame, p.u."""
    c = circuit(n, now)
    v_r = v_i = 0.0
    for i in range(n.n_states):
        v_r += n.check_w[c, side, i] * now.w[i, 0]
        v_i += n.check_w[c, side, i] * now.w[i, 1]
    g = grid_source(n)
    by = now.V_g * n.check_s[c, side, g]
    if by != 0.0:
        for k in range(2):  # its two sequences
            s_r, s_i = by * now.sequence[k, 0], by * now.sequence[k, 1]
            v_r += s_r * now.unit[g + k, 0] - s_i * now.unit[g + k, 1]
            v_i += s_r * now.unit[g + k, 1] + s_i * now.unit[g + k, 0]
    for j in range(1, n.n_machines + 1):
        k = machine_source(n, j)
        v_r += n.check_s[c, side, k] * n.E[j] * now.unit[k, 0]
        v_i += n.check_s[c, side, k] * n.E[j] * now.unit[k, 1]
    return v_r, v_i
