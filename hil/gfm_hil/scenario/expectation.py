"""The end of a run that a scenario expects, status, reason and time, and the check of it.

The reason of an end begins with its name, from the lists of the plant and the controller; the text
after the colon (quantity, value, threshold, time) is for the reader.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from gfm_plant.names import (
    CONTROLLER,
    CONTROLLER_GONE,
    CONTROLLER_LEFT,
    CONTROLLER_SAFE,
    NO_FRESH_U,
    TRIP_REASONS,
)
from gfm_runtime.errors import meant
from gfm_runtime.states import OK, OPERATOR, PLANT_TRIP, REASONS

if TYPE_CHECKING:
    from gfm_hil.recording.log import Outcome
    from gfm_hil.scenario import Scenario


#: names of the possible reasons of a run's end, by its status
END_REASONS: dict[str, tuple[str, ...]] = {
    "completed": (),
    "oscillating": (),
    "tripped": (
        *(name for code, name in TRIP_REASONS.items() if code not in (0, CONTROLLER)),
        REASONS[PLANT_TRIP],  # the controller's side knows no more than this
    ),
    "safe": (
        *(name for k, name in enumerate(REASONS) if k not in (OK, PLANT_TRIP, OPERATOR)),
        CONTROLLER_SAFE,
        NO_FRESH_U,
        CONTROLLER_GONE,
        CONTROLLER_LEFT,
    ),
}


def reason_name(reason: str) -> str:
    """The name at the beginning of the reason of an end."""
    return reason.split(":")[0]


def check_expectation(scenario: Scenario) -> list[str]:
    """The mistakes in ``expect_reason`` and ``expect_after``, one line each."""
    problems = []
    names, reason = END_REASONS[scenario.expect], scenario.expect_reason
    given = {"expect_reason": reason, "expect_after": scenario.expect_after}
    if not names:
        problems += [
            f"{key} = {value!r}: needs expect = 'tripped' or 'safe', not {scenario.expect!r}"
            for key, value in given.items()
            if value is not None
        ]
    elif reason is not None and reason not in names:
        problems.append(
            f"expect_reason = {reason!r:.80}: expect = {scenario.expect!r} takes "
            f"one of {list(names)}{meant(reason, names)}"
        )
    if scenario.expect_after is not None and scenario.expect_after >= scenario.duration:
        problems.append(
            f"expect_after = {scenario.expect_after:g} s: must be below duration = "
            f"{scenario.duration:g} s"
        )
    return problems


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
