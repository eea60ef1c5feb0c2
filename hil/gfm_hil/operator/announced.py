"""Which desks there are in a run folder; a killed side leaves its announcement behind."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from gfm_hil import scratch
from gfm_hil.links.base import SIDES, Side

SCHEME = "ipc://"
LARGEST = 65536  # bytes of a command, and of its answer


def announcement(folder: Path, side: Side) -> Path:
    """Where a side's desk says how it is reached."""
    return folder / f"desk_{side}.json"


def announced(folder: Path, side: Side) -> dict[str, Any] | None:
    """What a side's desk announces, or None if there is none that lives."""
    try:
        found = json.loads(announcement(folder, side).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    place = Path(str(found["endpoint"]).removeprefix(SCHEME)).parent
    return dict(found) if scratch.held(place) else None


def present(folder: Path) -> list[Side]:
    """The sides that have a desk that lives."""
    return [side for side in SIDES if announced(folder, side) is not None]
