"""Transient stability: clearing times and regions of attraction, at one place or over quantities of
a scenario such as the grid's strength, the depth of a sag, or a limit."""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from gfm_hil.api.design import at_short_circuit_ratios
from gfm_hil.api.law import Law, as_law, law_files, scenario_under
from gfm_hil.core.errors import UserError, need
from gfm_hil.engine.compiling import compiled_benches
from gfm_hil.scenario import Scenario, load_scenario
from gfm_hil.studies import attraction as angles
from gfm_hil.studies import clearing
from gfm_hil.studies.attraction import Attraction
from gfm_hil.studies.clearing import ClearingTime
from gfm_hil.studies.workers import SILENT, Watch, pool_of, run_tasks

if TYPE_CHECKING:
    import pandas

WITHIN_S = 1e-3  # of a map
SCR, OF_STAGE = "scr", "inner."
_MOST = 10_000  # places

Found = TypeVar("Found", ClearingTime, Attraction)
Over = Mapping[str, Sequence[float]]


@dataclass(frozen=True)
class TransientMap(Generic[Found]):
    """What ``clearing_map`` or ``attraction_map`` found over some quantities.

    Attributes:
        law, title: of the scenario.
        over: the values of each quantity, by its name.
        found: a ``ClearingTime`` or an ``Attraction`` for each combination of values, those of the
            last quantity in turn first.
    """

    law: str
    title: str
    over: dict[str, tuple[float, ...]]
    found: tuple[Found, ...]

    def values(self, name: str) -> NDArray[np.float64]:
        """A number that each of ``found`` has, an axis a quantity: ``seconds`` and ``lost`` of
        clearing times, ``low`` and ``high`` of regions of attraction."""
        shape = [len(values) for values in self.over.values()]
        return np.array([float(getattr(one, name)) for one in self.found]).reshape(shape)

    def rows(self) -> list[dict[str, Any]]:
        """A row a place: the values by the name of their quantity, and what was found."""
        places = itertools.product(*self.over.values())
        return [
            dict(zip(self.over, at, strict=True)) | one.row()
            for at, one in zip(places, self.found, strict=True)
        ]

    def to_pandas(self) -> "pandas.DataFrame":
        """The ``rows``. Raises UserError: pandas is not installed."""
        need("pandas", "pandas", "to_pandas", "notebook")
        import pandas

        return pandas.DataFrame(self.rows())

    def __repr__(self) -> str:
        words = " × ".join(f"{len(values)} {name}" for name, values in self.over.items())
        return f"<TransientMap {self.law}: {type(self.found[0]).__name__} over {words}>"


def clearing_time(
    law: str | Path | Law | None = None,
    on: str | Path | Scenario = "deep_sag",
    *,
    longest: float = clearing.LONGEST_S,
    after: float = clearing.AFTER_S,
    within: float | None = None,
    watch: Watch = SILENT,
    **changes: Any,
) -> ClearingTime:
    """How long the fault or the sag of a scenario may last before its converter is lost.

    Args:
        law: name, law file or ``Law``; the scenario's own if None.
        on: scenario of one converter, with one event that has a ``duration``.
        longest, after, within, watch: as for ``gfm_hil.studies.clearing.clearing_time``.
        changes: keys of the scenario, as for ``run``, e.g. ``plant__grid__scr=2.0``.

    Raises:
        UserError: one line a mistake, or no operating point.
        LawError: the law is none.
    """
    with scenario_under(law, on, **changes) as scenario:
        found = clearing.clearing_time(scenario, longest, after, within, watch)
    return _named(found, law)


def clearing_map(
    law: str | Path | Law | None = None,
    on: str | Path | Scenario = "deep_sag",
    *,
    over: Over,
    longest: float = clearing.LONGEST_S,
    after: float = clearing.AFTER_S,
    within: float = WITHIN_S,
    workers: int | str = 1,
    watch: Watch = SILENT,
    **changes: Any,
) -> TransientMap[ClearingTime]:
    """How long the fault or the sag of a scenario may last, over one to three quantities.

    Args:
        law, on, longest, after, within, changes: as for ``clearing_time``.
        over: values by the name of a quantity: ``scr``, the short-circuit ratio of the grid with
            its own X/R; ``inner.KEY``, a key of the inner stage, e.g. ``inner.I_max``; or a key of
            the scenario by its dotted path, e.g. ``events.0.V_g``, the depth of a sag.
        workers: as for ``campaign``.
        watch: told the places done.

    Raises:
        UserError: one line a mistake.
        LawError: the law is none, or a stage cannot have a value.
    """
    base = load_scenario(on, in_process=True, **changes)
    clearing.event_to_clear(base, longest, after, within)
    work = partial(clearing.clearing_time, longest=longest, after=after, within=within)
    return _map(law, base, over, work, ClearingTime.nowhere, workers, watch)


def attraction(
    law: str | Path | Law | None = None,
    on: str | Path | Scenario = "pref_step",
    *,
    after: float = angles.AFTER_S,
    within: float = angles.WITHIN,
    watch: Watch = SILENT,
    **changes: Any,
) -> Attraction:
    """From which jumps of the grid's angle a converter at rest comes back to where it was.

    Args:
        law: name, law file or ``Law``; the scenario's own if None.
        on: scenario of one converter, of which no event counts.
        after, within, watch: as for ``gfm_hil.studies.attraction.attraction``.
        changes: keys of the scenario, as for ``run``.

    Raises:
        UserError: one line a mistake, or no operating point.
        LawError: the law is none.
    """
    with scenario_under(law, on, **changes) as scenario:
        found = angles.attraction(scenario, after, within, watch)
    return _named(found, law)


def attraction_map(
    law: str | Path | Law | None = None,
    on: str | Path | Scenario = "pref_step",
    *,
    over: Over,
    after: float = angles.AFTER_S,
    within: float = angles.WITHIN,
    workers: int | str = 1,
    watch: Watch = SILENT,
    **changes: Any,
) -> TransientMap[Attraction]:
    """From which angles a converter comes back, over one to three quantities.

    Args:
        law, on, after, within, changes: as for ``attraction``.
        over, workers, watch: as for ``clearing_map``, e.g. ``{"references.P_ref": [0.2, 0.8]}``.

    Raises:
        UserError, LawError: as ``clearing_map``.
    """
    base = load_scenario(on, in_process=True, **changes)
    angles.check_attraction(base, after, within)
    work = partial(angles.attraction, after=after, within=within)
    return _map(law, base, over, work, Attraction.nowhere, workers, watch)


def _named(found: Found, law: str | Path | Law | None) -> Found:
    """With the name of a ``Law`` in place of that of its temporary file."""
    return replace(found, law=law.name) if isinstance(law, Law) else found


def _map(
    law: str | Path | Law | None,
    base: Scenario,
    over: Over,
    work: Callable[[Scenario], Found],
    nowhere: Callable[[Scenario], Found],
    workers: int | str,
    watch: Watch,
) -> TransientMap[Found]:
    """``work`` at every place of a map; ``nowhere`` is what it finds where none can begin."""
    axes = _axes(over)
    law = base.law if law is None else law
    own = as_law(law)
    found: dict[int, Found] = {}
    with ExitStack() as stack:  # the law has files of its own while this lasts
        tasks = [
            (k, _at(base, law, own, dict(zip(axes, values, strict=True)), stack))
            for k, values in enumerate(itertools.product(*axes.values()))
        ]

        def keep(result: tuple[int, Found]) -> None:
            found[result[0]] = replace(result[1], law=own.name)
            watch.progress(len(found), len(tasks), "")

        with pool_of(workers) as pool:
            each_law: dict[str, Scenario] = {scenario.law: scenario for _, scenario in tasks}
            pool.check_equal(partial(_digests, [*each_law.values()]))
            if pool.is_local:
                _compile_once([scenario for _, scenario in tasks], watch)
            run_tasks(partial(_work, work, nowhere), tasks, pool, keep, watch)
    if len(found) < len(tasks):
        raise KeyboardInterrupt
    return TransientMap(own.name, base.title, axes, tuple(found[k] for k in range(len(tasks))))


def _compile_once(scenarios: Sequence[Scenario], watch: Watch) -> None:
    """Fill numba's cache here, so that workers need not all compile the same."""
    for scenario in scenarios:
        with suppress(UserError):  # no operating point
            compiled_benches(scenario, watch.notice)
            return


def _digests(scenarios: Sequence[Scenario]) -> list[str]:
    return [scenario.digest() for scenario in scenarios]


def _axes(over: Over) -> dict[str, tuple[float, ...]]:
    """The quantities of a map. Raises UserError: they cannot be."""
    if not 1 <= len(over) <= 3:
        raise UserError(f"over: must be one to three quantities, not {len(over)}")
    axes = {name: tuple(map(float, values)) for name, values in over.items()}
    for name, values in axes.items():
        if not values or not all(map(math.isfinite, values)) or sorted({*values}) != [*values]:
            raise UserError(f"{name} = {[*values]}: must be finite and ascending values")
    if math.prod(map(len, axes.values())) > _MOST:
        raise UserError(f"over: must be at most {_MOST} places")
    return axes


def _at(
    base: Scenario, law: str | Path | Law, own: Law, values: Mapping[str, float], stack: ExitStack
) -> Scenario:
    """The scenario at one place of a map, under a law as the caller names it and as an object."""
    of_stage = {n.removeprefix(OF_STAGE): x for n, x in values.items() if n.startswith(OF_STAGE)}
    if of_stage:
        law = own.with_inner(base.inner, own.name, **of_stage)
        base = base.model_copy(update={"inner": None})
    (file,) = stack.enter_context(law_files([law])).values()
    keys: dict[str, Any] = {
        name.replace(".", "__"): x
        for name, x in values.items()
        if name != SCR and not name.startswith(OF_STAGE)
    }
    scenario = load_scenario(base, in_process=True, law=file, **keys)
    return at_short_circuit_ratios(scenario, [values[SCR]])[0] if SCR in values else scenario


def _work(
    work: Callable[[Scenario], Found],
    nowhere: Callable[[Scenario], Found],
    task: tuple[int, Scenario],
) -> tuple[int, Found]:
    k, scenario = task
    try:
        return k, work(scenario)
    except UserError:  # there is no operating point; all else was checked before
        return k, nowhere(scenario)
