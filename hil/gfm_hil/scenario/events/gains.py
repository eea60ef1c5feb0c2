"""New gains of a running law: prepared off the loop, swapped in one tick."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field

import gfm_runtime  # lazy: an operator's command loads no kernel, and so no compiler
from gfm_hil.core.errors import UserError
from gfm_hil.scenario.events.base import WHOSE, ControllerEvent, EventTarget
from gfm_hil.scenario.events.law import LawChange
from gfm_hil.scenario.events.reset import Reset
from gfm_runtime.errors import LawError

if TYPE_CHECKING:
    from gfm_hil.controllers.external import PackedLaw
    from gfm_hil.scenario.schema import Scenario
    from gfm_runtime.assembly import Controller


class GainChange(ControllerEvent):
    """New gains of the active law, by the names in its file, without a bump. Tied parameters
    follow."""

    changes_law: ClassVar[bool] = True
    type: Literal["gains"] = Field(description="kind of event")
    values: dict[str, float] = Field(
        min_length=1, description="a table of names and numbers, e.g. { D_p = 0.02 }"
    )
    converter: str | None = WHOSE

    def label(self) -> str:
        return ", ".join(f"{name} = {value:g}" for name, value in self.values.items())

    def check_now(self, target: EventTarget) -> None:
        ready_gains(target.controller, self.values)
        super().check_now(target)

    def carry_out(self, target: EventTarget) -> None:
        """Change gains of the law selected last, on top of earlier changes."""
        c = target.controller
        c.retune(*ready_gains(c, self.values), {**c.gains, **self.values})


@lru_cache(maxsize=64)
def retuned(
    name: str,
    gains: tuple[tuple[str, float], ...],
    T_s: float,
    omega_b: float,
    inner: str | None,
    counts: str | None,
) -> PackedLaw:
    """A law with some gains changed, discretised, and packed for the kernel.

    A gain that the law file ties to a changed one follows it unless it is given too. The newest
    results are cached: the command server's check prepares what the loop then uses. ``omega_b`` is
    that of the converter, rad/s, for an inner stage. Raises ValueError: a scheduled law, a name
    that its file does not have, or no such law.
    """
    try:
        file = gfm_runtime.law_file(name)
        if file.schedule is not None:
            raise LawError(f"law {name}", "is scheduled: its gains change by themselves")
        changed = gfm_runtime.tied(file, dict(gains))
        (law,) = gfm_runtime.load_law(name, inner, counts, **changed).laws
        discrete = gfm_runtime.discretise(law, T_s)
        return discrete, gfm_runtime.pack_law(discrete, omega_b=omega_b)
    except LawError as problem:
        raise ValueError(str(problem)) from None


def ready_gains(controller: Controller, values: Mapping[str, float]) -> PackedLaw:
    """The law selected last with new gains, on top of earlier changes. Raises ValueError: as
    ``retuned``."""
    gains = {**controller.gains, **values}
    name = controller.asked
    own, changed = controller.sets[name], tuple(sorted(gains.items()))
    T_s, omega_b = controller.T_s, controller.omega_b
    return retuned(name, changed, T_s, omega_b, own.inner, own.counts)


def gains_of(scenario: Scenario, omega_b: float) -> list[PackedLaw]:
    """Every change of gains that the scenario names, prepared before it runs; ``omega_b`` as for
    ``retuned``. Raises UserError: a change that is not possible."""
    found: list[PackedLaw] = []
    name, gains = scenario.law, dict[str, float]()
    for event in scenario.sorted_events():
        if isinstance(event, LawChange):
            name, gains = event.law, {}
        elif isinstance(event, Reset):
            name, gains = scenario.law, {}
        elif isinstance(event, GainChange):
            gains.update(event.values)
            try:
                given = tuple(sorted(gains.items()))
                found.append(
                    retuned(name, given, scenario.T_s, omega_b, scenario.inner, scenario.counts)
                )
            except ValueError as problem:
                raise UserError(f"events, {event.label()}: {problem}") from None
    return found
