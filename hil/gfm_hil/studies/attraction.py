"""Region of attraction of a converter's angle: from which angles to the grid it comes back.

The angles come from runs of the bench in which the grid's angle jumps, by bisection, so that
limits, stages, protection, delay and the transients of the circuit count.
"""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from gfm_hil.core.errors import UserError
from gfm_hil.scenario import Scenario
from gfm_hil.studies.clearing import NO_EQUILIBRIUM, loss_of, run_to_rest
from gfm_hil.studies.workers import SILENT, Watch

AFTER_S, WITHIN = 3.0, 1.0  # s, degrees
ANOTHER_TURN = "rests a turn away"
_MOST_S = 60.0
_BEFORE_S = 0.1
_HALF = 180.0  # degrees


@dataclass(frozen=True)
class Attraction:
    """From which angles a converter comes back, see ``attraction``.

    Attributes:
        law, title: of the scenario.
        low, high: jumps of the grid's angle between which it comes back, degrees.
        below, above: what a larger jump back or ahead does: ``ANOTHER_TURN``, or the reason of the
            protection; empty if it comes back from half a turn too.
        runs: how many were made.
    """

    law: str
    title: str
    low: float
    high: float
    below: str
    above: str
    runs: int

    @classmethod
    def nowhere(cls, scenario: Scenario) -> Self:
        """Of a scenario without an operating point to begin at."""
        return cls(scenario.law, scenario.title, 0.0, 0.0, NO_EQUILIBRIUM, NO_EQUILIBRIUM, 0)

    def row(self) -> dict[str, Any]:
        """``low``, ``high``, ``below``, ``above`` and ``runs``."""
        return {n: getattr(self, n) for n in ("low", "high", "below", "above", "runs")}

    def __repr__(self) -> str:
        return f"<Attraction {self.law}: from {self.low:.4g}° to {self.high:.4g}°>"


def attraction(
    scenario: Scenario, after: float = AFTER_S, within: float = WITHIN, watch: Watch = SILENT
) -> Attraction:
    """From which jumps of the grid's angle a converter at rest comes back to where it was.

    It does not if its angle to the grid ends half a turn or more from where it was before, or if
    its run ends in the safe state.

    Args:
        scenario: of one converter; none of its events counts.
        after: how long each run goes on after the jump at least, s; see ``run_to_rest``.
        within: distance between an angle from which it comes back and one from which not, degrees.
        watch: told the runs done.

    Raises:
        UserError: the scenario has a network; a number cannot be; there is no operating point to
            begin at.
    """
    check_attraction(scenario, after, within)
    runs = 2 * (1 + int(np.ceil(np.log2(_HALF / within))))
    made = 0

    def loss(degrees: float) -> str:
        nonlocal made
        made += 1
        watch.progress(min(made, runs), runs, "")
        return _loss(scenario, degrees, after)

    ends = []
    for side in (-1.0, 1.0):
        back, far = 0.0, _HALF
        why = loss(side * far)
        if not why:
            back = far
        while why and far - back > within:
            middle = (back + far) / 2
            if found := loss(side * middle):
                far, why = middle, found
            else:
                back = middle
        ends.append((side * back, why))
    (low, below), (high, above) = ends
    return Attraction(scenario.law, scenario.title, low, high, below, above, made)


def check_attraction(scenario: Scenario, after: float, within: float) -> None:
    """Raise UserError as ``attraction`` does, but for the operating point."""
    if scenario.network is not None:
        raise UserError("network: the region of attraction is that of one converter on its grid")
    for name, value, unit, least, most in (
        ("after", after, "s", 0.1, _MOST_S), ("within", within, "degrees", 0.01, 90.0),
    ):  # fmt: skip
        if not least <= value <= most:
            raise UserError(f"{name} = {value:g} {unit}: must lie in [{least:g}, {most:g}]")


def _loss(scenario: Scenario, degrees: float, after: float) -> str:
    """The reason for which the converter does not come back after a jump; empty if it does."""
    content = scenario.model_dump(mode="json", exclude_unset=True)
    jump = {"type": "grid-phase-jump", "t": _BEFORE_S, "degrees": degrees}
    begin = round(_BEFORE_S / scenario.T_s)
    run, moved = run_to_rest(content | {"events": [jump]}, begin, _BEFORE_S, after)
    return loss_of(run) or (ANOTHER_TURN if abs(moved[-1]) >= _HALF else "")
