"""How far something can go until a loop is lost: a scan from where it is stable, then bisection.

The scan ends at the first loss. A loop that comes back further out is stable there, but the way
to it is not, and it is no margin.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.sampled import SampledLoop, SampledPlant, outermost
from gfm_runtime.signals import NU, NY

_TOLERANCE = 1e-6  # relative, of what bisection ends with


def first_loss(radius: Callable[[float], float], values: Sequence[float]) -> float | None:
    """The last value known to be stable before the first loss; None if there is none.

    Args:
        radius: spectral radius at a value; 1 and more is lost, inf where nothing can be said.
        values: what to scan, from the nearest to the furthest; the first one is taken as stable.
    """
    held = values[0]
    for value in values[1:]:
        if radius(value) < 1.0:
            held = value
            continue
        lost = value
        while abs(lost - held) > _TOLERANCE * max(abs(lost), abs(held)):
            middle = 0.5 * (held + lost)
            if radius(middle) < 1.0:
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
    """The largest added delay that is looked at, s."""
    least, most = _SAMPLES
    return float(np.clip(_LONGEST_S, least * T_s, most * T_s))


def overall_delay(loop: SampledLoop) -> DelayMargin:
    """Margin for more delay of all of u at once."""
    return _margin(loop, np.ones(NU), np.zeros(NY))


def delay_at_u(loop: SampledLoop, channel: int) -> DelayMargin:
    """Margin for more delay of one command alone."""
    return _margin(loop, np.eye(NU)[channel], np.zeros(NY))


def delay_at_y(loop: SampledLoop, channel: int) -> DelayMargin:
    """Margin for a later reading of one measurement alone."""
    return _margin(loop, np.zeros(NU), np.eye(NY)[channel])


def _margin(loop: SampledLoop, u: Matrix, y: Matrix) -> DelayMargin:
    def later(seconds: float) -> SampledPlant:
        return loop.with_delay(u * seconds, y * seconds)

    def radius(seconds: float) -> float:
        return abs(outermost(loop.closed(later(seconds))))

    scan, step = [0.0], _STEP * loop.T_s
    while scan[-1] < longest(loop.T_s):
        scan.append(min(longest(loop.T_s), max(scan[-1] + step, scan[-1] * _RATIO)))
    held = first_loss(radius, scan)
    if held is None:
        return DelayMargin(np.inf, np.nan)
    z = outermost(loop.closed(later(held)))
    return DelayMargin(held, float(abs(np.angle(z)) / (2 * np.pi * loop.T_s)))
