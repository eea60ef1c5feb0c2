"""gfmhil scan: the dq admittance of a converter with its controller, measured on the bench."""

import argparse
import json
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.markup import escape

from gfm_hil.api.studies import scan
from gfm_hil.cli.common import add_inner, add_study_options, new_folder, print_result, watching
from gfm_hil.core.errors import UserError
from gfm_hil.core.files import check_empty
from gfm_hil.results.table import Table, shown
from gfm_hil.scenario import find_scenario, shipped_scenarios
from gfm_hil.studies.scan import AMPLITUDE, POINTS, SWITCHED_AMPLITUDE, WINDOW_S, FrequencyScan
from gfm_runtime import grid_names, law_names, tuned_names
from gfm_runtime.errors import meant
from gfm_runtime.toml_file import read_toml

_ROWS = 12  # of the table


def add(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "what", metavar="LAW|SCENARIO",
        help="a law (name or file), or a scenario (name or file) with its own law",
    )  # fmt: skip
    command.add_argument(
        "--scenario", metavar="NAME",
        help="scenario on whose plant a law is measured; pref_step by default",
    )  # fmt: skip
    add_inner(command)
    command.add_argument("--from", type=float, default=1.0, metavar="HZ", dest="start",
                         help="lowest frequency in the dq frame; 1 by default")  # fmt: skip
    command.add_argument("--to", type=float, default=1000.0, metavar="HZ", dest="stop",
                         help="highest frequency; 1000 by default")  # fmt: skip
    command.add_argument("--points", type=int, default=POINTS, metavar="N",
                         help=f"frequencies, {POINTS} by default")  # fmt: skip
    command.add_argument("--amplitude", type=float, metavar="A",
                         help=f"of each tone, p.u. and rad; {AMPLITUDE:g} by default, "
                         f"{SWITCHED_AMPLITUDE:g} of a switched bridge")  # fmt: skip
    command.add_argument("--settle", type=float, metavar="S",
                         help="time before each window, s; chosen by default")  # fmt: skip
    command.add_argument("--window", type=float, default=WINDOW_S, metavar="S",
                         help="least length of a window, s; a longer one averages noise out; "
                         f"{WINDOW_S:g} by default")  # fmt: skip
    command.add_argument(
        "--grid", action="append", default=[], type=_grid, metavar="SCR:XR",
        help="judge stability on a grid of this SCR and X/R from the measured Y; may be repeated",
    )  # fmt: skip
    command.add_argument(
        "--controller", metavar="COMMAND",
        help="measure another controller: a program with its arguments, {endpoint} and {scenario}",
    )  # fmt: skip
    add_study_options(command, "identification.json", "scan-<name>")


def call(options: argparse.Namespace) -> int:
    law, scenario = _which(options.what, options.scenario)
    folder = new_folder(options.out, f"scan-{Path(options.what).stem}")
    check_empty(folder)
    with watching("scan", options.quiet) as watch:
        found = scan(
            law, scenario, inner=options.inner, start_hz=options.start, stop_hz=options.stop,
            points=options.points, amplitude=options.amplitude, settle_s=options.settle,
            window_s=options.window,
            controller_command=shlex.split(options.controller or ""), watch=watch,
        )  # fmt: skip
    found.save(folder, options.grid)
    content = json.loads((folder / "identification.json").read_text(encoding="utf-8"))
    print_result(options, content, _in_words(found, content, folder))
    return 0


def _grid(text: str) -> tuple[float, float]:
    """SCR:XR."""
    try:
        scr, x_over_r = map(float, text.split(":"))
    except ValueError:
        scr = x_over_r = 0.0
    if not (0.0 < scr < 1e6 and 0.0 < x_over_r < 1e6):
        raise argparse.ArgumentTypeError(f"{text!r}: must be SCR:XR, two numbers > 0, e.g. 2:10")
    return scr, x_over_r


def _which(what: str, scenario: str | None) -> tuple[str | None, str]:
    """The law and the scenario that the command line means. Raises UserError: neither exists, or a
    scenario is given twice."""
    is_law = what in law_names()
    if not is_law and what.endswith(".toml") and Path(what).is_file():
        try:
            is_law = "phi" in read_toml(what)
        except ValueError as problem:
            raise UserError(f"{what}: {problem}") from None
    if is_law:
        return what, scenario or "pref_step"
    if scenario is not None:
        raise UserError(f"--scenario {scenario}: goes with a law, but {what!r} is none")
    try:
        find_scenario(what)
    except UserError:
        if what.endswith(".toml"):
            raise UserError(f"{what}: there is no such file") from None
        close = meant(what, [*law_names(), *tuned_names(), *grid_names(), *shipped_scenarios()])
        raise UserError(
            f"{what!r}: is neither a law (gfmhil laws) nor a scenario (gfmhil scenarios){close}"
        ) from None
    return None, what


def _in_words(found: FrequencyScan, content: dict[str, Any], folder: Path) -> Iterator[str | Table]:
    yield f"[bold]{escape(found.name)}[/] · {escape(found.scenario.title)}"
    dev = found.deviation
    heads = ["f [Hz]", "|Y_dd|", "|Y_qq|", "λ_min(Y+Yᴴ)", "|Δp/Δω_g|"]
    heads += [] if dev is None else ["off the model [%]"]
    rows = [
        [
            f"{x:.4g}"
            for x in (
                found.frequency[k], abs(found.Y[k, 0, 0]), abs(found.Y[k, 1, 1]),
                found.passivity[k], abs(found.nfp[k]), *([] if dev is None else [100.0 * dev[k]]),
            )
        ]
        for k in range(0, len(found.frequency), max(1, len(found.frequency) // _ROWS))
    ]  # fmt: skip
    yield Table(heads, rows)
    if dev is not None:
        yield (
            f"largest deviation from the linear model: {100 * dev.max():.2g} % at "
            f"{content['at_hz']:.4g} Hz"
        )
    bands = ", ".join(f"{a:.4g} to {b:.4g} Hz" for a, b in content["not_passive_hz"])
    yield f"not passive: {bands}" if bands else "passive at every frequency"
    for grid in content["grids"]:
        verdict = {True: "stable", False: "unstable", None: "cannot be judged"}[grid["stable"]]
        why = f": {grid['reason']}" if grid["reason"] else ""
        if grid["stable"] is False:
            why = f": {grid['unstable_poles']} unstable poles"
        yield (
            f"SCR {grid['scr']:g}, X/R {grid['x_over_r']:g}: {verdict}{why}, margin "
            f"{shown(grid['margin'])} at {grid['margin_at_hz']:.4g} Hz"
        )
    yield escape(f"folder: {folder}")
