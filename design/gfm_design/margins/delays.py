"""Delay margins: a scan from a stable value to the first unstable one, then bisection.

The scan ends at the first unstable value, even if the loop is stable again at larger ones: it
could not get there without becoming unstable.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.closed_loop import ClosedLoop

_TOLERANCE = 1e-6  # relative accuracy of the bisection


def first_loss(sigma: Callable[[float], float], values: Sequence[float]) -> float | None:
    """The last value known to be stable before the first unstable one; None if all are stable.

    Args:
        sigma: largest growth rate at a value; unstable from 0 on, inf if there is no loop.
        values: to scan, from the nearest to the furthest; the first one counts as stable.
    """
    held = values[0]
    for value in values[1:]:
        if sigma(value) < 0.0:
            held = value
            continue
        lost = value
        while abs(lost - held) > _TOLERANCE * max(abs(lost), abs(held)):
            middle = 0.5 * (held + lost)
            if sigma(middle) < 0.0:
                held = middle
            else:
                lost = middle
        return held
    return None


Matrix = NDArray[np.float64]

_LONGEST_S, _SAMPLES = 0.01, (50, 300)  # how far it is looked at: s, and at least, at most
_STEP, _RATIO = 0.25, 1.02  # samples; from one point of the scan to the next


@dataclass(frozen=True)
class DelayMargin:
    """seconds: what may be added, inf if more than ``longest``; frequency_hz: of the mode that is
    lost there, Hz."""

    seconds: float
    frequency_hz: float


def longest(T_s: float) -> float:
    """The largest added delay of the scan, s."""
    least, most = _SAMPLES
    return float(np.clip(_LONGEST_S, least * T_s, most * T_s))


def overall_delay(loop: ClosedLoop) -> DelayMargin:
    """Margin for more delay of all of u at once; 0 for an unstable loop."""
    return _margin(loop, np.ones(loop.u_delay.shape), np.zeros(1))


def delay_at_u(loop: ClosedLoop, channel: int) -> DelayMargin:
    """Margin for more delay of one command only."""
    return _margin(loop, np.eye(len(loop.u_delay))[channel], np.zeros(1))


def delay_at_y(loop: ClosedLoop, channel: int) -> DelayMargin:
    """Margin for more delay of one measurement only."""
    return _margin(loop, np.zeros(1), np.eye(len(loop.y_delay))[channel])


def _margin(loop: ClosedLoop, u: Matrix, y: Matrix) -> DelayMargin:
    if loop.T_s is None:
        raise ValueError("a delay margin is that of a sampled loop; sample it first")
    if loop.sigma() >= 0.0:
        return DelayMargin(0.0, np.nan)

    def later(seconds: float) -> ClosedLoop:
        return loop.later(u * seconds, y * seconds)

    scan, step = [0.0], _STEP * loop.T_s
    while scan[-1] < longest(loop.T_s):
        scan.append(min(longest(loop.T_s), max(scan[-1] + step, scan[-1] * _RATIO)))
    held = first_loss(lambda seconds: later(seconds).sigma(), scan)
    if held is None:
        return DelayMargin(np.inf, np.nan)
    return DelayMargin(held, later(held).modes()[0].frequency_hz)
