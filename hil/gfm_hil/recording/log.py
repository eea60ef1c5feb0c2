"""The log of a run, one JSON object per line, and the outcome that follows from it."""

from __future__ import annotations

import contextlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from gfm_hil.core.errors import UserError
from gfm_plant.names import CONTROLLER_LEFT, CONTROLLER_SAFE
from gfm_runtime.states import PLANT_TRIP, REASONS

Status = Literal["completed", "oscillating", "tripped", "safe", "interrupted"]

PLANT_LEFT = "the plant ended before the scenario did"

#: reasons with which a role reports what the other role did
_SECONDARY = (REASONS[PLANT_TRIP], PLANT_LEFT, CONTROLLER_LEFT, CONTROLLER_SAFE)

SEVERITY: tuple[Status, ...] = ("completed", "oscillating", "interrupted", "safe", "tripped")


@dataclass(frozen=True)
class Outcome:
    """How a run ended: status, reason in words, and the tick."""

    status: Status
    reason: str
    tick: int


def read_log(*paths: Path) -> list[dict[str, Any]]:
    """The lines of one or more logs, in order of their ticks.

    It skips damaged lines: the last line of a process that was killed may be incomplete.
    """
    lines: list[dict[str, Any]] = []
    for path in paths:
        if path.is_file():
            for text in path.read_text("utf-8", errors="replace").splitlines():
                with contextlib.suppress(ValueError, RecursionError):
                    line = json.loads(text)
                    if isinstance(line, dict) and isinstance(line.get("tick"), int):
                        lines.append(line)
    return sorted(lines, key=lambda line: line["tick"])


def read_events(folder: Path) -> list[dict[str, Any]]:
    """The log of a run folder, or of a run in progress what its roles have written so far."""
    whole = folder / "events.jsonl"
    return read_log(whole) if whole.is_file() else read_log(*folder.glob("events_*.jsonl"))


def event_text(event: dict[str, Any]) -> str:
    """The content of a line of the log besides its kind, as a short text."""
    if "label" in event:
        return str(event["label"])
    rest = {k: v for k, v in event.items() if k not in ("tick", "t", "event")}
    return ", ".join(f"{key} {value}" for key, value in rest.items())


def read_summary(folder: Path) -> dict[str, Any]:
    """The content of a run's summary.json.

    Raises:
        FileNotFoundError: the run is not over, or was killed.
        UserError: the file is not a summary.
    """
    path = folder / "summary.json"
    try:
        content = json.loads(path.read_text("utf-8"))
        _ = content["status"], content["reason"]
    except (ValueError, TypeError, KeyError, RecursionError):
        raise UserError(f"{path}: is not the summary of a run") from None
    return dict(content)


def cause(reasons: list[str]) -> str:
    """The first reason that does not only report what the other role did, or else the first."""
    return next((reason for reason in reasons if reason not in _SECONDARY), reasons[0])


def worst(lines: list[dict[str, Any]], outside: Outcome | None) -> Outcome:
    """The most severe of the outcomes that the roles wrote and the one seen from ``outside``. Of
    equally severe ones, that from outside, or that of the role where the cause occurred, which may
    say more. What a controller calls the plant's trip counts only if nobody else has a reason: the
    bridge is also blocked when the plant lost its controller."""
    ends = [Outcome(e["status"], e["reason"], e["tick"]) for e in lines if e["event"] == "end"]
    found = [outside, *ends] if outside else ends
    if not found:
        return Outcome("safe", "the run was cut off: no process recorded its end", 0)
    own = [o for o in found if o.reason != REASONS[PLANT_TRIP]]
    found = own if any(o.status != "completed" for o in own) else found
    first = max(found, key=lambda o: (SEVERITY.index(o.status), o.reason not in _SECONDARY))
    return next((o for o in found if o.reason.startswith(f"{first.reason}: ")), first)
