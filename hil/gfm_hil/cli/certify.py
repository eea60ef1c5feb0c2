"""gfmhil certify: the class of grids in which any number of converters is stable."""

import argparse
from collections.abc import Iterator
from typing import Any

from rich.markup import escape

from gfm_hil.api.plot import certificate as draw
from gfm_hil.api.studies import certify
from gfm_hil.cli.common import add_inner, numbers, print_result, two_numbers, watching
from gfm_hil.cli.design.common import add_figure, save_figure
from gfm_hil.core.errors import UserError
from gfm_hil.results.table import Table
from gfm_hil.scenario import load_scenario
from gfm_hil.studies.certificate import CertifiedLaws, Strength, counter_run, strength_of

_RANGE = two_numbers("LOW:HIGH, e.g. 1.5:20")


def add(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "laws", nargs="+", metavar="LAW",
        help="catalogue names or law files: any number of converters with each of them",
    )  # fmt: skip
    command.add_argument(
        "--scr", metavar="LOW:HIGH", type=_RANGE, default=(1.5, 20.0),
        help="generalised short-circuit ratios of the class, at the filter capacitor "
        "(default: 1.5:20)",
    )  # fmt: skip
    command.add_argument("--x-over-r", metavar="LOW:HIGH", type=_RANGE, default=(3.0, 20.0),
                         help="of its lines (default: 3:20)")  # fmt: skip
    command.add_argument("--power", metavar="LIST", type=numbers, default=[0.0, 0.5, 1.0],
                         help="P_ref of the operating points, p.u. (default: 0,0.5,1)")  # fmt: skip
    command.add_argument("--loads", action="store_true",
                         help="resistors and R-L loads may be at any node")  # fmt: skip
    add_inner(command)
    command.add_argument(
        "--scenario", default="pref_step",
        help="plant, T_s and the other references; pref_step by default",
    )  # fmt: skip
    command.add_argument(
        "--network", action="append", default=[], metavar="SCENARIO",
        help="say whether this network belongs to the class; may be repeated",
    )  # fmt: skip
    add_figure(command)
    command.add_argument("--json", action="store_true", help="as JSON")
    command.add_argument("-q", "--quiet", action="store_true", help="no progress")


def call(options: argparse.Namespace) -> int:
    """Print what holds; exit code 1 with a counter-example, 4 if neither is known."""
    networks = {name: strength_of(load_scenario(name)) for name in options.network}
    scenario = load_scenario(options.scenario, inner=options.inner)
    with watching("certify", options.quiet) as watch:
        found = certify(
            options.laws, scenario, scr=options.scr, x_over_r=options.x_over_r,
            powers=options.power, loads=options.loads, watch=watch,
        )  # fmt: skip
    if options.figure:
        if found.certificate is None:
            raise UserError(f"--out: there is no certificate to draw; {found.unstable}")
        save_figure(options, lambda: draw(found))
    run = counter_run(scenario, found.unstable) if found.unstable else ""
    print_result(options, _plain(found, networks, run), _in_words(found, networks, run))
    return 0 if found.holds else 1 if found.unstable else 4


def _plain(found: CertifiedLaws, networks: dict[str, Strength], run: str) -> dict[str, Any]:
    grids = found.grids
    worst = None if found.certificate is None else float(found.certificate.margin.min())
    return {
        "laws": found.laws,
        "holds": found.holds,
        "weakest": grids.weakest,
        "stiffest": grids.stiffest,
        "x_over_r": grids.x_over_r,
        "loads": grids.loads,
        "powers": found.powers,
        "margin": worst,
        "void_hz": [] if found.certificate is None else found.certificate.void,
        "unstable": None if found.unstable is None else str(found.unstable),
        "its_run": run,
        "networks": {name: s.within(grids) for name, s in networks.items()},
    }


def _in_words(
    found: CertifiedLaws, networks: dict[str, Strength], run: str
) -> Iterator[str | Table]:
    grids = found.grids
    low, high = grids.x_over_r
    yield (
        f"[bold]{escape(', '.join(found.laws))}[/] · strength {grids.weakest:g} to "
        f"{grids.stiffest:g}, X/R {low:g} to {high:g}, "
        f"{'with' if grids.loads else 'without'} loads, P_ref "
        + ", ".join(f"{P:g}" for P in found.powers)
    )
    if found.unstable is not None:
        yield f"counter-example: {found.unstable}"
        if run:
            yield f"a run of it after a phase jump of 0.5 degrees ends as {run}"
    elif found.certificate is not None and found.holds:
        yield "[bold]certified: every network of this class is stable[/]"
    elif found.certificate is not None:
        bands = ", ".join(f"{a:.4g} to {b:.4g} Hz" for a, b in found.certificate.void)
        yield f"void at {bands}: such networks may be stable or not"
    if networks:
        rows = [
            [name, s.weakest, s.stiffest, f"{s.x_over_r[0]:.3g} to {s.x_over_r[1]:.3g}",
             "yes" if s.loads else "no", "yes" if s.within(grids) else "no"]
            for name, s in networks.items()
        ]  # fmt: skip
        heads = ["network", "weakest", "stiffest", "X/R", "loads", "in the class"]
        yield Table(heads, rows, text=1)
