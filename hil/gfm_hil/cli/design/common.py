"""What the design commands share: the options that choose a loop, and the figure."""

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.markup import escape

from gfm_hil.cli.common import OPTIONS, add_inner, add_settings, settings
from gfm_hil.core.errors import UserError
from gfm_hil.scenario import Scenario, load_scenario
from gfm_plant import make_plant


def add_converter_option(command: argparse.ArgumentParser) -> None:
    """The converter of a network."""
    command.add_argument(
        "--converter", metavar="NAME",
        help="of a scenario with a network: the converter whose loop it is, and that gets --law and"
        " --inner",
    )  # fmt: skip


def add_loop_options(
    command: argparse.ArgumentParser, scenario: str = "pref_step", networks: bool = True
) -> Any:
    """Law, inner stage, scenario and, if there may be a network, converter of a loop, and JSON;
    returns the group in which something else may stand in place of the scenario."""
    command.add_argument("--law", help="catalogue name or law file; the scenario's by default")
    add_inner(command)
    where = command.add_mutually_exclusive_group()
    where.add_argument(
        "--scenario", default=scenario,
        help="scenario file or shipped name: plant, references, T_s; %(default)s by default",
    )  # fmt: skip
    if networks:
        add_converter_option(command)
    else:
        command.set_defaults(converter=None)
    add_settings(command)
    command.add_argument("--json", action="store_true", help="as JSON")
    return where


def heading(law: str, scenario: Scenario, options: argparse.Namespace) -> str:
    """What a table is of: law, scenario, operating point and grid, and what --set changed; of a
    network the P_ref of the one converter that --converter names, if it does."""
    told, one = [f"[bold]{law}[/]", escape(scenario.title)], scenario.each.get(options.converter)
    if scenario.network is None or one is not None:
        told.append(f"P_ref {(one or scenario).references.P_ref:g} p.u.")
    if scenario.network is None and (grid := grid_of(scenario)) is not None:
        told[-1] += f", SCR {grid[0]:.3g}, X/R {grid[1]:.3g}"
    told += [escape(f"--set {name}={value}") for name, value in options.settings]
    return " · ".join(told)


def grid_of(scenario: Scenario) -> tuple[float, float] | None:
    """Short-circuit ratio and X/R of the grid of one converter; None of one without resistance."""
    line = make_plant(scenario.plant, scenario.T_s).par[0]
    L, R = float(line["L_g"]), float(line["R_g"])
    return (1.0 / math.hypot(L, R), L / R) if R > 0.0 else None


def add_figure(command: argparse.ArgumentParser) -> None:
    """The option that names the file of a figure."""
    command.add_argument(
        "-o", "--out", dest="figure", type=_figure_file, metavar="FILE",
        help="figure: .png, .svg or .pdf",
    )  # fmt: skip


_KINDS = (".png", ".svg", ".pdf")


def _figure_file(text: str) -> Path:
    """A file that a figure can be saved to, which a command should know before it computes."""
    file = Path(text)
    if file.suffix not in _KINDS:
        raise argparse.ArgumentTypeError(f"{text}: must end in one of {', '.join(_KINDS)}")
    if not file.parent.is_dir():
        raise argparse.ArgumentTypeError(f"{text}: there is no folder {file.parent}")
    return file


def save_figure(options: argparse.Namespace, draw: Callable[[], object]) -> None:
    """Save what ``draw`` draws in a figure of pyplot, if --out names a file. Raises UserError: it
    cannot be saved."""
    if options.figure is None:
        return
    import matplotlib
    from matplotlib import pyplot

    matplotlib.use("Agg")
    draw()
    try:
        pyplot.savefig(options.figure, dpi=110)
    except (OSError, ValueError) as problem:
        raise UserError(f"--out {options.figure}: {problem}") from None
    finally:
        pyplot.close()


def chosen_scenario(given: str, options: argparse.Namespace) -> Scenario:
    """A scenario with the law and the inner stage of --law and --inner, in a network those of
    --converter, and what --set changes. Raises UserError: as ``load_scenario``; --converter does
    not name a converter of the network."""
    changed, names = settings(options)
    names = {**OPTIONS, "converter": "--converter", **names}
    own = {"law": options.law, "inner": options.inner}
    return load_scenario(given, names, converter=options.converter, **own | changed)
