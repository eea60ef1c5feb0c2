"""gfmhil design box: whether a law holds in the box of real loops, point by point."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from gfm_design.box import T_S, Box, Point
from gfm_design.delays import overall_delay
from gfm_design.gains import free_gains
from gfm_design.hinf import Unstable
from gfm_design.linear import linearise_law, linearise_plant
from gfm_design.operating_point import operating_point
from gfm_design.paper_problem import PaperProblem
from gfm_design.robust import Loops
from gfm_design.sampled import SampledLoop
from gfm_hil.box_bench import step_run
from gfm_hil.cli.design.common import channels_as_json
from gfm_plant import make_plant
from gfm_runtime import discretise, law_file, load_law
from gfm_runtime.lawfile import LawFile

_NOMINAL = Point()


def add(kinds: Any) -> None:
    """Add the command to the parser."""
    command = kinds.add_parser("box", help="whether a law holds in the box of real loops")
    command.add_argument("--law", required=True, help="catalogue name or law file")
    command.add_argument("--random", type=int, default=1000, help="points inside, of either source")
    command.add_argument("--seed", type=int, default=0, help="of those points")
    command.add_argument("--bench", action="store_true", help="step P_ref on the nonlinear bench")
    command.add_argument("--json", action="store_true", help="as JSON")
    command.set_defaults(call=call)


def call(options: argparse.Namespace) -> int:
    """Report gamma, the delay margin, and the worst point of each kind."""
    file = law_file(options.law)
    rows: list[dict[str, Any]] = []
    for dc in Box().dc:
        box = Box(dc=(dc,))
        for where, points in (
            ("corners", box.corners()),
            ("random", box.random(options.random, options.seed)),
        ):
            sigma = _loops(file, points).sigma(_values(file))
            k = int(np.argmax(sigma))
            rows.append(_row(dc, f"sigma, {where} [1/s]", len(points), sigma[k], points[k]))
        if options.bench:
            rows += _bench(options.law, box, options.json)
    result = {
        "law": file.name,
        **_gamma(file),
        "delay_margin_s": delay_margin(options.law),
        "box": rows,
    }
    if options.json:
        print(json.dumps(result, indent=2))
    else:
        _print(result)
    return 0


def delay_margin(law: str) -> float:
    """What may be added to the nominal loop's one sample of delay, s; 0 if it does not hold."""
    par, _ = make_plant(_NOMINAL.plant(), T_S)
    discrete = discretise(load_law(law).laws[0], T_S)
    op = operating_point(par, discrete, _NOMINAL.references())
    linear = linearise_law(discrete.law, discrete, op, _NOMINAL.references(), True)
    loop = SampledLoop(linearise_plant(par, op), linear, T_S, _NOMINAL.delay * T_S)
    if np.abs(np.linalg.eigvals(loop.closed())).max() >= 1.0:
        return 0.0
    return overall_delay(loop).seconds


def _values(file: LawFile) -> Any:
    return np.array([g.start for g in free_gains(file)])


def _loops(file: LawFile, points: Sequence[Point]) -> Loops:
    return Loops(file, free_gains(file), points)


def _gamma(file: LawFile) -> dict[str, Any]:
    try:
        return channels_as_json(PaperProblem(file, free_gains(file)).channels(_values(file)))
    except Unstable as problem:
        return {"gamma": None, "reason": str(problem)}


def _bench(law: str, box: Box, quiet: bool) -> list[dict[str, Any]]:
    """Worst overshoot of each L_g on the nonlinear bench, and how many runs ended early."""
    points = [p for p in box.corners() if p.P_ref == 0.5]
    console = Console(stderr=True, quiet=quiet)
    runs = [step_run(p, law) for p in track(points, "P_ref steps", console=console, transient=True)]
    rows = []
    for L_g in box.L_g:
        some = [r for r in runs if r.point.L_g == L_g]
        ended = [r for r in some if r.ended]
        name = f"bench overshoot, L_g x {L_g:g}"
        if ended:
            text = f"{name}: {len(ended)} tripped, e.g. {ended[0].ended}"
            rows.append(_row(box.dc[0], text, len(some), np.nan, ended[0].point))
        else:
            worst = max(some, key=lambda r: r.overshoot)
            rows.append(_row(box.dc[0], name, len(some), worst.overshoot, worst.point))
    return rows


def _row(dc: str, what: str, count: int, worst: float, at: Point) -> dict[str, Any]:
    return {"dc": dc, "what": what, "points": count, "worst": float(worst), "at": asdict(at)}


def _print(result: dict[str, Any]) -> None:
    console = Console(highlight=False)
    gamma = "none" if result["gamma"] is None else f"{result['gamma']:.4f}"
    margin = 1e3 * result["delay_margin_s"]
    console.print(f"[bold]{result['law']}[/]: γ = {gamma}, delay margin {margin:.2f} ms")
    table = Table("DC source", "what", "points", "worst", "at", box=None, pad_edge=False)
    for row in result["box"]:
        what = row["what"].replace("[", "\\[")
        table.add_row(row["dc"], what, str(row["points"]), f"{row['worst']:.4g}", _at(row["at"]))
    console.print(table)


def _at(values: dict[str, Any]) -> str:
    return str(Point(**values)).rsplit(",", 1)[0]
