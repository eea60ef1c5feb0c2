"""What a scenario expects of a run's end: status, reason and time, and whether that came.

The reason of an end begins with its name, as the lists of the plant and the controller give it;
what follows the name's colon (quantity, value, threshold, time) is for people.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from gfm_plant.names import CONTROLLER, CONTROLLER_SAFE, NO_FRESH_U, TRIP_REASONS
from gfm_runtime.errors import meant
from gfm_runtime.states import OK, OPERATOR, PLANT_TRIP, REASONS

if TYPE_CHECKING:
    from gfm_hil.recording.log import Outcome
    from gfm_hil.scenario.model import Scenario

CONTROLLER_GONE = "the controller's process is gone"

#: the names of the reasons that a run may end for, by its status
END_REASONS: dict[str, tuple[str, ...]] = {
    "completed": (),
    "tripped": (
        *(name for code, name in TRIP_REASONS.items() if code not in (0, CONTROLLER)),
        REASONS[PLANT_TRIP],  # all that the controller's side alone comes to know
    ),
    "safe": (
        *(name for k, name in enumerate(REASONS) if k not in (OK, PLANT_TRIP, OPERATOR)),
        CONTROLLER_SAFE,
        NO_FRESH_U,
        CONTROLLER_GONE,
    ),
}


def reason_name(reason: str) -> str:
    """The name with which the reason of an end begins."""
    return reason.split(":")[0]


def check_expectation(scenario: Scenario) -> list[str]:
    """What is wrong with ``expect_reason`` and ``expect_after``, one line a mistake."""
    problems = []
    names, reason = END_REASONS[scenario.expect], scenario.expect_reason
    given = {"expect_reason": reason, "expect_after": scenario.expect_after}
    if not names:
        problems += [
            f"{key} = {value!r}: needs expect = 'tripped' or 'safe', not 'completed'"
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
        scenario: with what it expects.
        outcome: how the run ended.
        log: every line of the run's log. A run that waits after a trip says there when it
            tripped, which counts rather than the end of the waiting.
        done: ticks recorded, the time of an end that no side lived to write down.
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
    """The tick of what ended the run, or of what it waited for to its end."""
    of_it = [e for e in log if e.get("reason") == outcome.reason]
    waited = [e["tick"] for e in of_it if e["event"] == outcome.status]
    ended = [e["tick"] for e in of_it if e["event"] == "end" and e["status"] == outcome.status]
    return max(waited or ended or [done])
