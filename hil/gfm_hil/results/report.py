"""report.html: the summary and the figures of a run in one file that needs nothing else."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gfm_hil.recording.run import Run, controlled_by
from gfm_hil.results.curves import POINTS, PackedCurves, Panel
from gfm_hil.results.page import inline, plot_script, write_page
from gfm_hil.results.table import Cell, Table
from gfm_hil.run.network_run import NetworkRun
from gfm_hil.run.summary import END_METRICS

if TYPE_CHECKING:
    from gfm_hil.results.figures import Picture

EVENT_COLUMNS = (
    ("label", "event"),
    ("t", "t [s]"),
    ("p_peak", "p peak [p.u.]"),
    ("p_final", "p final [p.u.]"),
    ("t90_s", "t 90 % [s]"),
    ("settling_s", "settling 2 % [s]"),
    ("overshoot_pct", "overshoot [%]"),
    ("i_peak", "i peak [p.u.]"),
    ("i_peak_cycle", "i peak, one cycle [p.u.]"),
    ("f_nadir_hz", "f nadir [Hz]"),
    ("f_peak_hz", "f peak [Hz]"),
    ("rocof_hz_s", "RoCoF [Hz/s]"),
    ("v_min", "V min [p.u.]"),
    ("v_max", "V max [p.u.]"),
    ("damping_ratio", "swing: damping ratio"),
    ("oscillation_hz", "swing [Hz]"),
    ("fast_damping_ratio", "fast mode: damping ratio"),
    ("fast_hz", "fast mode [Hz]"),
    ("bump_pu", "bump [p.u.]"),
    ("cut_short", "cut short by"),
)


def event_rows(events: Sequence[dict[str, Any]]) -> list[tuple[str, str]]:
    """Keys and titles of ``EVENT_COLUMNS`` of which there is something to show.

    A response that a trip cut short has no final value; its cells say so.
    """
    cut = any("cut_short" in e for e in events)
    return [
        (key, title)
        for key, title in EVENT_COLUMNS
        if any(e.get(key) is not None for e in events) or (cut and key in END_METRICS)
    ]


def as_expected(summary: dict[str, Any]) -> bool:
    """Whether a run ended early as its scenario expects it to."""
    return summary["status"] != "completed" and not summary["unmet"]


def finite(value: Any) -> Any:
    """None in place of NaN and infinity, which JSON does not know, in lists and dicts too."""
    match value:
        case dict():
            return {k: finite(v) for k, v in value.items()}
        case list():
            return [finite(v) for v in value]
        case float() if not math.isfinite(value):
            return None
    return value


def staged(summary: Mapping[str, Any]) -> bool:
    """Whether laws of ours with an inner stage controlled the run."""
    return "inner" in summary and bool(summary["laws"])


def inner_stages(summary: Mapping[str, Any]) -> str:
    """The kinds of the laws' inner stages in words: one if all have the same."""
    kinds = summary["inner"]
    if len({*kinds.values()}) == 1:
        return str(next(iter(kinds.values())))
    return ", ".join(f"{law}: {kind}" for law, kind in kinds.items())


def write_report(run: Run | NetworkRun) -> None:
    """Draw the figures of a run and write report.html into its folder; of several converters in a
    network only the figures that they share."""
    # a second of imports, which the sides' processes do without
    from gfm_hil.results.diagram import draw_diagram
    from gfm_hil.results.figures import draw_comparison, draw_run, panels_of_run

    folder, scenario = run.folder, run.scenario
    assert folder is not None
    if isinstance(run, NetworkRun):
        draw_comparison(folder / "converters.png", scenario, run.columns, run.events)
        draw_diagram(folder, scenario)
        return
    pictures = draw_run(folder, scenario, run.columns, run.timing, run.summary)
    panels = []
    if "true_p" in run.columns:  # the first picture, as a reader can zoom it
        pictures = pictures[1:]
        panels = list(panels_of_run(scenario, run.columns, run.summary))
    _write_page(run, folder, panels, pictures, draw_diagram(folder, scenario))


def _write_page(
    run: Run, folder: Path, panels: Sequence[Panel], pictures: Sequence[Picture], diagram: Path
) -> None:
    summary, scenario = run.summary, run.scenario
    resolved = (folder / "scenario.toml").read_text("utf-8")
    for one in [scenario, *map(scenario.of, scenario.converters)]:
        for law in {*one.laws(), *one.compare}:
            resolved = resolved.replace(f'"{law}"', f'"{Path(law).name}"')
    write_page(
        folder / "report.html",
        "run.html",
        title=scenario.title,
        description=scenario.description,
        status=summary["status"],
        look="expected" if as_expected(summary) else summary["status"],
        reason=summary["reason"],
        unmet=summary["unmet"],
        unstable=summary.get("unstable_mode", ""),
        facts=Table(
            (), [(Cell(name, "head"), value) for name, value in _facts(summary)], text=None
        ),
        panels=panels,
        ticks=summary["ticks"],
        points=POINTS,
        curves=PackedCurves(),
        script=plot_script(),
        pictures=pictures,
        diagram=inline(diagram),
        events=_events(summary["events"]),
        resolved=resolved,
    )


def _facts(summary: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """What the report says of a run before its figures."""
    yield "controlled by", controlled_by(summary)
    if staged(summary):
        yield "inner stage", inner_stages(summary)
    yield "link, mode", f"{summary['link']}, {summary['mode']}"
    T_us = summary["T_s"] * 1e6
    yield "simulated", f"{summary['duration_s']:g} s, {summary['ticks']} ticks of {T_us:g} µs"
    yield "wall clock", f"{summary['wall_s']:.2f} s"
    yield "misses", summary["misses"]
    if "latency" in summary:
        yield "latency", summary["latency"]
    yield "bump at a law change [p.u.]", summary["bump_pu"]
    if summary["round_trip_us"]:
        yield (
            "round trip [µs]",
            ", ".join(f"{k} {v:g}" for k, v in summary["round_trip_us"].items()),
        )
    if "instructions" in summary:
        counts = summary["instructions"].items()
        yield "instructions of a step", ", ".join(f"{k} {v}" for k, v in counts)
    date = datetime.fromisoformat(summary["date"]).strftime("%Y-%m-%d %H:%M:%S UTC")
    yield "date, version", f"{date}, gfmhil {summary['version']}"
    for machine, judged in summary["machines"].items():
        said = f", doctor: {judged['worst']} ({'; '.join(judged['findings'])})" if judged else ""
        yield "machine", machine + said
    if any(summary["faults"].values()):
        missing = (
            f"{role}: {', '.join(f'{number} {name}' for name, number in counted.items()) or 'none'}"
            for role, counted in summary["faults"].items()
        )
        yield "frames refused or lost", "; ".join(missing)
    if summary["e2e"]:
        yield (
            "end-to-end protection",
            ", ".join(f"{role} {state}" for role, state in summary["e2e"].items()),
        )


def _events(events: Sequence[dict[str, Any]]) -> Table:
    """What followed from each event: a column each, or a row each if there are many."""
    columns = event_rows(events)
    rows: list[list[Any]] = [
        [title, *(event.get(name) for event in events)] for name, title in columns
    ]
    if len(events) > len(columns):
        rows = [list(row) for row in zip(*rows, strict=True)]
    return Table(rows[0] if rows else (), rows[1:])


def events_table(events: Sequence[dict[str, Any]]) -> Table:
    """What followed from each event: a quantity a row, an event a column."""
    heads = [f"{event['label']} @ {event['t']:g} s" for event in events]
    rows = [row for row in event_rows(events) if row[0] not in ("label", "t")]
    cells = [[title, *(event.get(name) for event in events)] for name, title in rows]
    return Table(["", *heads], cells)
