"""The delay that a run measured, and whether a law's delay margin covers it.

u[k] acts on the emulated plant at its set delay after the tick that sampled y[k]. A u[k] that has
not arrived by the next tick is a miss: the plant holds the last u, which is older by the ticks
since then. This additional delay uses up the margin. The time from y[k] sent to u[k]
received shows how close a run is to misses.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError

_PERCENTILES = {"p50": 50.0, "p99": 99.0, "p99.9": 99.9, "max": 100.0}
_FILES = ("scenario.toml", "timing.npz", "summary.json")


@dataclass(frozen=True)
class LoopDelay:
    """What one run showed, in us.

    Attributes:
        set_us: the delay that the scenario sets between y[k] and u[k] acting.
        T_s_us: the sampling time.
        ticks, misses: of the run; ``longest_hold``: misses in a row, ticks.
        round_trip_us: percentiles of y[k] sent to u[k] received, of the ticks that were not
            missed; None in lockstep, where nothing is measured in real time.
        acting_us: percentiles of the age of y behind the u that acts, holds included. It is an
            upper bound: a late u may have come before the next one in time.
        beyond: ticks in which it exceeded set_us + the margin.
    """

    set_us: float
    T_s_us: float
    ticks: int
    misses: int
    longest_hold: int
    round_trip_us: dict[str, float] | None
    acting_us: dict[str, float] | None
    beyond: int

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
        held = f"{self.misses} of {self.ticks} ticks missed, {self.longest_hold} in a row at most"
        if self.fits(margin_us):
            return (
                f"fits: {held}, so u acted at most {worst:g} us after its sample; the law allows "
                f"{allowed:.4g} us"
            )
        return (
            f"does not fit: {held}, so u may have acted {worst:g} us after its sample; the law "
            f"allows {allowed:.4g} us, exceeded in {self.beyond} ticks"
        )


def check_run(folder: Path) -> None:
    """See that a folder holds a run.

    Raises:
        UserError: it does not, or lacks a file.
    """
    if not folder.is_dir():
        raise UserError(f"--run {folder}: no such folder")
    missing = [name for name in _FILES if not (folder / name).is_file()]
    if missing:
        raise UserError(f"--run {folder}: not a finished run, lacks {', '.join(missing)}")


def read_loop_delay(folder: Path, set_s: float, T_s: float, margin_s: float) -> LoopDelay:
    """The delays of a run folder, to compare with a margin; all arguments in s.

    Raises:
        UserError: a file cannot be read or lacks the plant's times.
    """
    check_run(folder)
    try:
        mode = json.loads((folder / "summary.json").read_text(encoding="utf-8"))["mode"]
        with np.load(folder / "timing.npz") as file:
            timing = {n: file[n] for n in ("plant_sent", "plant_received") if n in file}
    except (OSError, ValueError, KeyError, TypeError) as problem:
        raise UserError(f"--run {folder}: cannot be read: {problem}") from None
    set_us, T_s_us = 1e6 * set_s, 1e6 * T_s
    if mode != "realtime":
        return LoopDelay(set_us, T_s_us, 0, 0, 0, None, None, 0)
    if not {"plant_sent", "plant_received"} <= timing.keys() or not len(timing["plant_sent"]):
        raise UserError(f"--run {folder}: timing.npz lacks the plant's times")
    sent, received = timing["plant_sent"], timing["plant_received"]
    there = received >= 0
    ages = _ages(there)
    acting = set_us + T_s_us * ages
    trip = _percentiles((received - sent)[there] / 1e3) if there.any() else None
    return LoopDelay(
        set_us,
        T_s_us,
        len(there),
        int(np.sum(~there)),
        int(ages.max()),
        trip,
        _percentiles(acting),
        int(np.sum(acting - set_us >= 1e6 * margin_s)),
    )


def _ages(there: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Ticks since the last u that came in time, at every tick."""
    k = np.arange(len(there))
    last = np.maximum.accumulate(np.where(there, k, -1))
    return k - last


def _percentiles(us: NDArray[Any]) -> dict[str, float]:
    return {name: round(float(np.percentile(us, q)), 2) for name, q in _PERCENTILES.items()}
