"""report.html: the summary and the figures of a run in one file that needs nothing else."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gfm_hil.core.files import write_text
from gfm_hil.recording.run import Run, controlled_by
from gfm_hil.run.network_run import NetworkRun
from gfm_hil.run.summary import END_METRICS
from gfm_hil.scenario.model import Scenario

if TYPE_CHECKING:
    from gfm_hil.results.figures import Picture

#: of every page that this program writes
STYLE = """
:root{color-scheme:light dark;--ink:#222;--paper:#fff;--line:#e4e4e4;--soft:#f6f6f6;--wrong:#b34500}
@media (prefers-color-scheme:dark){
:root{--ink:#ddd;--paper:#1a1a1a;--line:#3a3a3a;--soft:#262626;--wrong:#ff9d66}
a{color:#8ab4f8} svg,img{filter:invert(.9) hue-rotate(180deg)}}
body{font:15px/1.5 system-ui,sans-serif;max-width:70rem;margin:2rem auto;padding:0 1rem;
color:var(--ink);background:var(--paper);overflow-wrap:break-word}
h1{font-size:1.4rem;margin-bottom:.2rem} h2{font-size:1.1rem;margin-top:2rem}
table{border-collapse:collapse;margin:.6rem 0} th,td{padding:.25rem .8rem .25rem 0;text-align:left;
border-bottom:1px solid var(--line);font-variant-numeric:tabular-nums}
.scroll :is(th,td):not(:first-child){text-align:right}
.scroll{overflow-x:auto} .scroll th{white-space:nowrap}
.panels{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,28rem),1fr));
gap:1rem;align-items:end;margin:1.5rem 0} .panels svg{width:100%}
.status{display:inline-block;padding:.1rem .6rem;border-radius:.3rem;color:#fff;background:#555}
.completed,.expected{background:#00734f} .oscillating,.tripped,.safe{background:#b34500}
.unmet{color:var(--wrong)}
pre{background:var(--soft);padding:1rem;overflow-x:auto;font-size:13px}
"""

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


def cell(value: Any) -> str:
    """A value as people read it; – for one that is unknown or that there is not."""
    match value:
        case None:
            return "–"
        case float():
            return f"{value:.4g}" if abs(value) < 10 else f"{value:.5g}"
        case list():
            return ", ".join(cell(v) for v in value) or "–"
    return str(value)


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


def html_table(heads: Sequence[str], rows: Iterable[Sequence[str]], caption: str = "") -> str:
    """A table in HTML, which may be wider than the page."""

    def line(tag: str, cells: Sequence[str]) -> str:
        return f"<tr>{''.join(f'<{tag}>{html.escape(cell)}</{tag}>' for cell in cells)}</tr>"

    title = f"<caption>{html.escape(caption)}</caption>" if caption else ""
    body = line("th", heads) + "".join(line("td", row) for row in rows)
    return f'<div class="scroll"><table>{title}{body}</table></div>'


def write_report(run: Run | NetworkRun) -> None:
    """Draw the figures of a run and write report.html into its folder; of several converters in a
    network only the figures that they share."""
    # a second of imports, which the sides' processes do without
    from gfm_hil.results.diagram import draw_diagram
    from gfm_hil.results.figures import draw_comparison, draw_run

    folder, scenario = run.folder, run.scenario
    assert folder is not None
    if isinstance(run, NetworkRun):
        draw_comparison(folder / "converters.png", scenario, run.columns, run.events)
        draw_diagram(folder, scenario)
        return
    pictures = draw_run(folder, scenario, run.columns, run.timing, run.summary)
    _write_page(folder, scenario, run.summary, pictures, draw_diagram(folder, scenario))


def _write_page(
    folder: Path,
    scenario: Scenario,
    summary: dict[str, Any],
    pictures: Sequence[Picture],
    diagram: Path,
) -> None:
    status = html.escape(summary["status"])
    look, expected = ("expected", ", as expected:") if as_expected(summary) else (status, "")
    facts = [
        ("controlled by", controlled_by(summary)),
        *([("inner stage", inner_stages(summary))] if staged(summary) else []),
        ("link, mode", f"{summary['link']}, {summary['mode']}"),
        (
            "simulated",
            f"{summary['duration_s']:g} s, {summary['ticks']} ticks of {summary['T_s'] * 1e6:g} µs",
        ),
        ("wall clock", f"{summary['wall_s']:.2f} s"),
        ("misses", cell(summary["misses"])),
        ("bump at a law change [p.u.]", cell(summary["bump_pu"])),
    ]
    if summary["round_trip_us"]:
        times = ", ".join(f"{k} {v:g}" for k, v in summary["round_trip_us"].items())
        facts.append(("round trip [µs]", times))
    if "instructions" in summary:
        counts = ", ".join(f"{k} {v}" for k, v in summary["instructions"].items())
        facts.append(("instructions of a step", counts))
    date = datetime.fromisoformat(summary["date"]).strftime("%Y-%m-%d %H:%M:%S UTC")
    facts.append(("date, version", f"{date}, gfmhil {summary['version']}"))
    for machine, found in summary["machines"].items():
        judged = f", doctor: {found['worst']} ({'; '.join(found['findings'])})" if found else ""
        facts.append(("machine", machine + judged))
    if any(summary["faults"].values()):
        missing = (
            f"{role}: {', '.join(f'{number} {name}' for name, number in counted.items()) or 'none'}"
            for role, counted in summary["faults"].items()
        )
        facts.append(("frames refused or lost", "; ".join(missing)))
    if summary["e2e"]:
        states = ", ".join(f"{role} {state}" for role, state in summary["e2e"].items())
        facts.append(("end-to-end protection", states))
    rows = "".join(f"<tr><th>{html.escape(a)}</th><td>{html.escape(b)}</td></tr>" for a, b in facts)
    images = "".join(figure(picture.path.stem, picture.panels) for picture in pictures)
    images += f'<p class="scroll"><img alt="network" src="{inline(diagram)}"></p>'
    unmet = "".join(
        f'<p class="unmet">not as expected: {html.escape(part)}</p>' for part in summary["unmet"]
    )
    resolved = (folder / "scenario.toml").read_text("utf-8")
    for one in [scenario, *map(scenario.of, scenario.converters)]:
        for law in {*one.laws(), *one.compare}:
            resolved = resolved.replace(f'"{law}"', f'"{Path(law).name}"')
    resolved = html.escape(resolved)
    path = folder / "report.html"
    write_text(
        path,
        f"""<!doctype html><html lang="en"><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{html.escape(scenario.title)}</title><style>{STYLE}</style>
<h1>{html.escape(scenario.title)}</h1>
<p><span class="status {look}">{status}</span>{expected} {html.escape(summary["reason"])}</p>
{unmet}
<p>{html.escape(scenario.description)}</p>
<table>{rows}</table>
{images}
<h2>Events</h2>{_events(summary["events"])}
<h2>Scenario as resolved</h2><pre>{resolved}</pre></html>
""",
    )


def _events(events: Sequence[dict[str, Any]]) -> str:
    """What each event brought: a column each, or a row each if there are many."""
    columns = event_rows(events)
    rows = [[title, *(cell(event.get(name)) for event in events)] for name, title in columns]
    if len(events) > len(columns):
        rows = [list(row) for row in zip(*rows, strict=True)]
    return html_table(rows[0], rows[1:]) if rows else "<p>None.</p>"


def figure(name: str, panels: Sequence[str]) -> str:
    """A figure of which a page sets as many panels side by side as are readable there."""
    return f'<figure class="panels" aria-label="{html.escape(name)}">{"".join(panels)}</figure>'


def inline(picture: Path) -> str:
    """A picture as the address of an image in a page that needs no other file."""
    kind = {".png": "png", ".svg": "svg+xml"}[picture.suffix]
    return f"data:image/{kind};base64,{base64.b64encode(picture.read_bytes()).decode()}"
