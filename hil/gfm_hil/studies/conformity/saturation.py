"""Which clauses are judged while a limiter of the controller acts: their verdict is then about the
limiter as much as about the law."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gfm_hil.recording.run import Run
from gfm_hil.studies.conformity.verdict import Verdict
from gfm_runtime import load_law


def mark_saturation(run: Run, verdicts: Sequence[Verdict], ours: bool) -> list[Verdict]:
    """The verdicts, each with the part of its window in which a limiter of the inner stage acts.

    Args:
        ours: whether a law computed u, so that its stage is known; otherwise only the recorded
            limit of the current counts.
    """
    acting = _limiters(run, ours)
    T_s = run.scenario.T_s
    found = []
    for v in verdicts:
        first, last = round(v.start / T_s), max(round(v.stop / T_s), round(v.start / T_s) + 1)
        parts = {
            name: float(np.mean(on[first:last]))
            for name, on in acting.items()
            if any(on[first:last])
        }
        found.append(replace(v, saturated=parts))
    return found


def _limiters(run: Run, ours: bool) -> dict[str, NDArray[np.bool_]]:
    """At which ticks the limits of current and power act, by name."""
    found: dict[str, NDArray[np.bool_]] = {}
    if "limited" in run.signals:
        found["current"] = run.signals["limited"] == 1
    stage = load_law(run.scenario.law, run.scenario.inner).laws[0].inner if ours else None
    if stage is not None and stage.power is not None:
        acts = np.zeros(run.ticks, np.bool_)
        for sign, limit in ((1.0, stage.P_max), (-1.0, stage.P_min)):
            if math.isfinite(limit):
                over = sign * (np.asarray(run.signals["y_p"], np.float64) - limit)
                # x[k] = max(x[k-1] + step, 0) is the sum less its least value so far
                steps = np.cumsum(run.scenario.T_s * stage.power.k_i * over)
                integral = steps - np.minimum(np.minimum.accumulate(steps), 0.0)
                acts |= stage.power.k_p * over + integral > 0.0
        found["power"] = acts
    return found
