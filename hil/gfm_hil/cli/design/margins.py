"""gfmhil design margins: what a law's sampled loop stands, and whether a run stayed within it."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from gfm_design.margins.all_margins import UnstableLoop, loop_margins, margins
from gfm_design.margins.tolerance import POINTS, Region, stable_region
from gfm_design.model.closed_loop import ClosedLoop
from gfm_hil.cli.common import watching
from gfm_hil.cli.design.common import add_converter_option, add_inner_option, chosen_scenario
from gfm_hil.cli.design.margin_report import margins_as_json, no_margins, print_margins
from gfm_hil.core.errors import UserError
from gfm_hil.core.terminal import terminal
from gfm_hil.recording.run import Run
from gfm_hil.results.report import finite
from gfm_hil.run.loop_delay import loop_delay
from gfm_hil.studies.linear_loop import scenario_loop
from gfm_hil.studies.margin_figures import draw_delay, draw_region


def add(kinds: Any) -> None:
    command = kinds.add_parser(
        "margins", help="gain, phase, delay and disk margins, parameter ranges, stable grids"
    )
    command.add_argument("--law", help="catalogue name or law file; the scenario's by default")
    add_inner_option(command)
    add_converter_option(command)
    where = command.add_mutually_exclusive_group()
    where.add_argument(
        "--scenario", default="pref_step",
        help="scenario file or shipped name: plant, references, T_s; pref_step by default",
    )  # fmt: skip
    where.add_argument("--run", type=Path, metavar="DIR", help="run folder: its scenario and delay")
    command.add_argument(
        "--figures", type=Path, metavar="DIR", help="draw region.png and delay.png into DIR"
    )
    command.add_argument("--json", action="store_true", help="as JSON")
    command.set_defaults(call=call)


def call(options: argparse.Namespace) -> int:
    """Report the margins; exit code 3 for an unstable loop, which has none."""
    run, given = None, options.scenario
    if options.run is not None:
        run, given = Run.load(options.run), str(options.run / "scenario.toml")
    scenario = chosen_scenario(given, options)
    if options.figures and scenario.network is not None:
        raise UserError("--figures: they are those of one converter on its line to the grid")
    loop, label = scenario_loop(scenario, options.converter)
    console = terminal(highlight=False)
    try:
        ranges = margins(loop) if scenario.network is None else None
        found = loop_margins(loop) if ranges is None else ranges.loop
    except UnstableLoop as problem:
        none = "--figures: there is none to draw" if options.figures else ""
        return no_margins(label, scenario.title, problem, options.json, none)
    margin = found.delay.seconds
    set_s = float(loop.u_delay[0])
    measured = None if run is None else loop_delay(run, set_s, margin)
    region = _draw(options.figures, loop, label, margin) if options.figures else None
    if options.json:
        content = {"law": label, "scenario": scenario.title, "stable": True}
        content |= margins_as_json(found, ranges, set_s, measured)
        if region is not None:
            rows = {name: getattr(region, name).tolist() for name in ("L_g", "R_g", "sigma")}
            content["region"] = finite(rows)
        print(json.dumps(content, indent=2))
    else:
        print_margins(console, label, scenario.title, found, ranges, set_s, measured)
        if options.figures:
            console.print(f"figures: {options.figures}", soft_wrap=True)
    return 0


def _draw(folder: Path, loop: ClosedLoop, label: str, margin: float) -> Region:
    folder.mkdir(parents=True, exist_ok=True)
    with watching("stable region") as watch:
        region = stable_region(loop, POINTS, lambda rows: watch.progress(rows, POINTS, ""))
    draw_region(folder / "region.png", loop, label, region)
    draw_delay(folder / "delay.png", loop, label, margin)
    return region
