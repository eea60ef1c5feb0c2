"""The synchro-check of a breaker: it closes when the two sides agree for long enough.

The difference of their voltages, speeds and angles must stay within its limits. The speed is that
of the angle between them over a tick, through a low-pass of 20 ms as in a relay, which looks at
whole cycles. A side below 0.2 p.u. is dead: it has no angle, and the check does not close onto it;
nor does it close while an unbalanced fault is there.
"""

import math

from gfm_plant.layout import field
from gfm_plant.protection import LEAST_V, turn
from gfm_plant.records import PlantRecords
from gfm_plant.solution import circuit, node_voltage
from gfm_runtime.compiled import compiled

NONE, WATCHING, AGREED, TIME_OVER = range(4)
"""What a check is doing."""

_FOLLOW_S = 0.02


@compiled
def watch(plant: PlantRecords) -> None:
    """Look at the two sides after a tick, and say in ``check`` if the time has come."""
    n, now = plant.net[0], plant.now[0]
    one, other = node_voltage(n, now, 0, 0.0), node_voltage(n, now, 1, 0.0)
    a = math.sqrt(one.real * one.real + one.imag * one.imag)
    b = math.sqrt(other.real * other.real + other.imag * other.imag)
    angle = turn(other, one)
    agree = min(a, b) > LEAST_V and not field(n, "unbalanced")[circuit(n, now)]
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
