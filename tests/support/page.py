"""What a page of ours shows."""

import base64
import json
import re
import zlib
from typing import Any

import numpy as np


def unpacked(page: str) -> list[dict[str, Any]]:
    """The plots of a page with their curves, decoded as its script does."""
    plots, packed = (
        re.findall(rf'<script type="[^"]*" id="{name}">(.*?)</script>', page, re.DOTALL)[0]
        for name in ("plots", "curves")
    )
    steps = np.frombuffer(zlib.decompress(base64.b64decode(packed)), "<u2").astype(np.int64)

    def abscissa(first: int, count: int, low: float, step: float, whole: bool = False) -> Any:
        if not whole:
            return curve(first, count, low, step)
        return low + step * np.cumsum(steps[first : first + count])

    def curve(first: float, count: float, low: float, high: float) -> np.ndarray:
        level = np.cumsum(steps[int(first) : int(first + count)]) & 0xFFFF
        return np.where(level == 0xFFFF, np.nan, low + (high - low) * level / 4094)

    found = json.loads(plots)
    for plot in found:
        plot["x"] = abscissa(*plot["x"])
        plot["curves"] = {label: curve(*packed) for label, *packed in plot["curves"]}
    return list(found)
