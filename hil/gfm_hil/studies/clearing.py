"""Critical clearing time: how long a fault or a sag may last before the converter is lost.

The time comes from runs of the bench by bisection, so that limits, stages, protection, delay and
the transients of the circuit count, which the equal-area criterion leaves out (P. Kundur, Power
System Stability and Control, 1994, ch. 13).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.recording.run import Run
from gfm_hil.run.runner import run_in_memory
from gfm_hil.scenario import Scenario, load_scenario
from gfm_hil.studies.workers import SILENT, Watch

LONGEST_S, AFTER_S = 2.0, 3.0
_MOST_S = 60.0
_OUT_OF_STEP = 180.0  # degrees, as the criterion stays_in_step has it
_REST_S, _REST = 1.0, 30.0  # s, degrees: so long it was no farther from where it was before
_AWAY = 540.0  # degrees; an angle that is farther does not come back
_LONGEST_AFTER_S = 24.0

NO_EQUILIBRIUM = "no equilibrium"  # its angle runs away even if the fault does not occur
NOT_REACHED = "equilibrium not reached"  # there is one, and the angle passes it
OF_ANGLE = (NO_EQUILIBRIUM, NOT_REACHED)


@dataclass(frozen=True)
class Trial:
    """One run.

    Attributes:
        duration: of the fault, s; 0: it does not occur.
        far: largest distance of the angle to the grid from where it was before, degrees.
        loss: how the converter was lost, in words; empty if it was not.
    """

    duration: float
    far: float
    loss: str


@dataclass(frozen=True)
class ClearingTime:
    """The critical clearing time of a scenario's fault or sag, see ``clearing_time``.

    Attributes:
        law, title: of the scenario.
        seconds: the longest that the converter bears, s; 0: none.
        lost: the shortest that it does not bear, s; infinite if it bears the longest tried.
        loss: how it is lost then: ``NO_EQUILIBRIUM``, ``NOT_REACHED``, or the reason of the
            protection; empty if it is not.
        trials: all runs, in the order of their durations.
    """

    law: str
    title: str
    seconds: float
    lost: float
    loss: str
    trials: tuple[Trial, ...]

    @classmethod
    def nowhere(cls, scenario: Scenario) -> Self:
        """Of a scenario without an operating point to begin at."""
        return cls(scenario.law, scenario.title, 0.0, 0.0, NO_EQUILIBRIUM, ())

    def row(self) -> dict[str, Any]:
        """``seconds``, ``lost``, ``loss``, and the number of ``runs``."""
        found = {name: getattr(self, name) for name in ("seconds", "lost", "loss")}
        return {**found, "runs": len(self.trials)}

    def __repr__(self) -> str:
        borne = f"{self.seconds:.4g} s, then {self.loss}" if self.loss else f"{self.seconds:g} s"
        return f"<ClearingTime {self.law}: bears {borne}>"


def clearing_time(
    scenario: Scenario,
    longest: float = LONGEST_S,
    after: float = AFTER_S,
    within: float | None = None,
    watch: Watch = SILENT,
) -> ClearingTime:
    """How long the fault or the sag of a scenario may last before its converter is lost.

    The converter is lost when its angle to the grid is half a turn or more from where it was before
    the fault, or when its run ends in the safe state. What happens in the scenario after the fault
    keeps its distance to the fault's end.

    Args:
        scenario: of one converter, with one event that has a ``duration``.
        longest: the longest that is tried, s.
        after: how long each run goes on after it at least, s; see ``run_to_rest``.
        within: distance between what is borne and what is not, s; None: one tick.
        watch: is told the runs done.

    Raises:
        UserError: the scenario has a network, or no such event; a number cannot be; there is no
            operating point to begin at.
    """
    T_s = scenario.T_s
    within = T_s if within is None else within
    at = event_to_clear(scenario, longest, after, within)
    trials = dict[int, Trial]()  # by ticks
    runs = 2 + math.ceil(math.log2(max(longest / within, 1.0)))

    def is_lost(ticks: int) -> bool:
        trials[ticks] = _run(scenario, at, ticks, after)
        watch.progress(min(len(trials), runs), runs, "")
        return bool(trials[ticks].loss)

    low, high, step = 0, round(longest / T_s), round(within / T_s)
    if is_lost(0):
        high = 0
    elif is_lost(high):
        while high - low > step:
            middle = (low + high) // 2
            low, high = (low, middle) if is_lost(middle) else (middle, high)
    else:
        low = high
    end = trials[high]
    ordered = tuple(trials[k] for k in sorted(trials))
    lost = end.duration if end.loss else math.inf
    loss = NO_EQUILIBRIUM if end.loss == NOT_REACHED and not high else end.loss
    return ClearingTime(scenario.law, scenario.title, trials[low].duration, lost, loss, ordered)


def event_to_clear(scenario: Scenario, longest: float, after: float, within: float) -> int:
    """The place of what is to be cleared among the events. Raises UserError: as
    ``clearing_time``."""
    T_s = scenario.T_s
    limits = (("longest", longest, 2 * T_s), ("after", after, 0.1), ("within", within, T_s))
    for name, value, least in limits:
        if not least <= value <= _MOST_S:
            raise UserError(f"{name} = {value:g} s: must lie in [{least:g}, {_MOST_S:g}]")
    if scenario.network is not None:
        one = "network: the clearing time is that of one converter on its grid"
        raise UserError(f"{one}; here try durations with gfmhil run --set events.0.duration=S")
    some = [k for k, event in enumerate(scenario.events) if getattr(event, "duration", None)]
    if len(some) != 1:
        raise UserError(f"events: one must have a duration, a fault or a sag; {len(some)} have")
    return some[0]


def _run(scenario: Scenario, at: int, ticks: int, after: float) -> Trial:
    """The run in which the event at that place lasts for so many ticks."""
    T_s, was = scenario.T_s, scenario.events[at]
    begin, seconds = was.at(T_s), ticks * T_s
    longer = ticks - round(was.lasts() / T_s)
    content = scenario.model_dump(mode="json", exclude_unset=True)
    events: list[dict[str, Any]] = []
    for k, (event, one) in enumerate(zip(content["events"], scenario.events, strict=True)):
        event.pop("t", None)
        event["tick"] = one.at(T_s) + (longer if one.at(T_s) > begin else 0)
        if k != at:
            events.append(event)
        elif ticks:
            events.append({**event, "duration": seconds})
    run, moved = run_to_rest({**content, "events": events}, begin, begin * T_s + seconds, after)
    far = float(np.abs(moved).max())
    return Trial(seconds, far, NOT_REACHED if far >= _OUT_OF_STEP else loss_of(run))


def run_to_rest(
    content: Mapping[str, Any], begin: int, end: float, after: float
) -> tuple[Run, NDArray[np.float64]]:
    """The run of a scenario, and how far its angle is from where it was before tick ``begin``,
    degrees, by tick.

    The run goes on for ``after`` s after ``end``, s. If its angle has not come back to where it
    was by then, up to whole turns, and does not run away, nothing is decided: it may creep past its
    unstable equilibrium. It is run again for twice as long, to 24 s.
    """
    while True:
        scenario = load_scenario({**content, "duration": end + after}, in_process=True)
        run = run_in_memory(scenario)
        delta = np.degrees(np.asarray(run.signals["delta"], float))
        moved = delta - delta[max(begin - 1, 0)]
        rest = moved[-round(_REST_S / scenario.T_s) :]
        rests = np.abs(rest - 360.0 * np.round(rest[-1] / 360.0)).max() <= _REST
        runs_away = np.abs(moved[-1]) > _AWAY
        if rests or runs_away or loss_of(run) or 2 * after > _LONGEST_AFTER_S:
            return run, moved
        after *= 2


def loss_of(run: Run) -> str:
    """How a run ended in the safe state; empty if it did not."""
    return "" if run.status in ("completed", "oscillating") else str(run.summary["reason"])
