"""report.html: the summary and the figures of a run in one file that needs nothing else."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gfm_hil.core.beside import beside
from gfm_hil.recording.run import Run, controlled_by
from gfm_hil.recording.waveforms import NEEDS
from gfm_hil.results.curves import POINTS, PackedCurves, Panel
from gfm_hil.results.page import plot_script, write_page
from gfm_hil.results.table import Cell, Table
from gfm_hil.run.network_run import NetworkRun
from gfm_hil.run.summary import END_METRICS
from gfm_hil.scenario import Scenario, scenario_toml

if TYPE_CHECKING:
    from gfm_hil.results.figures import Picture

PAGE = "report.html"
_COMMANDS = 200  # that a report shows
_OF_ALL = 40_000  # points of a panel times runs, so that a page of many runs stays small

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


def has_stages(summary: Mapping[str, Any]) -> bool:
    """Whether laws of ours with an inner stage controlled the run."""
    return "inner" in summary and bool(summary["laws"])


def inner_stages(summary: Mapping[str, Any]) -> str:
    """The kinds of the laws' inner stages in words: one if all have the same."""
    kinds = summary["inner"]
    if len({*kinds.values()}) == 1:
        return str(next(iter(kinds.values())))
    return ", ".join(f"{law}: {kind}" for law, kind in kinds.items())


@dataclass(frozen=True)
class Chapter:
    """What a report tells of one run."""

    name: str  # of the converter or the law; empty if the report has no other run
    summary: dict[str, Any]
    panels: Sequence[Panel]
    waves: Sequence[Panel]
    timing: Picture | None

    @property
    def place(self) -> str:
        """Where in the page it is."""
        return "of-" + re.sub(r"[^\w-]+", "-", self.name)

    @property
    def look(self) -> str:
        """The class of the status."""
        return "expected" if as_expected(self.summary) else str(self.summary["status"])

    @property
    def facts(self) -> Table:
        """What is told before the figures."""
        rows = [(Cell(name, "head"), value) for name, value in _facts(self.summary)]
        return Table((), rows, text=None)

    @property
    def events(self) -> Table:
        """What followed from each event."""
        return _events(self.summary["events"])


def write_report(run: Run | NetworkRun) -> None:
    """Draw the figures of a run and write report.html into its folder; of several converters in a
    network only the figures that they share, and one report of all."""
    # a second of imports, which the sides' processes do without
    from gfm_hil.results.diagram import draw_diagram
    from gfm_hil.results.figures import (
        SHARED,
        draw_comparison,
        draw_run,
        draw_timing,
        panels_of_network,
    )

    folder, scenario = run.folder, run.scenario
    assert folder is not None
    if isinstance(run, NetworkRun):
        common = folder / "converters.png"
        with beside(draw_comparison, common, scenario, run.columns, run.events, SHARED):
            diagram = draw_diagram(folder, scenario, PAGE)
            write_together(
                folder, scenario, run.runs, run.events, "converter", "converters.png", diagram,
                [*panels_of_network(run)] if len(run.flows) > 1 else [],
            )  # fmt: skip
        return
    with draw_run(run):
        timing = None
        if run.summary["mode"] == "realtime" and run.summary["round_trip_us"]:
            timing = draw_timing(run)
        content = {
            "chapters": [_chapter("", run, POINTS, timing)], "shared": [], "kind": "",
            "commands": _commands({"": run}),
        }  # fmt: skip
        diagram = draw_diagram(folder, scenario)
        _write_page(folder, scenario, content, diagram, POINTS, run.ticks, "signals.png", folder)


def write_together(
    folder: Path,
    scenario: Scenario,
    runs: Mapping[str, Run],
    events: Sequence[dict[str, Any]],
    kind: str,
    picture: str,
    diagram: str = "",
    of_network: Sequence[Panel] = (),
) -> None:
    """Write report.html of several runs, which show the same quantities beside each other.

    Args:
        folder: which holds ``picture``, for readers without JavaScript.
        scenario: of the network, or of the first run.
        runs: by name; those that recorded the plant are shown.
        events: that all figures of all runs mark.
        kind: what the names are of, ``converter``, ``law``, or ``run`` of a network's converter
            under a law.
        diagram: of the network; drawn if there is none.
        of_network: what was recorded of its lines, loads and other parts.
    """
    from gfm_hil.results.diagram import ONLY, draw_diagram
    from gfm_hil.results.figures import panels_of_all

    known = {name: run for name, run in runs.items() if run.ticks and "true_p" in run.columns}
    most = min(POINTS, _OF_ALL // max(1, len(known)))
    columns = {name: run.columns for name, run in known.items()}
    # a recording that others made has curves, and nothing else to tell
    ours = {name: run for name, run in known.items() if "machines" in run.summary}
    chapters = [_chapter(name, run, most) for name, run in ours.items()]
    rows = [
        [Cell(c.name, "head", f"#{c.place}"), controlled_by(c.summary),
         c.summary["status"], c.summary["reason"], c.summary["misses"]]
        for c in chapters
    ]  # fmt: skip
    content = {
        "chapters": chapters,
        "kind": kind,
        "runs": Table([kind, "controlled by", "status", "reason", "misses"], rows, text=4),
        "shared": [*panels_of_all(scenario, columns, events, most)] if columns else [],
        "flows": of_network,
        "commands": _commands(runs),
    }
    ticks = max((run.ticks for run in known.values()), default=0)
    if not diagram:
        diagram = draw_diagram(folder, scenario, PAGE if kind == "run" else None, ONLY)
    folders = (run.folder for run in runs.values() if run.folder is not None)
    source = folder if kind == "converter" else next(folders, None)
    _write_page(folder, scenario, content, diagram, most, ticks, picture, source)


def _chapter(name: str, run: Run, most: int, timing: Picture | None = None) -> Chapter:
    from gfm_hil.results.figures import panels_of_run, panels_of_waves

    panels = [*panels_of_run(run, most)] if "true_p" in run.columns else []
    waves = [*panels_of_waves(run)] if run.columns.keys() >= {*NEEDS} else []
    return Chapter(name, run.summary, panels, waves, timing)


def _write_page(
    folder: Path, scenario: Scenario, content: Mapping[str, Any], diagram: str, most: int,
    ticks: int, picture: str, source: Path | None,
) -> None:  # fmt: skip
    from markupsafe import Markup

    if source is None:
        resolved = scenario_toml(scenario)
    else:  # which names the files of its events there
        resolved = (source / "scenario.toml").read_text("utf-8")
    for one in [scenario, *scenario.each.values()]:
        for law in {*one.laws(), *one.compare}:
            resolved = resolved.replace(f'"{law}"', f'"{Path(law).name}"')
    curves, script = PackedCurves(), plot_script()
    write_page(
        folder / PAGE, "run.html", title=scenario.title,
        description=scenario.description, **content, most=most, ticks=ticks,
        curves=curves, script=script, picture=picture, diagram=Markup(diagram), resolved=resolved,
    )  # fmt: skip


def _facts(summary: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """What the report says of a run before its figures."""
    yield "controlled by", controlled_by(summary)
    if has_stages(summary):
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
    for note in summary.get("notes", ()):
        yield f"note at {note['t']:g} s", note["text"]
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


def _commands(runs: Mapping[str, Run]) -> Table:
    """What operators did, each command once, with the converters whose logs have it."""
    found: dict[tuple[float, str, str], list[str]] = {}
    for name, run in runs.items():
        for line in run.events:
            if "operator" not in line:
                continue
            what = "stop" if line["event"] == "end" else line.get("label") or line["event"]
            by = line["operator"]
            who = (by.get(key) for key in ("through", "name", "certificate", "peer"))
            found.setdefault((line["t"], what, ", ".join(filter(None, who))), []).append(name)
    rows = [
        [f"{t:g}", what, *([", ".join(names)] if len(runs) > 1 else []), who]
        for (t, what, who), names in sorted(found.items())
    ]
    heads = ["t [s]", "command", *(["in the log of"] if len(runs) > 1 else []), "by"]
    more = f"{len(rows) - _COMMANDS} more are in events.jsonl." if len(rows) > _COMMANDS else ""
    return Table(heads, rows[:_COMMANDS], caption=more, text=None)


def events_table(events: Sequence[dict[str, Any]]) -> Table:
    """What followed from each event: a quantity a row, an event a column."""
    heads = [f"{event['label']} @ {event['t']:g} s" for event in events]
    rows = [row for row in event_rows(events) if row[0] not in ("label", "t")]
    cells = [[title, *(event.get(name) for event in events)] for name, title in rows]
    return Table(["", *heads], cells)
