"""gfmhil design sweep and map: a law's loop over one of its parameters, and over grids."""

import argparse
from typing import Any

import numpy as np

from gfm_hil.api.law import Law, as_law
from gfm_hil.api.plot import root_locus, stability_map
from gfm_hil.api.sweeps import POINTS, GainSweep, StabilityMap, sweep
from gfm_hil.api.sweeps import stability_map as map_stability
from gfm_hil.cli.common import print_result, two_numbers, watching
from gfm_hil.cli.design import common
from gfm_hil.core.errors import UserError
from gfm_hil.results.table import Table
from gfm_hil.scenario import Scenario

_ROWS = 9  # of the table
_RANGE = two_numbers("LOW:HIGH, e.g. 1:20")


def add(kinds: Any) -> None:
    of_sweep = "poles over a parameter of the law, and where the loop is stable"
    of_map = "where the loop is stable over a parameter and the short-circuit ratio"
    for name, text, call, points in (
        ("sweep", of_sweep, _sweep, POINTS),
        ("map", of_map, _map, 31),
    ):
        command = kinds.add_parser(name, help=text, description=f"{text} (linear model)")
        command.add_argument(
            "gain", metavar="PARAMETER", help="of the law, as laws show lists them"
        )
        command.add_argument(
            "--range", metavar="LOW:HIGH", type=_RANGE, default=(None, None),
            help="of the parameter; default: the law file's bounds, or a decade to both sides",
        )  # fmt: skip
        if call is _map:
            command.add_argument(
                "--scr", metavar="LOW:HIGH", type=_RANGE, default=(1.0, 20.0),
                help="short-circuit ratios (default: 1:20)",
            )  # fmt: skip
        command.add_argument("--points", type=int, default=points, help="values (%(default)s)")
        common.add_loop_options(command)
        common.add_figure(command)
        command.set_defaults(call=call)


def _chosen(options: argparse.Namespace) -> tuple[Scenario, Law]:
    scenario = common.chosen_scenario(options.scenario, options)
    if scenario.network is not None and options.converter is None:
        raise UserError(f"--converter: must name one of {scenario.converters}")
    one = scenario.each[options.converter] if options.converter else scenario
    return scenario, as_law(one.law)


def _sweep(options: argparse.Namespace) -> int:
    scenario, law = _chosen(options)
    with watching("sweep") as watch:
        found = sweep(
            law, options.gain, *options.range, points=options.points, on=scenario,
            converter=options.converter, watch=watch,
        )  # fmt: skip
    common.save_figure(options, lambda: root_locus(found))
    content = _about(found, scenario) | {
        "stable": found.stable(),
        "values": found.values.tolist(),
        "slowest": [mode and mode.plain() for mode in found.slowest()],
    }
    ranges = " and ".join(f"{low:.6g} to {high:.6g}" for low, high in found.stable())
    said: list[str | Table] = [
        common.heading(found.law, scenario, options),
        _sweep_table(found),
        f"stable for {found.gain} of {ranges or 'no value here'}; the law has {found.own:g}",
    ]
    print_result(options, content, said)
    return 0


def _about(found: GainSweep | StabilityMap, scenario: Scenario) -> dict[str, Any]:
    """What the JSON of both commands begins with."""
    about = {"law": found.law, "scenario": scenario.title, "parameter": found.gain}
    return {**about, "own": found.own}


def _some(count: int) -> list[int]:
    """The places of the rows that a table shows of so many values."""
    return sorted({*np.linspace(0, count - 1, _ROWS).round().astype(int).tolist()})


def _sweep_table(found: GainSweep) -> Table:
    modes = found.slowest()
    rows = []
    for k in _some(len(found.values)):
        mode = modes[k]
        cells = ["no operating point", "", ""] if mode is None else [
            mode.sigma, mode.frequency_hz, mode.ratio
        ]  # fmt: skip
        rows.append([float(found.values[k]), *cells])
    heads = [found.gain, "σ of the slowest mode [1/s]", "frequency [Hz]", "damping ratio"]
    return Table(heads, rows, text=0)


def _map(options: argparse.Namespace) -> int:
    scenario, law = _chosen(options)
    with watching("map") as watch:
        found = map_stability(
            law, options.gain, *options.range, scr=options.scr, points=options.points, on=scenario,
            watch=watch,
        )  # fmt: skip
    common.save_figure(options, lambda: stability_map(found))
    rows = {name: getattr(found, name).tolist() for name in ("values", "scr", "sigma")}
    said: list[str | Table] = [
        common.heading(found.law, scenario, options),
        _map_table(found),
        f"{min(_ROWS, len(found.scr))} of {len(found.scr)} grids, for each of which "
        f"{len(found.values)} values were tried",
    ]
    if own := common.grid_of(scenario):
        low, high = (float(found.scr[k]) for k in (0, -1))
        inside = "contains" if low <= own[0] <= high else "does not contain"
        said.append(
            f"all have X/R {own[1]:.3g}; SCR {low:g} to {high:g} {inside} the scenario's "
            f"{own[0]:.3g}"
        )
    print_result(options, _about(found, scenario) | rows, said)
    return 0


def _map_table(found: StabilityMap) -> Table:
    """Of some grids, between which values of the parameter the loop is stable."""
    rows = []
    for i in _some(len(found.scr)):
        stable = found.values[found.sigma[i] < 0.0]
        share = f"{100 * len(stable) / len(found.values):.0f} %"
        ends = [float(stable.min()), float(stable.max())] if len(stable) else [None, None]
        rows.append([float(found.scr[i]), *ends, share])
    heads = ["short-circuit ratio", f"lowest stable {found.gain} tried", "highest", "stable values"]
    return Table(heads, rows, text=0)
