"""The steps of a test as a scenario: collected tick by tick, run as a whole.

The plan makes a test exact: each step belongs to a tick, on every link and in real time too, and
the scenario file repeats the test's run.
"""

from __future__ import annotations

from typing import Any

from pydantic import TypeAdapter, ValidationError

from gfm_hil.core.errors import UserError, lines
from gfm_hil.scenario.events import Event
from gfm_hil.scenario.model import Scenario, check_scenario

_EVENT: TypeAdapter[Any] = TypeAdapter(Event)


class Plan:
    """Events and duration of a test, in addition to a scenario's own events.

    Args:
        base: the scenario without steps.
    """

    def __init__(self, base: Scenario) -> None:
        self.base = base
        self.tick = 0  # of the next step
        self._steps: list[Any] = []

    def step(self, kind: str, **fields: Any) -> None:
        """Add an event at the present tick, after the ticks planned so far.

        Raises:
            UserError: a scenario cannot have such an event.
        """
        given = {name: value for name, value in fields.items() if value is not None}
        try:
            event = _EVENT.validate_python({"type": kind, "tick": self.tick, **given})
        except ValidationError as problem:
            raise UserError(
                "; ".join(line.removeprefix(f"{kind}.") for line in lines(problem, Event))
            ) from None
        self._steps.append(event)
        try:
            self.scenario(self.tick + 1)  # checks laws, lines and breaker
        except UserError:
            self._steps.pop()
            raise

    def run(self, seconds: float | None) -> None:
        """Continue for a time, rounded to whole ticks; without one, to the base scenario's end."""
        T_s = self.base.T_s
        ticks = self.base.ticks - self.tick if seconds is None else round(seconds / T_s)
        if ticks < 1:
            raise UserError(f"seconds = {seconds}: must be at least one tick of {T_s:g} s")
        self.tick += ticks

    def events(self, ticks: int) -> list[Any]:
        """The events of the first ``ticks`` ticks in order; within a tick the scenario's first."""
        T_s = self.base.T_s
        every = [*self.base.sorted_events(), *self._steps]
        return sorted((e for e in every if e.at(T_s) < ticks), key=lambda e: e.at(T_s))

    def scenario(self, ticks: int) -> Scenario:
        """The first ``ticks`` ticks as a scenario.

        Raises:
            UserError: a step is impossible, for example its law does not exist.
        """
        content = self.base.model_dump(exclude_none=True)
        content["duration"] = ticks * self.base.T_s
        content["events"] = [e.model_dump(exclude_none=True) for e in self.events(ticks)]
        return check_scenario(content, self.base.title)
