"""The log of a run: one JSON object a line, and how the run ended by what its two roles wrote."""

from __future__ import annotations

import contextlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from gfm_hil.core.errors import UserError
from gfm_plant.names import CONTROLLER_SAFE
from gfm_runtime.states import PLANT_TRIP, REASONS

Status = Literal["completed", "tripped", "safe", "interrupted"]

PLANT_LEFT = "the plant ended before the scenario did"

CONTROLLER_LEFT = "the controller was stopped"

_HEARSAY = (REASONS[PLANT_TRIP], PLANT_LEFT, CONTROLLER_LEFT, CONTROLLER_SAFE)

SEVERITY: tuple[Status, ...] = ("completed", "interrupted", "safe", "tripped")


@dataclass(frozen=True)
class Outcome:
    """How a run ended: status, reason in words, and the tick."""

    status: Status
    reason: str
    tick: int


def read_log(*paths: Path) -> list[dict[str, Any]]:
    """The lines of one or more logs, in order of their ticks.

    A line that is damaged, as the last one of a side that was killed may be, is left out.
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
    """The log of a run folder; while the run goes on, what its sides have written so far."""
    whole = folder / "events.jsonl"
    return read_log(whole) if whole.is_file() else read_log(*folder.glob("events_*.jsonl"))


def event_text(event: dict[str, Any]) -> str:
    """What a line of the log says beyond its kind, in a few words."""
    if "label" in event:
        return str(event["label"])
    rest = {k: v for k, v in event.items() if k not in ("tick", "t", "event")}
    return ", ".join(f"{key} {value}" for key, value in rest.items())


def read_summary(folder: Path) -> dict[str, Any]:
    """The content of a run's summary.json.

    Raises:
        FileNotFoundError: the run is not over, or was cut off.
        UserError: it is no summary.
    """
    path = folder / "summary.json"
    try:
        content = json.loads(path.read_text("utf-8"))
        _ = content["status"], content["reason"]
    except (ValueError, TypeError, KeyError, RecursionError):
        raise UserError(f"{path}: is not the summary of a run") from None
    return dict(content)


def cause(reasons: list[str]) -> str:
    """The first reason that is not just what one side heard of the other; the first if all are."""
    return next((reason for reason in reasons if reason not in _HEARSAY), reasons[0])


def worst(lines: list[dict[str, Any]], outside: Outcome | None) -> Outcome:
    """The outcome that counts among those the sides wrote and the one seen from outside: the most
    severe, and of two such the one seen from outside, or of the side that it happened to."""
    ends = [Outcome(e["status"], e["reason"], e["tick"]) for e in lines if e["event"] == "end"]
    found = [outside, *ends] if outside else ends
    if not found:
        return Outcome("safe", "the run was cut off: no process recorded its end", 0)
    return max(found, key=lambda o: (SEVERITY.index(o.status), o.reason not in _HEARSAY))
