"""Weights of one's own, from a TOML file.

    [W_11]
    num = [1.0, 4.0]       # descending powers of s
    den = [1.0, 0.0004]

One table a weighted channel; a channel without a table does not count.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from gfm_design.performance import Weight
from gfm_runtime.errors import printable
from gfm_runtime.toml_file import read_toml

_DEGREE = 8


def read_weights(path: Path) -> tuple[Weight, ...]:
    """The weights of a file.

    Raises:
        ValueError: it cannot be read or is not TOML, or a weight in it cannot be; the first such
            is named.
    """
    content = read_toml(path)
    if not content:
        raise ValueError("holds no weight; e.g. [W_11] with num and den")
    return tuple(_weight(name, entry) for name, entry in content.items())


def _weight(name: str, entry: Any) -> Weight:
    found = re.fullmatch(r"W_([1-4])([12])", name)
    if not found:
        raise ValueError(f"{printable(name)}: a weight is W_ij, i = 1..4 of z and j = 1..2 of w")
    if not isinstance(entry, dict) or set(entry) != {"num", "den"}:
        raise ValueError(f"{name}: needs num and den, and nothing else")
    num, den = (_coefficients(f"{name}.{side}", entry[side]) for side in ("num", "den"))
    return Weight(int(found[1]), int(found[2]), num, den)


def _coefficients(where: str, value: Any) -> tuple[float, ...]:
    if not isinstance(value, list) or not 1 <= len(value) <= _DEGREE + 1:
        raise ValueError(f"{where}: must be a list of 1 to {_DEGREE + 1} numbers")
    if not all(isinstance(c, (int, float)) and not isinstance(c, bool) for c in value):
        raise ValueError(f"{where}: must be a list of 1 to {_DEGREE + 1} numbers")
    try:
        return tuple(float(c) for c in value)
    except OverflowError:
        raise ValueError(f"{where}: a number is too large") from None
