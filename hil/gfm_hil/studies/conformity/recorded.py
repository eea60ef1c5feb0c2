"""A recording of hardware or of another simulator, judged as a run of the part of a test."""

from pathlib import Path

from gfm_hil.core.errors import UserError
from gfm_hil.recording.foreign import ABOUT, open_recording
from gfm_hil.scenario import Scenario
from gfm_hil.studies.conformity.criteria.base import UnderTest, judge
from gfm_hil.studies.conformity.execute import PartResult, slug
from gfm_hil.studies.conformity.panels import PartFigure, panels_of_run
from gfm_hil.studies.conformity.sets import Case, TestPart, scenario_of
from gfm_runtime.errors import allowed


def part_of(case: Case, name: str | None) -> TestPart:
    """The part of a test by its name; the only one without a name. Raises UserError: there is no
    such part, or there are several."""
    parts = {part.name: part for part in case.test.runs()}
    if name is None and len(parts) == 1:
        return next(iter(parts.values()))
    if name not in parts:
        said = "is missing" if name is None else allowed(name, [*parts])
        if name is None:
            said += f": a recording is of one of {', '.join(parts)}"
        raise UserError(f"--part {name or ''}: {said}".replace(" :", ":"))
    if (why := parts[name].cannot) is not None:
        raise UserError(f"--part {name}: the bench cannot judge it: {why}")
    return parts[name]


def judge_recording(
    file: Path, map_file: Path, case: Case, part: TestPart, under: UnderTest, place: Path,
    folder: Path | None,
) -> tuple[PartResult, str]:  # fmt: skip
    """What a recording shows of a part of a test, and how it was read; ``place`` is for converter
    files, ``folder``, if any, for the figure. Raises UserError: see ``open_recording``."""
    law = Scenario.model_fields["law"].default  # of which nothing counts
    run = open_recording(file, map_file, scenario_of(case, part, under, law, None, place))
    verdicts = judge(run, case.test.clauses(part), under)
    figure = None
    if folder is not None and run.ticks:
        from gfm_hil.studies.conformity.figure import draw_panels  # half a second to import

        at = folder / "runs" / slug(file.stem) / "figure.png"
        at.parent.mkdir(parents=True, exist_ok=True)
        panels = panels_of_run(run, verdicts)
        draw_panels(at, f"{file.name} · {case.id} · {run.scenario.title}", panels)
        figure = PartFigure(at, panels)
    made = PartResult(
        file.stem, case.id, part.name, run.status, run.summary["reason"], verdicts,
        recording=run.digest, figure=figure,
    )  # fmt: skip
    return made, run.summary[ABOUT]["words"]
