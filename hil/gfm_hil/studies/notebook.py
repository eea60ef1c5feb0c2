"""What a notebook calls: a run, or several laws side by side, in memory and silent."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gfm_hil.core.errors import UserError
from gfm_hil.results.run import Run
from gfm_hil.results.runner import run_in_memory
from gfm_hil.scenario.model import Scenario, check_scenario, load_scenario
from gfm_hil.studies.law import Law

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def run(
    scenario: str | Path | Scenario | dict[str, Any],
    law: str | Path | Law | None = None,
    **changes: Any,
) -> Run:
    """Run a scenario in this process, in lockstep, and keep the result in memory.

    Args:
        scenario: name of a shipped one, path of a file, content of a file, or a checked scenario.
        law: name, law file or ``Law``; the scenario's own if None.
        changes: keys of the scenario with ``__`` for the dot, e.g. ``duration=2.0`` [s],
            ``plant__factors__L_g=2.0``.

    Raises:
        UserError: one line a mistake; or the scenario has no operating point.
        LawError: the law is none.
    """
    with tempfile.TemporaryDirectory(prefix="gfmhil-law-") as place:
        if isinstance(law, Law):
            law = law.save(Path(place) / f"{law.name}.toml")
        if law is not None:
            changes = {**changes, "law": str(law)}
        return run_in_memory(_scenario(scenario, changes))


def _scenario(given: str | Path | Scenario | dict[str, Any], changes: dict[str, Any]) -> Scenario:
    here = {"mode": "lockstep", "link__type": "inproc", **changes}
    if isinstance(given, str | Path):
        return load_scenario(str(given), **here)
    content = given if isinstance(given, dict) else given.model_dump(mode="json", exclude_none=True)
    return check_scenario(_changed(content, here), "scenario")


def _changed(content: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """A copy with keys changed by their path."""
    found = dict(content)
    for key, value in changes.items():
        first, _, rest = key.partition("__")
        inner = found.get(first, {})
        if rest and not isinstance(inner, dict):
            raise UserError(f"{key}: {first} is no table")
        found[first] = _changed(inner, {rest: value}) if rest else value
    if found.get("link", {}).get("type") == "inproc":
        found["link"] = {"type": "inproc"}
    return found


@dataclass(frozen=True, repr=False)
class Comparison(Mapping[str, Run]):
    """Runs of one scenario by the name of their law."""

    runs: dict[str, Run]

    def __getitem__(self, law: str) -> Run:
        return self.runs[law]

    def __iter__(self) -> Iterator[str]:
        return iter(self.runs)

    def __len__(self) -> int:
        return len(self.runs)

    @property
    def metrics(self) -> dict[str, dict[str, dict[str, Any]]]:
        """The metrics of each run by law, see ``Run.metrics``."""
        return {law: one.metrics for law, one in self.runs.items()}

    def plot(self) -> list[Axes]:
        """p, frequency, q and v_dc of all laws in one figure."""
        from matplotlib import pyplot

        from gfm_hil.results import figures

        first = next(iter(self.runs.values()))
        events = max((one.summary["events"] for one in self.runs.values()), key=len)
        columns = {law: one.columns for law, one in self.runs.items()}
        figure = pyplot.figure(figsize=figures.SIZE_LAWS, layout="constrained")
        return figures.draw_laws(figure, first.scenario, columns, events)

    def __repr__(self) -> str:
        lines = [f"  {law}: {one.status}" for law, one in self.runs.items()]
        return "\n".join(["<Comparison", *lines, ">"])


def compare(
    scenario: str | Path | Scenario | dict[str, Any],
    laws: Sequence[str | Path | Law],
    **changes: Any,
) -> Comparison:
    """Run a scenario under several laws; arguments and errors as for ``run``."""
    if not laws:
        raise UserError("laws: name some laws to compare")
    names = [law.name if isinstance(law, Law) else str(law) for law in laws]
    return Comparison(
        {name: run(scenario, law, **changes) for name, law in zip(names, laws, strict=True)}
    )
