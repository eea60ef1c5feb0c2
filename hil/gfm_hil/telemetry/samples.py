"""Decimated samples as PlotJuggler's ZeroMQ subscriber reads them with its defaults.

Two parts a message, topic and payload; the payload is one JSON object, one sample, whose numbers
become series by their path, as ``gfmhil/plant/y/p``. The time is the number ``timestamp`` in it:
PlotJuggler takes it for the sample's time if told to use the field, else the time of arrival. A
third part may be the time, too, but spoils the payload in PlotJuggler (its pull request 1416).
"""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from gfm_hil.recording.columns import SIGNALS_OF
from gfm_hil.recording.timing import SLACK, missed
from gfm_hil.telemetry.follow import Rows

_GROUPS = ("y", "u", "true", "ref")  # prefixes that become objects


def _place(column: str) -> tuple[str, str]:
    """Object and name of a column in a sample; no object for one that stands by itself."""
    group, _, rest = column.partition("_")
    return (group, rest) if group in _GROUPS else ("", column)


_PLACES = {side: [_place(name) for name in names] for side, names in SIGNALS_OF.items()}


class Sampler:
    """Takes every n-th tick.

    Args:
        T_s: sampling time of the run, s.
        rate: samples a second, of the run's time and of ours.
        misses: before the first row.
    """

    def __init__(self, T_s: float, rate: float, misses: int) -> None:
        self.T_s = T_s
        self._every = max(1, round(1 / (T_s * rate)))
        self._misses = misses
        self._least = math.nan  # slack since the last sample, µs

    def messages(self, rows: Rows, seconds: float) -> list[list[bytes]]:
        """The messages of some rows.

        Args:
            rows: new ones.
            seconds: that they took to be recorded; a run faster than real time is thinned out.
        """
        faster = round(len(rows.signals) * self.T_s / seconds)  # than real time
        every = self._every * max(1, faster)
        plant, out, begin = rows.side == "plant", [], 0
        if plant:
            misses = self._misses + np.cumsum(missed(rows.columns))
            self._misses = int(misses[-1])
            slack = SLACK.us(rows.columns, self.T_s)
        for k in range(-rows.first % every, len(rows.signals), every):
            values = rows.signals[k].tolist()
            if math.isnan(values[0]):  # a tick whose frame was lost
                continue
            sample = self._sample(rows, k, values)
            if plant:
                sample["misses"] = int(misses[k])
                least = float(np.fmin.reduce(slack[begin : k + 1], initial=self._least))
                if math.isfinite(least):
                    sample["slack_us"] = round(least, 3)
                self._least, begin = math.nan, k + 1
            out.append([f"gfmhil/{rows.side}".encode(), json.dumps(sample).encode()])
        if plant:
            self._least = float(np.fmin.reduce(slack[begin:], initial=self._least))
        return out

    def _sample(self, rows: Rows, k: int, values: list[float]) -> dict[str, Any]:
        """One tick's numbers; JSON has none that are not finite."""
        tick = rows.first + k
        sample: dict[str, Any] = {"timestamp": round(tick * self.T_s, 9), "tick": tick}
        for (group, name), value in zip(_PLACES[rows.side], values, strict=True):
            if math.isfinite(value):
                (sample.setdefault(group, {}) if group else sample)[name] = value
        return sample
