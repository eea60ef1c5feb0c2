"""Decimated samples in the format that PlotJuggler's ZeroMQ subscriber reads by default.

A message has two parts, topic and payload. The payload is one sample, a JSON object, whose numbers
become series named by their path, such as ``gfmhil/plant/y/p``. Its number ``timestamp`` is the
sample's time if PlotJuggler is set to use the field; else it uses the time of arrival. A third part
could hold the time too, but corrupts the payload in PlotJuggler (its pull request 1416).
"""

from __future__ import annotations

import json
import math
from functools import cache
from typing import Any

import numpy as np

from gfm_hil.core.roles import Role
from gfm_hil.ports.streams.follow import NewRows
from gfm_hil.recording.columns import recorded_in
from gfm_hil.recording.timing import SLACK, missed

_GROUPS = ("y", "u", "true", "ref")  # prefixes that become objects


def _place(column: str) -> tuple[str, str]:
    """Object and name of a column in a sample; the object is empty for a top-level column."""
    group, _, rest = column.partition("_")
    return (group, rest) if group in _GROUPS else ("", column)


@cache
def _places(role: Role, width: int) -> list[tuple[str, str]]:
    return [_place(name) for name in recorded_in(role, width)]


class Sampler:
    """Takes every n-th tick.

    Args:
        T_s: sampling time of the run, s.
        rate: samples per second, both of the run's time and of real time.
        misses: number of misses before the first row.
    """

    def __init__(self, T_s: float, rate: float, misses: int) -> None:
        self.T_s = T_s
        self._every = max(1, round(1 / (T_s * rate)))
        self._misses = misses
        self._least = math.nan  # least slack since the last sample, µs

    def messages(self, rows: NewRows, seconds: float) -> list[list[bytes]]:
        """The messages of some rows.

        Args:
            rows: new rows.
            seconds: the time in which they were recorded; for a run faster than real time fewer
                samples are sent.
        """
        faster = round(len(rows.signals) * self.T_s / seconds)  # factor against real time
        every = self._every * max(1, faster)
        plant, out, begin = rows.role == "plant", [], 0
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
            out.append([f"gfmhil/{rows.role}".encode(), json.dumps(sample).encode()])
        if plant:
            self._least = float(np.fmin.reduce(slack[begin:], initial=self._least))
        return out

    def _sample(self, rows: NewRows, k: int, values: list[float]) -> dict[str, Any]:
        """One tick's numbers; JSON cannot hold NaN or infinity."""
        tick = rows.first + k
        sample: dict[str, Any] = {"timestamp": round(tick * self.T_s, 9), "tick": tick}
        for (group, name), value in zip(_places(rows.role, len(values)), values, strict=True):
            if math.isfinite(value):
                (sample.setdefault(group, {}) if group else sample)[name] = value
        return sample
