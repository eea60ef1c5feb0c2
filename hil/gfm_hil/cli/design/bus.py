"""gfmhil design bus: the impedance of a network at a bus, over the frequency."""

import argparse
from typing import Any

import numpy as np
from rich.markup import escape

from gfm_hil.api.plot import bus_scan as draw
from gfm_hil.cli.common import print_result
from gfm_hil.cli.design.common import add_figure, save_figure
from gfm_hil.core.errors import UserError
from gfm_hil.results.table import Table
from gfm_hil.scenario import load_scenario
from gfm_hil.studies.bus_scan import HIGH, LOW, POINTS, bus_scan


def add(kinds: Any) -> None:
    text = "impedance of a network at a bus over the frequency, and its resonances"
    command = kinds.add_parser("bus", help=text, description=f"{text} (linear model)")
    command.add_argument("scenario", help="scenario with a network, file or shipped name")
    command.add_argument("bus", help="name of a node")
    for name, place, default, what in (
        ("--from", "low", LOW, "lowest frequency"), ("--to", "high", HIGH, "highest one"),
    ):  # fmt: skip
        command.add_argument(name, dest=place, type=float, default=default, metavar="HZ",
                             help=f"{what} (default: %(default)s)")  # fmt: skip
    command.add_argument(
        "--points", type=int, default=POINTS,
        help="frequencies, evenly by their logarithm, besides those near resonances"
        " (default: %(default)s)",
    )  # fmt: skip
    command.add_argument("--json", action="store_true", help="as JSON")
    add_figure(command)
    command.set_defaults(call=call)


def call(options: argparse.Namespace) -> int:
    if not 0.0 < options.low < options.high <= 1e5 or not 2 <= options.points <= 100_000:
        raise UserError("--from, --to, --points: must be 0 < from < to <= 1e5 Hz, 2 to 100000")
    scenario = load_scenario(options.scenario, in_process=True)
    hz = np.geomspace(options.low, options.high, options.points)
    scan = bus_scan(scenario, options.bus, hz, refine=True)
    save_figure(options, lambda: draw(scan))
    resonances = scan.resonances()
    content = {
        "scenario": scan.title, "bus": scan.bus, "resonances": resonances, "hz": scan.hz.tolist(),
        "Z": [[z.real, z.imag] for z in scan.Z.tolist()],
    }  # fmt: skip
    rows = [[f"{one['hz']:.4g}", one["kind"], f"{one['size']:.4g}", f"{one['degrees']:.3g}"]
            for one in resonances]  # fmt: skip
    table = Table(("resonance [Hz]", "kind", "|Z| [p.u.]", "∠Z [°]"), rows)
    title = f"[bold]{escape(scan.bus)}[/] · {escape(scan.title)}"
    print_result(options, content, [title, table if rows else "no resonance there"])
    return 0
