"""The delay that a run measured, and whether a law's delay margin covers it.

u[k] acts on the emulated plant at its set delay after the tick that sampled y[k]. A u[k] that has
not arrived by the next tick is a miss: the plant holds the last u, which is older by the ticks
since then. This additional delay uses up the margin. The time from y[k] sent to u[k]
received shows how close a run is to misses.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.recording.run import Run
from gfm_hil.recording.timing import ROUND_TRIP, DurationHistogram, missed


@dataclass(frozen=True)
class LoopDelay:
    """What one run showed, in us."""

    set_us: float  # the delay that the scenario sets between y[k] and u[k] acting
    T_s_us: float  # the sampling time
    # ticks, misses: of the run; ``longest_hold``: misses in a row, ticks
    ticks: int
    misses: int
    longest_hold: int
    # percentiles of y[k] sent to u[k] received, of the ticks that were not missed; None in
    # lockstep, where nothing is measured in real time
    round_trip_us: dict[str, float] | None
    # percentiles of the age of y behind the u that acts, holds included. It is an upper bound: a
    # late u may have come before the next one in time
    acting_us: dict[str, float] | None
    beyond: int  # ticks in which it exceeded set_us + the margin

    def fits(self, margin_us: float) -> bool | None:
        """The margin covers every tick of the run; None if nothing was measured."""
        if self.acting_us is None:
            return None
        return self.acting_us["max"] - self.set_us < margin_us

    def words(self, margin_us: float) -> str:
        """The same in a sentence."""
        allowed = self.set_us + margin_us
        if self.acting_us is None:
            return (
                "the run was in lockstep: nothing was measured in real time, and u acted exactly "
                f"{self.set_us:g} us after its sample; the law allows {allowed:.4g} us"
            )
        worst = self.acting_us["max"]
        if not self.misses:
            return (
                f"fits: no tick was missed, u always acted {worst:g} us after its sample; the law "
                f"allows {allowed:.4g} us"
            )
        fits = self.fits(margin_us)
        verdict, acted = ("fits", "acted at most") if fits else ("does not fit", "may have acted")
        beyond = "" if fits else f", exceeded in {self.beyond} ticks"
        return (
            f"{verdict}: {self.misses} of {self.ticks} ticks missed, {self.longest_hold} in a row "
            f"at most, so u {acted} {worst:g} us after its sample; the law allows {allowed:.4g} us"
            f"{beyond}"
        )


def loop_delay(run: Run, set_s: float, margin_s: float) -> LoopDelay:
    """The delays of a run, compared with a margin. Raises UserError: the run lacks the plant's
    times.

    Args:
        run: with its times, if it was in real time.
        set_s: the delay that the scenario sets between y[k] and u[k] acting, s.
        margin_s: the additional delay that the law tolerates, s.
    """
    T_s = run.scenario.T_s
    set_us, T_s_us = 1e6 * set_s, 1e6 * T_s
    if run.summary["mode"] != "realtime":
        return LoopDelay(set_us, T_s_us, 0, 0, 0, None, None, 0)
    if not run.timing.keys() >= {*ROUND_TRIP.needs} or not run.ticks:
        raise UserError(f"{run.folder}: timing.npz lacks the plant's times")
    late = missed(run.timing)
    ages = _ages(~late)
    held = DurationHistogram.of([ages * round(1e9 * T_s)])
    return LoopDelay(
        set_us,
        T_s_us,
        run.ticks,
        int(late.sum()),
        int(ages.max()),
        ROUND_TRIP.histogram(run.timing, T_s).percentiles_us() or None,
        {name: round(set_us + us, 2) for name, us in held.percentiles_us().items()},
        int(np.sum(T_s_us * ages >= 1e6 * margin_s)),
    )


def _ages(there: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Ticks since the last u that came in time, at every tick."""
    k = np.arange(len(there))
    last = np.maximum.accumulate(np.where(there, k, -1))
    return k - last
