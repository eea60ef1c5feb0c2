"""gfmhil design latency: how late, and how often missing, a law's u may be."""

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gfm_design.margins.all_margins import UnstableLoop
from gfm_design.misses.tolerance import LatencyTolerance
from gfm_hil.api.design import latency_tolerance
from gfm_hil.api.latency import measured_misses
from gfm_hil.api.law import laws
from gfm_hil.cli.common import EXIT_OTHERWISE, add_inner, print_result, watching
from gfm_hil.cli.design.common import add_converter_option
from gfm_hil.core.errors import UserError
from gfm_hil.results.table import Table
from gfm_hil.scenario import load_scenario
from gfm_hil.studies.latency import as_json, tolerance_table, used_table
from gfm_hil.studies.linear_loop import converter_of_loop

_ALL = "all"
_PARTS = 4  # of the bar, a law


def add(kinds: Any) -> None:
    command = kinds.add_parser(
        "latency", help="how many ticks a law bears without a new u, and what a run used of that"
    )
    command.add_argument(
        "--law", nargs="+", metavar="LAW",
        help=f"catalogue names or law files, or {_ALL}; the scenario's by default",
    )  # fmt: skip
    add_inner(command)
    add_converter_option(command)
    command.add_argument(
        "--scenario",
        help="scenario file or shipped name: plant, references, T_s, late policy; by default that "
        "of the first run of --from, else pref_step",
    )
    command.add_argument(
        "--from", nargs="+", type=Path, default=[], metavar="RUN|RESULT", dest="measured",
        help="run folders in real time, or results of gfmhil bench loop: which share they used",
    )  # fmt: skip
    command.add_argument("--json", action="store_true", help="as JSON")
    command.set_defaults(call=call)


def call(options: argparse.Namespace) -> int:
    """Print the tolerances; exit code 3 if no law has a stable loop, or a verdict is red."""
    each = [one for path in options.measured for one in measured_misses(path)]
    named = options.scenario
    if named is None:
        runs = (path for path in options.measured if (path / "scenario.toml").exists())
        named = str(next((path / "scenario.toml" for path in runs), "pref_step"))
    words = {"inner": "--inner", "converter": "--converter"}
    scenario = load_scenario(named, words, converter=options.converter, inner=options.inner)
    for one in each:
        if abs(one.T_s - scenario.T_s) > 1e-12:
            raise UserError(
                f"--from {one.name}: has T_s = {one.T_s:g} s, and the scenario {scenario.T_s:g} s"
            )
    converter = converter_of_loop(scenario, options.converter)
    chosen = options.law or [scenario.each[converter].law if converter else scenario.law]
    names = [*laws()] if chosen == [_ALL] else chosen
    found: dict[str, LatencyTolerance | UnstableLoop] = {}
    with watching("latency tolerance") as watch:
        for k, name in enumerate(names):

            def tell(share: float, k: int = k, name: str = name) -> None:
                watch.progress(round(_PARTS * (k + share)), _PARTS * len(names), name)

            tell(0.0)
            try:
                found[name] = latency_tolerance(name, scenario, converter=converter, progress=tell)
            except UnstableLoop as unstable:
                found[name] = unstable
    stable = {name: of for name, of in found.items() if isinstance(of, LatencyTolerance)}
    used = [{name: of.used(one.misses) for name, of in stable.items()} for one in each]
    both = [*zip(each, used, strict=True)]
    content: dict[str, Any] = {
        "scenario": scenario.title,
        "laws": {name: as_json(of) for name, of in found.items()},
        "measured": [
            {
                "name": one.name,
                "ticks": one.misses.ticks,
                "misses": one.misses.misses,
                "in_a_row": one.misses.longest,
                "used": {n: {**asdict(u), "verdict": u.light} for n, u in of.items()},
            }
            for one, of in both
        ],
    }
    tables = (used_table(one.name, one.misses, of) for one, of in both)
    said: list[str | Table] = [f"[bold]{scenario.title}[/]", tolerance_table(found), *tables]
    print_result(options, content, said)
    red = any(u.light == "red" for of in used for u in of.values())
    return EXIT_OTHERWISE if red or not stable else 0
