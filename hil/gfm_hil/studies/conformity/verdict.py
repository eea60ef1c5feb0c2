"""The verdict on a clause."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

Outcome = Literal[
    "pass", "fail", "cannot judge", "limited", "consistent with itself", "informative"
]
PASS: Final = "pass"
FAIL: Final = "fail"
CANNOT: Final = "cannot judge"
# what is neither a pass nor a failure, and counts as none:
LIMITED: Final = "limited"  # its target is beyond the rating: judged on the limiter
CONSISTENT: Final = "consistent with itself"  # as measured on the converter, nothing declared
INFORMATIVE: Final = "informative"  # no law can be judged by it
SIGNS = {PASS: "✓", FAIL: "✗", CANNOT: "?", LIMITED: "L", CONSISTENT: "=", INFORMATIVE: "i"}


@dataclass(frozen=True)
class Verdict:
    """What became of one clause at one time."""

    clause: str  # what is asked
    kind: str  # of the criterion
    signal: str  # that was judged; may be empty
    start: float  # start, stop: of the window, s
    stop: float
    verdict: Outcome
    value: float | None  # measured, in ``unit``; None if there is none
    unit: str  # of the value
    limit: str  # of the value, with its unit
    text: str  # one sentence
    # low, high: limits of the signal itself between ``limited`` s, for the figure
    low: float | None = None
    high: float | None = None
    limited: tuple[float, float] | None = None  # from when to when they hold, s
    # t, s, and limits that change with it, shape (K,) each, for the figure
    curve: tuple[Vector, Vector, Vector] | None = None
    source: str = ""  # document, clause and revision that ask for it
    known: str = ""  # how the limit is known: read, summary, memory or ours
    # part of the window in which each limiter of the controller acts, by the name of what it
    # limits; those that never act are not there
    saturated: dict[str, float] = field(default_factory=dict)

    def plain(self) -> dict[str, Any]:
        """As data for JSON."""
        return {name: x for name, x in asdict(replace(self, curve=None)).items() if name != "curve"}


def worst(outcomes: Sequence[str]) -> Outcome:
    """fail, cannot judge, limited, consistent with itself, pass, informative, in this order; no
    outcome at all cannot be judged."""
    order: tuple[Outcome, ...] = (FAIL, CANNOT, LIMITED, CONSISTENT, PASS, INFORMATIVE)
    return next((outcome for outcome in order if outcome in outcomes), CANNOT)
