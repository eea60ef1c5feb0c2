"""A run's signals by their names in tests."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray


def unit(name: str) -> str:
    """The unit of a signal with a space before it; empty if it has none."""
    bare = name.rpartition("_")[0] and name.removeprefix("true_")
    known = {"f_hz": " Hz", "t": " s", "delta": " rad"}
    if name in ("tick", "law", "state", "trip") or bare == "trip":
        return ""
    return known.get(bare or name, " p.u.")


def same(one: Mapping[str, NDArray[Any]], other: Mapping[str, NDArray[Any]]) -> bool:
    """Whether both hold the same values up to the end of the shorter one."""
    length = min(len(one["tick"]), len(other["tick"]))
    return all(
        np.array_equal(one[name][:length], other[name][:length], equal_nan=True)
        for name in one
        if name in other
    )
