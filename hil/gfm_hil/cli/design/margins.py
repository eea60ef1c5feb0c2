"""gfmhil design margins: what a law's sampled loop stands, and whether a run stayed within it.

What has no limit is null in JSON, and "—" in a table.
"""

import argparse
import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.markup import escape

from gfm_design.margins.all_margins import (
    ChannelMargins,
    LoopMargins,
    Margins,
    UnstableLoop,
    loop_margins,
    margins,
)
from gfm_design.margins.locus import DiskMargin
from gfm_design.margins.tolerance import POINTS, End, GridStrength, Range, Region, stable_region
from gfm_design.model.closed_loop import ClosedLoop
from gfm_design.model.dead_time import with_dead_time
from gfm_hil.cli.common import EXIT_OTHERWISE, print_result, watching
from gfm_hil.cli.design.common import add_loop_options, chosen_scenario
from gfm_hil.core.errors import UserError
from gfm_hil.recording.run import Run
from gfm_hil.results.table import Table
from gfm_hil.run.loop_delay import LoopDelay, loop_delay
from gfm_hil.studies.linear_loop import scenario_loop
from gfm_hil.studies.margin_figures import draw_delay, draw_region


def add(kinds: Any) -> None:
    command = kinds.add_parser(
        "margins", help="gain, phase, delay and disk margins, parameter ranges, stable grids"
    )
    where = add_loop_options(command)
    where.add_argument("--run", type=Path, metavar="DIR", help="run folder: its scenario and delay")
    command.add_argument(
        "--dead-time", type=float, metavar="S",
        help="with the dead time of a two-level bridge, by its describing function, s; without"
        " ranges of elements and grids",
    )  # fmt: skip
    command.add_argument(
        "--figures", type=Path, metavar="DIR", help="draw region.png and delay.png into DIR"
    )
    command.set_defaults(call=call)


def call(options: argparse.Namespace) -> int:
    """Report the margins; exit code 3 for an unstable loop, which has none."""
    run, given = None, options.scenario
    if options.run is not None:
        run, given = Run.load(options.run), str(options.run / "scenario.toml")
    scenario = chosen_scenario(given, options)
    if options.figures and scenario.network is not None:
        raise UserError("--figures: they are those of one converter on its line to the grid")
    if options.figures and options.dead_time is not None:
        raise UserError("--figures: are drawn without a dead time")
    loop, label = scenario_loop(scenario, options.converter)
    if options.dead_time is not None:
        try:
            loop = with_dead_time(loop, options.dead_time)
        except ValueError as problem:
            raise UserError(f"--dead-time: {problem}") from None
        label = f"{label}, {1e6 * options.dead_time:g} µs of dead time"
    try:
        whole = scenario.network is None and options.dead_time is None
        ranges = margins(loop) if whole else None
        found = loop_margins(loop) if ranges is None else ranges.loop
    except UnstableLoop as problem:
        none = "; --figures: there is none to draw" if options.figures else ""
        return no_margins(options, label, scenario.title, problem, none)
    margin = found.delay.seconds
    set_s = float(loop.u_delay[0])
    measured = None if run is None else loop_delay(run, set_s, margin)
    region = _draw(options.figures, loop, label, margin) if options.figures else None
    content = {"law": label, "scenario": scenario.title, "stable": True}
    content |= _as_json(found, ranges, set_s, measured)
    said = [f"[bold]{label}[/] · {scenario.title}", *_in_words(found, ranges, set_s, measured)]
    if region is not None:
        content["region"] = {n: getattr(region, n).tolist() for n in ("L_g", "R_g", "sigma")}
        said.append(f"figures: {options.figures}")
    print_result(options, content, said)
    return 0


def _draw(folder: Path, loop: ClosedLoop, label: str, margin: float) -> Region:
    folder.mkdir(parents=True, exist_ok=True)
    with watching("stable region") as watch:
        region = stable_region(loop, POINTS, lambda rows: watch.progress(rows, POINTS, ""))
    draw_region(folder / "region.png", loop, label, region)
    draw_delay(folder / "delay.png", loop, label, margin)
    return region


def _as_json(
    loop: LoopMargins, more: Margins | None, set_s: float, measured: LoopDelay | None
) -> dict[str, Any]:
    """The margins of a loop, and the ranges of ``more``; ``set_s`` is the loop delay that they are
    on top of, s."""
    out: dict[str, Any] = {
        "mode": loop.worst.plain(),
        "loop_delay_us": round(1e6 * set_s, 6),
        "delay_us": 1e6 * loop.delay.seconds,
        "delay_hz": loop.delay.frequency_hz,
        "delay_looked_at_us": 1e6 * loop.longest,
        "u": {c.name: channel_as_json(c) for c in loop.u},
        "y": {c.name: channel_as_json(c) for c in loop.y},
        "disk": {"u": _disk(loop.disk_u), "y": _disk(loop.disk_y)},
    }
    if more is not None:
        out["elements"] = {name: _range(r) if r else None for name, r in more.elements.items()}
        out["grid"] = _grid(more.grid)
    if measured is not None:
        margin = 1e6 * loop.delay.seconds
        out["run"] = {
            **asdict(measured),
            "allowed_us": measured.set_us + margin,
            "fits": measured.fits(margin),
            "verdict": measured.words(margin),
        }
    return out


def no_margins(
    options: argparse.Namespace, law: str, scenario: str, problem: UnstableLoop, more: str = ""
) -> int:
    """Say that an unstable loop has none, and ``more``; returns the exit code."""
    content = {"law": law, "scenario": scenario, "stable": False}
    content |= {"mode": problem.mode.plain(), "reason": str(problem)}
    print_result(options, content, [escape(f"{law}: no margins, {problem}{more}")])
    return EXIT_OTHERWISE


def channel_as_json(c: ChannelMargins) -> dict[str, Any]:
    """The margins of one channel."""
    delay = {"delay_us": 1e6 * c.delay.seconds, "delay_hz": c.delay.frequency_hz}
    return {**asdict(c.gain_phase), **delay, "confirmed": c.confirmed}


def _disk(d: DiskMargin) -> dict[str, Any]:
    return {
        "alpha": d.alpha,
        "frequency_hz": d.frequency_hz,
        "gain": list(d.gain),
        "phase_deg": d.phase_deg,
        "alpha_unstructured": d.full,
    }


def _end(end: End) -> dict[str, Any]:
    lost = end.lost.plain() if end.lost else ("no operating point" if end.bounded else None)
    return {"percent": 100 * (end.factor - 1), "factor": end.factor, "lost": lost}


def _range(r: Range) -> dict[str, Any]:
    return {"low": _end(r.low), "high": _end(r.high)}


def _grid(g: GridStrength) -> dict[str, Any]:
    return {
        "scr": g.now,
        "x_over_r": g.x_over_r,
        "strongest_scr": g.strongest,
        "strongest_is_limit": g.range.low.bounded,
        "weakest_scr": g.weakest,
        "weakest_is_limit": g.range.high.bounded,
        **_range(g.range),
    }


def _in_words(
    loop: LoopMargins, ranges: Margins | None, set_s: float, run: LoopDelay | None
) -> Iterator[str | Table]:
    """Everything for a terminal; arguments as for ``_as_json``."""
    yield (
        f"least damped: damping ratio {loop.worst.ratio:.3g} at {loop.worst.frequency_hz:.4g} Hz, "
        f"sigma = {loop.worst.sigma:.4g} 1/s"
    )
    delay = (
        f"more than {1e6 * loop.longest:g} µs"
        if math.isinf(loop.delay.seconds)
        else f"{1e6 * loop.delay.seconds:.4g} µs, then {loop.delay.frequency_hz:.4g} Hz is lost"
    )
    yield f"[bold]delay margin[/] on top of {1e6 * set_s:g} µs: {delay}\n"
    yield loops_table((*loop.u, *loop.y))
    for name, disk in (("u", loop.disk_u), ("y", loop.disk_y)):
        low, high = disk.gain
        yield (
            f"disk margin at {name}, all at once: α ≥ {disk.alpha:.4g} at "
            f"{disk.frequency_hz:.4g} Hz (gains {low:.3g} … {high:.3g}, ±{disk.phase_deg:.3g}°; "
            f"unstructured {disk.full:.3g})"
        )
    if ranges is not None:
        yield _elements_table(ranges)
        g = ranges.grid
        ends = f"strongest {g.strongest:.4g}{_why(g.range.low)}"
        ends += f", weakest {g.weakest:.4g}{_why(g.range.high)}"
        yield f"grid at X/R = {g.x_over_r:.3g}: SCR {g.now:.4g}; {ends}"
    if run is not None:
        yield f"\n[bold]this run[/] {run.words(1e6 * loop.delay.seconds)}"
        if run.round_trip_us:
            text = ", ".join(f"{k} {v:g}" for k, v in run.round_trip_us.items())
            yield f"y\\[k] sent to u\\[k] received, µs: {text} (T_s = {run.T_s_us:g})"
        if run.acting_us:
            text = ", ".join(f"{k} {v:g}" for k, v in run.acting_us.items())
            yield f"y\\[k] sampled to u\\[k] acting, holds included, µs: {text}"


def loops_table(channels: Iterable[ChannelMargins]) -> Table:
    """Gain, phase, delay and disk margin, one row a channel."""
    heads = "loop at", "gain ↓ @ Hz", "gain ↑ @ Hz", "phase @ Hz", "delay µs @ Hz", "disk α"
    rows = []
    for c in channels:
        g = c.gain_phase
        row = (
            c.name + ("" if c.confirmed else " (not confirmed)"),
            _at(g.gain_low, g.gain_low_hz, "×") if g.gain_low else "—",
            _at(g.gain_high, g.gain_high_hz, "×"),
            _at(g.phase_deg, g.phase_hz, "", "°"),
            _delay(1e6 * c.delay.seconds, c.delay.frequency_hz),
            f"{g.disk:.3g}",
        )
        rows.append(row)
    return Table(heads, rows)


def _at(value: float, hz: float, before: str = "", after: str = "") -> str:
    return f"{before}{value:.3g}{after} @ {hz:.3g}" if math.isfinite(value) else "—"


def _delay(us: float, hz: float) -> str:
    return f"{us:.4g} @ {hz:.3g}" if math.isfinite(us) else "—"


def _elements_table(m: Margins) -> Table:
    rows = []
    for name, r in m.elements.items():
        ends = (r.low, r.high) if r else ()
        cells = [f"{100 * (e.factor - 1):+.4g} %{_why(e)}" for e in ends] or ["is 0", "is 0"]
        rows.append([name, *cells])
    return Table(("element", "down to", "up to"), rows)


def _why(end: End) -> str:
    if not end.bounded:
        return " (no limit)"
    if end.lost is None:
        return " (no operating point)"
    return f" ({end.lost.frequency_hz:.4g} Hz)" if end.lost.frequency_hz else " (a real mode)"
