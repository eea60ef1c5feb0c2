"""Time on the processors of a real-time loop that others had, and who of them explains a stall."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gfm_hil.realtime.environment import virtual_machine

Method = Literal["trace", "proc"]
METHODS = {"trace": "by the kernel's trace", "proc": "by /proc"}
ROWS = np.dtype([("processor", "i4"), ("begin", "i8"), ("end", "i8"), ("ran", "i8"), ("who", "i4")])
STOPPED = "a signal that stopped it"
WAITS = "its own wait in the kernel"  # for memory, a disk, or a worker of a line
UNREAD = "not known: the kernel overwrote its trace before it was read"
_MOST = 0.5  # of a stall, that a name must explain


@dataclass(frozen=True)
class ProcessorTime:
    """Who had the processors, and when."""

    # "trace": the kernel's trace, so that begin and end are exact; "proc": two readings of /proc,
    # between which the time ``ran`` lay
    method: Method
    why: str = ""  # why there is no trace; "" if there is
    # of ``ROWS``, times in ns of CLOCK_MONOTONIC; ``who`` is an index into ``names``
    rows: NDArray[Any] = field(default_factory=lambda: np.zeros(0, ROWS))
    names: Sequence[str] = ()

    def who(self, begin_ns: int, end_ns: int, stall_ns: float, processors: Collection[int]) -> str:
        """Who explains most of a stall within this time, on one of these processors.

        If nobody explains half of it, it is ``nobody(method)``.
        """
        rows = self.rows[np.isin(self.rows["processor"], list(processors))]
        shared = np.minimum(rows["end"], end_ns) - np.maximum(rows["begin"], begin_ns)
        share = np.minimum(shared, rows["ran"]).clip(min=0)
        each = np.bincount(rows["who"], share, max(1, len(self.names)))
        best = int(np.argmax(each))
        return self.names[best] if each[best] >= _MOST * stall_ns else nobody(self.method)

    def totals(self) -> list[tuple[str, int, int]]:
        """(name, processor, ns) of all, the longest first."""
        sums: dict[tuple[str, int], int] = {}
        for row in self.rows:
            key = self.names[row["who"]], int(row["processor"])
            sums[key] = sums.get(key, 0) + int(row["ran"])
        return sorted(((*key, ns) for key, ns in sums.items()), key=lambda one: -one[2])


def nobody(method: Method) -> str:
    """What took the time if nobody did whom the kernel knows."""
    if method == "proc":
        return "not known from /proc"
    return "the host" if virtual_machine() != "no" else "firmware"


def collect(
    method: Method, rows: Iterable[tuple[int, int, int, int, str]], why: str = ""
) -> ProcessorTime:
    """From rows with names in place of their numbers."""
    names: dict[str, int] = {}
    listed = [(*row[:4], names.setdefault(row[4], len(names))) for row in rows]
    return ProcessorTime(method, why, np.array(listed, ROWS), [*names])
