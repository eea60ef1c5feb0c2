"""How far something can go until a loop is lost: a scan from where it is stable, then bisection.

The scan ends at the first loss. A loop that comes back further out is stable there, but the way
to it is not, and it is no margin.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

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
