"""The log of a run, one JSON object per line, and the outcome that follows from it."""

import contextlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat
from pydantic_core import from_json

from gfm_hil.core.files import SMALL, check_values, read_file, read_json
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.scenario import Scenario
from gfm_hil.scenario.expectation import reason_name
from gfm_plant.names import CONTROLLER_LEFT, CONTROLLER_SAFE
from gfm_runtime.states import PLANT_TRIP, REASONS

Status = Literal["completed", "oscillating", "tripped", "safe", "interrupted"]

PLANT_LEFT = "the plant ended before the scenario did"

#: reasons with which a role reports what the other role did
_SECONDARY = (REASONS[PLANT_TRIP], PLANT_LEFT, CONTROLLER_LEFT, CONTROLLER_SAFE)

_A_TICK = 1024  # bytes of the log or the summary: an event at every tick
_MOST = 32 << 20  # bytes: a hundred thousand events

Tick = Annotated[int, Field(ge=0, le=10**12)]

SEVERITY: tuple[Status, ...] = ("completed", "oscillating", "interrupted", "safe", "tripped")


@dataclass(frozen=True)
class Outcome:
    """How a run ended: status, reason in words, and the tick."""

    status: Status
    reason: str
    tick: int


class _FileContent(BaseModel):
    """What a file of a run says; keys without a type here may hold anything."""

    model_config = ConfigDict(strict=True, extra="allow")


class _Line(_FileContent):
    """A line of the log."""

    tick: Tick
    t: FiniteFloat
    event: str
    label: str = ""
    role: str = ""
    status: Status = "completed"
    reason: str = ""
    law: str = ""
    bump_pu: float | None = None
    controller: str | None = None
    run: str | None = None
    one_clock: bool = True


#: keys that a line of a kind must have besides tick, t and event
_NEEDS = {
    "handshake": {"controller", "run", "one_clock"},
    "law-active": {"law", "bump_pu"},
    "tripped": {"reason"},
    "safe": {"reason"},
    "end": {"status", "reason"},
}
_LOGS = tuple(f"events_{side}.jsonl" for side in (*ROLES, "both"))


class _EventEntry(_FileContent):
    t: FiniteFloat
    tick: Tick
    type: str
    label: str


class _TripEntry(_FileContent):
    t: FiniteFloat
    tick: Tick
    reason: str


class _Versioned(_FileContent):
    version: str = "0.1"  # the first one did not say it


class Summary(_FileContent):
    """What summary.json must be, as far as anything relies on it."""

    title: str
    status: Status
    reason: str
    unmet: list[str]
    controller: str | None
    laws: list[str]
    link: str
    mode: Literal["lockstep", "realtime"]
    T_s: Annotated[float, Field(gt=0, le=0.1)]
    ticks: Tick
    duration_s: FiniteFloat
    wall_s: FiniteFloat
    misses: int | None
    round_trip_us: dict[str, float] | None
    instructions: dict[str, float] = {}
    faults: dict[Role, dict[str, int]]
    e2e: dict[Role, str]
    injected: dict[Role, dict[str, int]] = {}
    inner: dict[str, str] = {}
    bump_pu: list[float | None] | None
    trips: list[_TripEntry] = []
    events: list[_EventEntry]
    run: str | None
    date: str = ""
    version: str = ""
    machines: dict[str, Any] = {}


def most_bytes(ticks: int) -> int:
    """How large the log or the summary of a run of so many ticks may be."""
    return min(SMALL + _A_TICK * ticks, _MOST)


def read_log(*paths: Path, most: int = _MOST) -> list[dict[str, Any]]:
    """The lines of one or more logs of at most so many bytes each, in order of their ticks; of one
    tick, a cause stands before what the other role says of it.

    It skips damaged lines: the last line of a process that was killed may be incomplete. Raises
    UserError: a log is no regular file, or longer than that of any run.
    """
    found: list[dict[str, Any]] = []
    for path in paths:
        try:
            data = read_file(path, most)
        except FileNotFoundError:
            continue
        check_values(path, data)
        for text in data.splitlines():
            with contextlib.suppress(ValueError):
                line = from_json(text)
                _Line.model_validate(line)
                if line.keys() >= _NEEDS.get(line["event"], set()):
                    found.append(line)
    return sorted(found, key=lambda line: (line["tick"], line.get("reason") in _SECONDARY))


def read_events(folder: Path, ticks: int) -> list[dict[str, Any]]:
    """The log of the folder of a run of so many ticks, or of one in progress what its roles have
    written so far; raises as ``read_log``."""
    whole = folder / "events.jsonl"
    logs = [whole] if os.path.lexists(whole) else [folder / name for name in _LOGS]
    return read_log(*logs, most=most_bytes(ticks))


def event_text(event: dict[str, Any]) -> str:
    """The content of a line of the log besides its kind, as a short text."""
    if "label" in event:
        return str(event["label"])
    rest = {k: v for k, v in event.items() if k not in ("tick", "t", "event")}
    return ", ".join(f"{key} {value}" for key, value in rest.items())


def read_summary(folder: Path, ticks: int) -> dict[str, Any]:
    """The content of the summary.json of a run of so many ticks. Raises FileNotFoundError: the run
    is not over, or was killed; UserError: the file is not a summary."""
    return read_json(folder / "summary.json", Summary, most_bytes(ticks))


def written_by(folder: Path) -> str:
    """The version of gfmhil that wrote a run's folder. Raises as ``read_summary``."""
    said = read_json(folder / "summary.json", _Versioned, most_bytes(0))
    return str(said.get("version", "0.1"))


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


def was_stopped(lines: Sequence[dict[str, Any]]) -> bool:
    """Whether somebody stopped a role, and not only the other one left it."""
    ends = [e for e in lines if e["event"] == "end"]
    return any(e["status"] == "interrupted" and e["reason"] not in _SECONDARY for e in ends)


def unmet(
    scenario: Scenario, outcome: Outcome, log: Sequence[dict[str, Any]], done: int
) -> list[str]:
    """The parts of the expectation that a run did not meet, one sentence each; empty if it met all.

    Args:
        scenario: the scenario with its expectation.
        outcome: how the run ended.
        log: every line of the run's log. If the run waits after a trip, the time of the trip in
            the log counts, not the end of the wait.
        done: ticks recorded: the time of the end if both sides died before they could log it.
    """
    if outcome.status != scenario.expect:
        return [f"expect = {scenario.expect!r}, but the run ended as {outcome.status!r}"]
    missed = []
    wanted, came = scenario.expect_reason, reason_name(outcome.reason)
    if wanted is not None and came != wanted:
        missed.append(f"expect_reason = {wanted!r}, but the reason was {came!r}")
    if scenario.expect_after is not None:
        tick = _ended_at(outcome, log, done)
        if tick < round(scenario.expect_after / scenario.T_s):
            missed.append(
                f"expect_after = {scenario.expect_after:g} s, but the end came at "
                f"{tick * scenario.T_s:.6g} s"
            )
    return missed


def _ended_at(outcome: Outcome, log: Sequence[dict[str, Any]], done: int) -> int:
    """The tick of the event that ended the run, or after which the run waited to its end."""
    of_it = [e for e in log if e.get("reason") == outcome.reason]
    waited = [e["tick"] for e in of_it if e["event"] == outcome.status]
    ended = [e["tick"] for e in of_it if e["event"] == "end" and e["status"] == outcome.status]
    return max(waited or ended or [done])
