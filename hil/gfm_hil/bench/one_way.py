"""One-way delays, from the readings of both sides' clocks in each exchange.

An exchange leaves here at t1, is heard there at t2, answered at t3, and is back at t4. If nothing
is known of the two clocks, their difference lies between t3 - t4 and t2 - t1 (F. Cristian,
"Probabilistic clock synchronization", 1989): the quickest exchanges say it to half of their round
trip, less the time between t2 and t3. Whether the ways there and back are equally long cannot be
measured so.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from gfm_hil.bench.histogram import histogram, summary_of_counts

Numbers = NDArray[np.int64]
#: columns of the readings of an exchange: the deadline or t1, t1, t2, t3, t4; -1: there is none
DUE, SENT, HEARD, ANSWERED, RECEIVED = range(5)
_STRETCHES = 16  # of a round: the quickest exchange of each says how the clocks drift
_FEW = 64  # with fewer exchanges the drift of the clocks is not estimated
_FASTEST = 1e6  # ns of drift in a second
STEPPED = "a clock stepped"


class Offset(NamedTuple):
    """The answerer's clock less ours."""

    ns: NDArray[np.float64]  # in each exchange, shape (n,)
    within_ns: float  # how far it may be off
    clock: str  # how it is known


def offset(stamps: Numbers, one_clock: bool, tai_ns: float = 0.0) -> Offset:
    """The clocks' difference, from answered exchanges, shape (n, 5), n > 0.

    Args:
        one_clock: both sides say that they are on one machine.
        tai_ns: both clocks are CLOCK_TAI, and no further apart than this; 0: they are not.
    """
    there, back = stamps[:, HEARD] - stamps[:, SENT], stamps[:, RECEIVED] - stamps[:, ANSWERED]
    none = np.zeros(len(stamps))
    if one_clock and min(there.min(), back.min()) >= 0:
        return Offset(none, 0.0, "one clock")
    if tai_ns > 0:
        agree = min(there.min(), back.min()) >= -tai_ns
        return Offset(none, tai_ns, "CLOCK_TAI" if agree else STEPPED)
    trip, middle = (there + back).astype(float), (there - back) / 2
    when = 1e-9 * (stamps[:, SENT] - stamps[0, SENT])
    count = _STRETCHES if len(stamps) >= _FEW else 1
    quick = np.array([p[np.argmin(trip[p])] for p in np.array_split(np.arange(len(trip)), count)])
    line = np.polyfit(when[quick], middle[quick], min(1, count - 1), w=1 / (trip[quick] + 1))
    ns = np.polyval(line, when)
    within = trip.min() / 2 + float(np.abs(ns - middle)[quick].max())
    # each exchange bounds the difference: if no line is within all bounds, a clock has stepped
    beyond = max((ns - there).max(), (-back - ns).max())
    steady = beyond <= trip.min() / 2 and (count == 1 or abs(line[0]) < _FASTEST)
    return Offset(ns, within, "quickest exchanges" if steady else STEPPED)


def delays(stamps: Numbers, one_clock: bool, tai_ns: float = 0.0) -> dict[str, Any]:
    """What a round of exchanges says, answered or not, shape (n, 5): how many there were and were
    ``lost``; with readings of the answerer's clock also ``clock`` and ``within_ns`` of ``offset``,
    and the histograms of the ways ``there`` and ``back`` and of the time ``between`` them, ns."""
    answered = stamps[stamps[:, RECEIVED] >= 0]
    said: dict[str, Any] = {"sent": len(stamps), "lost": len(stamps) - len(answered)}
    if not len(answered) or (answered[:, HEARD] <= 0).any():
        return said
    known = offset(answered, one_clock, tai_ns)
    said |= {"clock": known.clock, "within_ns": known.within_ns}
    said["between"] = histogram(answered[:, ANSWERED] - answered[:, HEARD])
    if known.clock != STEPPED:
        to = np.rint(known.ns).astype(np.int64)
        said["there"] = histogram(answered[:, HEARD] - to - answered[:, SENT])
        said["back"] = histogram(answered[:, RECEIVED] - answered[:, ANSWERED] + to)
    return said


def ways(rounds: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What ``delays`` says of rounds, for the row of a table: ``sent``, ``lost``, its share and the
    interval in which that is with 95 % (Clopper and Pearson); ``clock`` and ``within_us``; and
    ``there``, ``back`` and ``between``, each as ``summary_of_counts``."""
    sent, lost = (sum(one[key] for one in rounds) for key in ("sent", "lost"))
    interval = binomtest(lost, sent).proportion_ci() if sent else (0.0, 1.0)
    shares = [lost / max(sent, 1), *interval]
    lost_pct, *ends = (round(100 * float(share), 4) for share in shares)
    row: dict[str, Any] = {"sent": sent, "lost": lost, "lost_pct": lost_pct, "lost_pct_95": ends}
    known = [one for one in rounds if "clock" in one]
    if known:
        clocks = {one["clock"] for one in known}
        row["clock"] = STEPPED if STEPPED in clocks else " / ".join(sorted(clocks))
        row["within_us"] = round(max(one["within_ns"] for one in known) / 1e3, 3)
    for way in ("there", "back", "between"):
        row[way] = summary_of_counts([one[way] for one in rounds if way in one])
    return row
