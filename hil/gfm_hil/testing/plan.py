"""The steps of a test as a scenario: gathered tick by tick, carried out whole.

A plan is what makes a test exact: each step belongs to a tick, on every link and in real time
too, and what a test does can be run again from its scenario file.
"""

from __future__ import annotations

from typing import Any

from pydantic import TypeAdapter, ValidationError

from gfm_hil.core.errors import UserError, lines
from gfm_hil.scenario.events import Event
from gfm_hil.scenario.model import Scenario, check_scenario

_EVENT: TypeAdapter[Any] = TypeAdapter(Event)


class Plan:
    """Events and how long to run, on top of a scenario's own events.

    Args:
        base: the scenario without steps.
    """

    def __init__(self, base: Scenario) -> None:
        self.base = base
        self.tick = 0  # the next step's
        self._steps: list[Any] = []

    def step(self, kind: str, **fields: Any) -> None:
        """Have an event happen now: between the ticks run so far and the next one.

        Raises:
            UserError: it is none that a scenario could have.
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
            self.scenario(self.tick + 1)  # sees that laws, lines and the breaker are to be had
        except UserError:
            self._steps.pop()
            raise

    def run(self, seconds: float | None) -> None:
        """Go on for a time, rounded to whole ticks; without one, to the base scenario's end."""
        T_s = self.base.T_s
        ticks = self.base.ticks - self.tick if seconds is None else round(seconds / T_s)
        if ticks < 1:
            raise UserError(f"seconds = {seconds}: must be at least one tick of {T_s:g} s")
        self.tick += ticks

    def events(self, ticks: int) -> list[Any]:
        """What happens within so many ticks, in order; of one tick the scenario's own first."""
        T_s = self.base.T_s
        every = [*self.base.sorted_events(), *self._steps]
        return sorted((e for e in every if e.at(T_s) < ticks), key=lambda e: e.at(T_s))

    def scenario(self, ticks: int) -> Scenario:
        """The first so many ticks as a scenario of its own.

        Raises:
            UserError: a step cannot be had, as a law that is not to be found.
        """
        content = self.base.model_dump(exclude_none=True)
        content["duration"] = ticks * self.base.T_s
        content["events"] = [e.model_dump(exclude_none=True) for e in self.events(ticks)]
        return check_scenario(content, self.base.title)
