"""Causes of missed ticks, from the times that both sides recorded.

A tick is missed if u[k] has not arrived at the plant by the next deadline. Its time has four parts;
the part that exceeds its usual time in a met tick by most is the cause:

- late wake-up: the plant began after its deadline, though it had no other work;
- own work: the plant's or the controller's computation, or an event at the tick;
- stalled host: a side that polled for a frame, or computed, did not run for a while, or the
  controller overslept: the host of a virtual machine, the kernel or other work used its processor;
- link: the rest, from y[k] measured to u[k] received, with the calls of the kernel that send.

If a tick began while a side was still late from the missed tick before it, it has the same cause.
Where somebody watched the processors (``gfm_hil.run.stalls``), what stood still also gets a name,
and a tick is not the link's if something else had a processor for most of what it lacked.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gfm_hil.realtime.clock import AHEAD_NS
from gfm_hil.run.processor_time import ProcessorTime, nobody

CAUSES = ("own work", "link", "late wake-up", "stalled host")
_OWN, _LINK, _WAKE, _STALL = range(len(CAUSES))
#: causes that are neither the kernel's nor the host's
OURS = (CAUSES[_OWN], CAUSES[_LINK])

_INTERRUPTED = 10.0  # times the 99th percentile of computation: it was interrupted
_AFTER_EVENT = 2  # ticks that an event may delay: it is carried out between two of them

Times = NDArray[np.int64]
Timing = Mapping[str, Times]


def missed_ticks(timing: Timing) -> Times:
    """Ticks of a run in real time whose u had not arrived by the next deadline."""
    return np.flatnonzero(timing["plant_received"] < 0)


class Attribution(NamedTuple):
    """The cause of each missed tick; arrays of the shape of ``missed_ticks``."""

    causes: Times  # index into ``CAUSES``
    names: list[str]  # who took the time; "" if it was the run itself, or if nobody watched


def attribute(
    timing: Timing, T_ns: int, events: Iterable[int] = (), taken: ProcessorTime | None = None,
    processors: Collection[int] = (),
) -> Attribution:  # fmt: skip
    """Find the cause of each missed tick of a run in real time.

    Args:
        timing: arrays of ``timing.npz``, each (ticks,), of successive ticks.
        T_ns: sampling time.
        events: ticks of events.
        taken: who had the processors of both sides, if anybody watched.
        processors: those of both sides.
    """
    missed = missed_ticks(timing)
    causes, usual = _by_clocks(timing, T_ns, missed)
    at_event = {k + after for k in events for after in range(_AFTER_EVENT)}
    sent, answered = timing["plant_sent"], timing["controller_sent"]
    follows = [
        n > 0 and missed[n - 1] == k - 1 and bool(causes[n] == _WAKE or answered[k - 1] > sent[k])
        for n, k in enumerate(missed)
    ]
    names = [""] * len(missed)
    first = [n for n, behind in enumerate(follows) if not behind]
    for n, end in pairwise([*first, len(missed)]):
        k, last = int(missed[n]), int(missed[end - 1])
        if k in at_event:
            causes[n] = _OWN
        elif taken is not None:
            begin, until = timing["plant_scheduled"][[k, last]]
            lacked = (end - n) * T_ns - usual
            who = taken.who(begin - AHEAD_NS, until + 2 * T_ns, lacked, processors)
            if who != nobody(taken.method):
                causes[n] = _STALL if causes[n] in (_OWN, _LINK) else causes[n]
            if causes[n] in (_WAKE, _STALL):
                names[n:end] = [who] * (end - n)
        causes[n:end] = causes[n]
    return Attribution(causes, names)


def _by_clocks(timing: Timing, T_ns: int, missed: Times) -> tuple[Times, float]:
    """The cause of each missed tick by itself; and the usual time from a deadline to the answer,
    ns."""
    shares = _parts(timing, T_ns)
    there = timing["plant_received"] >= 0
    excess, whole = np.zeros((len(CAUSES), len(missed))), 0.0
    for cause, part in shares.items():
        usual = float(np.median(part[there])) if there.any() else 0.0
        excess[cause] = part[missed] - usual
        whole += usual if cause != _STALL else 0.0
    own = shares[_OWN]
    limit = _INTERRUPTED * (np.quantile(own, 0.99) if len(own) else 0.0)
    interrupted = own[missed] > limit
    excess[_STALL, interrupted] += excess[_OWN, interrupted]
    excess[_OWN, interrupted] = 0.0
    excess[_LINK] -= excess[_STALL].clip(min=0)  # a gap between polls is part of the wait
    return np.argmax(excess, axis=0), whole


def _parts(timing: Timing, T_ns: int) -> dict[int, NDArray[np.float64]]:
    """Time of each cause in every tick, ns; a missed tick lasts until the next deadline."""
    due, woke = timing["plant_scheduled"], timing["plant_woke"]
    measured, sent = timing["plant_measured"], timing["plant_sent"]
    heard, computed = timing["controller_received"], timing["controller_computed"]
    received = timing["plant_received"]
    worked = np.where((heard >= 0) & (computed >= 0), computed - heard, 0)
    end = np.where(received >= 0, received, np.maximum(due + T_ns, sent))
    zero = np.zeros(len(due), np.int64)
    gap = np.maximum(timing.get("plant_stall", zero), _away(timing, sent, end))
    parts = {
        _OWN: measured - woke + worked, _LINK: end - measured - worked, _WAKE: woke - due,
        _STALL: gap,
    }  # fmt: skip
    return {cause: part.clip(min=0).astype(float) for cause, part in parts.items()}


def _away(timing: Timing, begin: Times, end: Times) -> Times:
    """How long the controller may not have polled between two times of each tick, ns.

    The controller records its longest gap since the last frame with the next frame that it takes.
    The position of the gap between the two frames is unknown: it counts as far as it fits.
    """
    heard = timing["controller_received"]
    gap = timing.get("controller_stall", np.zeros(len(heard), np.int64))
    away = np.zeros(len(heard), np.int64)
    taken = np.flatnonzero(heard >= 0)
    if not len(taken):
        return away
    back = heard[taken]  # ascending: frames arrive in order
    since = np.concatenate([[0], back[:-1]])
    first = np.searchsorted(back, begin, side="right")
    for wait in (first, first + 1):  # the wait during which y came, and the next one
        k = np.minimum(wait, len(back) - 1)
        fits = np.minimum(back[k], end) - np.maximum(since[k], begin)
        away += np.where(wait < len(back), np.minimum(gap[taken][k], fits).clip(min=0), 0)
    return away


def counts(causes: Times) -> dict[str, int]:
    """How many ticks each cause has."""
    return {name: int(np.sum(causes == k)) for k, name in enumerate(CAUSES)}


def bursts(runs: Iterable[Times]) -> list[tuple[int, int]]:
    """(length, number of bursts of it), from the missed ticks of runs, each in ascending order."""
    lengths = Counter[int]()
    for missed in runs:
        ends = np.flatnonzero(np.diff(missed, append=-1) != 1)
        lengths.update(np.diff(ends, prepend=-1).tolist())
    return sorted(lengths.items())
