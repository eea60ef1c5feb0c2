"""Critical clearing times over quantities of a scenario: grid, depth of a sag, limits."""

import itertools
import math
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.api.design import at_short_circuit_ratios
from gfm_hil.api.law import Law, as_law, law_files
from gfm_hil.core.errors import UserError, need
from gfm_hil.engine.compiling import compiled_benches
from gfm_hil.scenario import Scenario, load_scenario
from gfm_hil.studies.clearing import AFTER_S, LONGEST_S, ClearingTime, clearing_time, event_to_clear
from gfm_hil.studies.workers import SILENT, Watch, pool_of, run_tasks

if TYPE_CHECKING:
    import pandas

WITHIN_S = 1e-3
SCR, OF_STAGE = "scr", "inner."
_MOST = 10_000  # clearing times


@dataclass(frozen=True)
class ClearingMap:
    """Critical clearing times over some quantities, see ``clearing_map``.

    Attributes:
        law, title: of the scenario.
        over: the values of each quantity, by its name.
        times: one for each combination of values, those of the last quantity in turn first.
    """

    law: str
    title: str
    over: dict[str, tuple[float, ...]]
    times: tuple[ClearingTime, ...]

    @property
    def seconds(self) -> NDArray[np.float64]:
        """What is borne, s, an axis a quantity."""
        shape = [len(values) for values in self.over.values()]
        return np.array([one.seconds for one in self.times]).reshape(shape)

    def rows(self) -> list[dict[str, Any]]:
        """A row a clearing time: the values by the name of their quantity, ``seconds``, ``lost``
        (s) and ``loss``, as of ``ClearingTime``, and ``runs``."""
        places = itertools.product(*self.over.values())
        return [
            dict(zip(self.over, at, strict=True))
            | {"seconds": one.seconds, "lost": one.lost, "loss": one.loss, "runs": len(one.trials)}
            for at, one in zip(places, self.times, strict=True)
        ]

    def to_pandas(self) -> "pandas.DataFrame":
        """The ``rows``. Raises UserError: pandas is not installed."""
        need("pandas", "pandas", "to_pandas", "notebook")
        import pandas

        return pandas.DataFrame(self.rows())

    def __repr__(self) -> str:
        seconds = self.seconds
        words = " × ".join(f"{len(values)} {name}" for name, values in self.over.items())
        return f"<ClearingMap {self.law} over {words}: {seconds.min():g} to {seconds.max():g} s>"


def clearing_map(
    law: str | Path | Law | None = None,
    on: str | Path | Scenario = "deep_sag",
    *,
    over: Mapping[str, Sequence[float]],
    longest: float = LONGEST_S,
    after: float = AFTER_S,
    within: float = WITHIN_S,
    workers: int = 1,
    watch: Watch = SILENT,
    **changes: Any,
) -> ClearingMap:
    """How long the fault or the sag of a scenario may last, over one to three quantities.

    Args:
        law, on, longest, after, within, changes: as for ``clearing_time``.
        over: values by the name of a quantity: ``scr``, the short-circuit ratio of the grid with
            its own X/R; ``inner.KEY``, a key of the inner stage, e.g. ``inner.I_max``; or a key of
            the scenario by its dotted path, e.g. ``events.0.V_g``, the depth of a sag.
        workers: processes.
        watch: told the clearing times done.

    Raises:
        UserError: one line a mistake.
        LawError: the law is none, or a stage cannot have a value.
    """
    if not 1 <= len(over) <= 3:
        raise UserError(f"over: must be one to three quantities, not {len(over)}")
    axes = {name: tuple(map(float, values)) for name, values in over.items()}
    for name, values in axes.items():
        if not values or not all(map(math.isfinite, values)) or sorted({*values}) != [*values]:
            raise UserError(f"{name} = {[*values]}: must be finite and ascending values")
    if math.prod(map(len, axes.values())) > _MOST:
        raise UserError(f"over: must be at most {_MOST} clearing times")
    base = load_scenario(on, in_process=True, **changes)
    event_to_clear(base, longest, after, within)
    own = as_law(base.law if law is None else law)
    found: dict[int, ClearingTime] = {}
    with ExitStack() as stack:
        # laws of other values have files while this lasts
        tasks = [
            (k, _at(base, own, dict(zip(axes, values, strict=True)), stack))
            for k, values in enumerate(itertools.product(*axes.values()))
        ]

        def keep(result: tuple[int, ClearingTime]) -> None:
            found[result[0]] = replace(result[1], law=own.name)
            watch.progress(len(found), len(tasks), "")

        if workers > 1:
            compiled_benches(tasks[0][1], watch.notice)
        work = partial(_time_of, longest, after, within)
        with pool_of(workers) as pool:
            run_tasks(work, tasks, pool, workers, keep, watch.stopped)
    if len(found) < len(tasks):
        raise KeyboardInterrupt
    return ClearingMap(own.name, base.title, axes, tuple(found[k] for k in range(len(tasks))))


def _at(base: Scenario, own: Law, values: Mapping[str, float], stack: ExitStack) -> Scenario:
    """The scenario at one place of the map."""
    scenario, law = base, own
    if of_stage := {
        n.removeprefix(OF_STAGE): x for n, x in values.items() if n.startswith(OF_STAGE)
    }:
        law = own.with_inner(base.inner, own.name, **of_stage)
        scenario = base.model_copy(update={"inner": None})
    (file,) = stack.enter_context(law_files([law])).values()
    keys: dict[str, Any] = {
        name.replace(".", "__"): x
        for name, x in values.items()
        if name != SCR and not name.startswith(OF_STAGE)
    }
    scenario = load_scenario(scenario, in_process=True, law=file, **keys)
    return at_short_circuit_ratios(scenario, [values[SCR]])[0] if SCR in values else scenario


def _time_of(
    longest: float, after: float, within: float, task: tuple[int, Scenario]
) -> tuple[int, ClearingTime]:
    return task[0], clearing_time(task[1], longest, after, within)
