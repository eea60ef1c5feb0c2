"""How much latency a law bears on its loop, and how much of that a measurement used.

Latency here is what the bench makes of it: u[k] acts at its set delay, or if it was late not at
all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gfm_design.margins.all_margins import UnstableLoop
from gfm_design.margins.delays import DelayMargin, longest, overall_delay
from gfm_design.misses.sequences import ProvedSequences, proved_in_a_row, proved_in_a_window
from gfm_design.misses.statistics import MeanSquare, Misses, most_misses
from gfm_design.misses.ticks import MEANWHILE, Meanwhile, Ticks, ticks
from gfm_design.misses.words import MOST, Word, Words
from gfm_design.model.closed_loop import Y_CARRIED, ClosedLoop

WINDOW = 10  # ticks
_AT_REST = 1e-6  # 1/s
Light = Literal["green", "yellow", "red"]
_HALF, _ALL = 0.5, 1.0  # of a tolerance


@dataclass(frozen=True)
class RowTolerance:
    """What the loop bears in one of the two cases of ``MEANWHILE``."""

    # the unstable word with the fewest misses; None if up to ``MOST`` in a row are borne
    lost: Word | None
    in_a_row: ProvedSequences  # for how many misses in a row every sequence is stable
    in_a_window: ProvedSequences  # for how many in any ``WINDOW`` ticks

    @property
    def bears(self) -> int:
        """Misses in a row of which no word is unstable; ``MOST`` if more are borne."""
        return MOST if self.lost is None else self.lost.misses - 1


@dataclass(frozen=True)
class LatencyTolerance:
    """What one loop bears of late and of lost commands.

    Attributes:
        T_s: s.
        delay: of all of u, on top of the set one.
        hold: misses in a row that the plant's late policy holds u for, then it blocks.
        extrapolate: for how many of them it continues u's trend.
        cases: by what the controller does in a miss.
        ticks: the matrices of each case.
    """

    T_s: float
    delay: DelayMargin
    hold: int
    extrapolate: int
    cases: Mapping[Meanwhile, RowTolerance]
    ticks: Mapping[Meanwhile, Ticks]

    @property
    def looked_at(self) -> float:
        """The longest additional delay that was tried, s."""
        return longest(self.T_s)

    @property
    def bears(self) -> int:
        """Ticks in a row without a new u, the lesser of both cases and of the late policy."""
        return min(self.hold, *(case.bears for case in self.cases.values()))

    @property
    def proved(self) -> int:
        """Ticks in a row without a new u for which every sequence is stable, in both cases."""
        return min(self.hold, *(case.in_a_row.most for case in self.cases.values()))

    @property
    def proved_in_window(self) -> int:
        """As ``proved``, in any ``WINDOW`` ticks."""
        return min(case.in_a_window.most for case in self.cases.values())

    def used(self, misses: Misses) -> Used:
        """How much of it a measurement used."""
        return used(self, misses)


def latency_tolerance(
    loop: ClosedLoop,
    hold: int = 200,
    extrapolate: int = 0,
    progress: Callable[[float], None] = lambda share: None,
) -> LatencyTolerance:
    """What a sampled loop bears; takes some seconds, of a network a minute.

    Args:
        loop: of a law and a plant, stable.
        hold, extrapolate: of the late policy, ticks.
        progress: called with the share of the work that is done.

    Raises:
        UnstableLoop: it is unstable without any miss.
        ValueError: the loop is continuous.
    """
    modes = loop.modes()
    if modes[0].sigma > -_AT_REST:
        raise UnstableLoop(modes[0])
    of: dict[Meanwhile, Ticks] = {case: ticks(loop, case, extrapolate) for case in MEANWHILE}
    cases = dict[Meanwhile, RowTolerance]()
    for k, case in enumerate(of):
        words = Words(of[case])
        lost = words.first_unstable()
        row = proved_in_a_row(words, lost.misses if lost else None)
        progress((k + 0.5) / len(of))
        window = proved_in_a_window(words, WINDOW, row.most)
        progress((k + 1) / len(of))
        cases[case] = RowTolerance(lost, row, window)
    assert loop.T_s is not None
    return LatencyTolerance(loop.T_s, overall_delay(loop), hold, extrapolate, cases, of)


@dataclass(frozen=True)
class Used:
    """Shares of a loop's tolerances that a measurement used; above 1: more than there is. None: it
    is not known, or there is no limit.

    Attributes:
        delay: mean age of u beyond the set delay, of the delay margin.
        in_a_row: longest row of misses, of those that are borne.
        in_a_window: most misses in ``WINDOW`` ticks, of those that are proved.
        share: share of missed ticks, of the one at which the mean square no longer decays.
        sigma: rate of the root of the mean square, the larger of both cases, 1/s.
        added: by which factor the variances of v_dc, p, q and V grow under white noise of the
            grid's voltage, the larger of both cases.
        refuted: words of so many misses in ``WINDOW`` ticks are unstable.
    """

    delay: float
    in_a_row: float
    in_a_window: float | None
    share: float | None
    sigma: float | None
    added: Mapping[str, float]
    refuted: bool = False

    @property
    def light(self) -> Light:
        """The verdict. Red: more than there is of a tolerance. Yellow: more than half, or more in a
        window than is proved. Green: less."""
        shares = [s for s in (self.delay, self.in_a_row, self.share) if s is not None]
        if self.refuted or max(shares) > _ALL or (self.sigma is not None and self.sigma >= 0.0):
            return "red"
        return light_of(min(max([*shares, self.in_a_window or 0.0]), _ALL))


def light_of(share: float) -> Light:
    """The verdict on the used share of a tolerance."""
    return "green" if share <= _HALF else "yellow" if share <= _ALL else "red"


def used(tolerance: LatencyTolerance, misses: Misses) -> Used:
    """How much of a tolerance a measurement used."""
    T_s, window, share, refuted = tolerance.T_s, None, None, False
    most = misses.most_in(WINDOW)
    if most is not None:
        window = _share(most, tolerance.proved_in_window)
        least = [case.in_a_window.refuted for case in tolerance.cases.values()]
        refuted = any(n is not None and most >= n for n in least)
    sigma, added = None, dict[str, float]()
    if not tolerance.extrapolate:
        chain, cases = misses.chain(), tolerance.ticks.values()
        each = [MeanSquare(of, chain) for of in cases]
        sigma = max(one.sigma() for one in each)
        plain = each[0].without().variance()
        worst = np.max([one.variance() for one in each], axis=0)
        among = [k for k, name in enumerate(Y_CARRIED[: len(plain)]) if name != "omega_u"]
        added = {Y_CARRIED[k]: float(worst[k] / plain[k]) for k in among if plain[k] > 0.0}
        limits = [s for of in cases if (s := most_misses(of, chain.continues)) is not None]
        share = _share(chain.share, min(limits)) if limits else None
    delay = misses.mean_age * T_s / tolerance.delay.seconds
    row = _share(misses.longest, tolerance.bears)
    return Used(delay, row, window, share, sigma, added, refuted)


def _share(of: float, tolerated: float) -> float:
    return 0.0 if of == 0 else of / tolerated if tolerated else np.inf
