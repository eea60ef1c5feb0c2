"""Whether a law holds in the box of real loops, point by point."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, fields, replace
from typing import Any, get_args

import numpy as np
from rich.progress import track
from rich.table import Table

from deployable.bench import STEP, step_run
from deployable.box import Box, Point, Source
from deployable.robust import Loops, Wanted, paper_problem
from gfm_design.margins.delays import longest, overall_delay
from gfm_design.model.closed_loop import T_S
from gfm_design.norms.hinf import Unstable
from gfm_design.tuning.gains import free_gains
from gfm_hil.api.design import channels_as_json, problem_name
from gfm_hil.cli.common import add_inner
from gfm_hil.cli.design.gains import chosen_law
from gfm_hil.core.errors import UserError
from gfm_hil.core.terminal import terminal
from gfm_runtime import build_law, discretise
from gfm_runtime.lawfile import LawFile

_SOURCES = get_args(Source)
#: the least and the largest that a plant of the box may be
_RANGE = {
    "R_f": (0.001, 100.0),
    "R_g": (0.001, 100.0),
    "L_g": (0.01, 100.0),
    "delay": (0.0, 5.99),
    "P_ref": (-1.5, 1.5),
}


def add(kinds: Any) -> None:
    command = kinds.add_parser("check", help="whether a law holds in the box of real loops")
    command.add_argument("--law", required=True, help="catalogue name or law file")
    add_inner(command)
    add_box(command)
    command.add_argument("--random", type=int, default=1000, help="points inside, of either source")
    command.add_argument("--seed", type=int, default=0, help="of those points")
    command.add_argument("--bench", action="store_true", help="step P_ref on the nonlinear bench")
    command.add_argument("--json", action="store_true", help="as JSON")
    command.set_defaults(call=call)


def add_box(command: argparse.ArgumentParser) -> None:
    """The option of the box."""
    command.add_argument(
        "--box",
        action="append",
        default=[],
        metavar="NAME=v,v,…",
        help="other extremes of R_f, R_g, L_g, delay (samples), P_ref, dc; may be repeated",
    )


def read_box(entries: Sequence[str]) -> Box:
    """The box with some of its extremes replaced.

    Raises:
        UserError: an unknown name, no value, or one that no plant of the box can have.
    """
    found: dict[str, Any] = {}
    for entry in entries:
        name, _, text = (part.strip() for part in entry.partition("="))
        values = [v.strip() for v in text.split(",") if v.strip()]
        known = [f.name for f in fields(Box)]
        if name not in known or not values:
            raise UserError(f"--box {entry!r}: must be NAME=v,v,… with a NAME of {known}")
        if name in found:
            raise UserError(f"--box: {name} is given twice")
        found[name] = tuple(_source(v) if name == "dc" else _number(name, v) for v in values)
    return replace(Box(), **found)


def _source(text: str) -> str:
    if text not in _SOURCES:
        raise UserError(f"--box dc={text}: must be of {list(_SOURCES)}")
    return text


def _number(name: str, text: str) -> float:
    low, high = _RANGE[name]
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not low <= value <= high:
        raise UserError(f"--box {name}={text}: must be a number from {low:g} to {high:g}")
    return value


def wanted(named: dict[str, float], box: Box) -> Wanted:
    """The demands, some replaced; those on the rig's source are relaxed only beside the other.

    Raises:
        UserError: an unknown name, a number that is not positive, a demand on a source that is
            not in the box.
    """
    known = [f.name for f in fields(Wanted)]
    for name, value in named.items():
        if name not in known or value <= 0.0:
            raise UserError(f"--want {name}={value:g}: must be positive, a name of {known}")
    both = len(set(box.dc)) > 1
    if not both and (odd := {"rig_alpha", "rig_weight"} & set(named)):
        raise UserError(f"--want {min(odd)}: only for a box with both DC sources")
    return replace(Wanted() if both else Wanted(rig_alpha=None), **named)


def call(options: argparse.Namespace) -> int:
    """Report gamma, the delay margin, and the worst point of each kind."""
    file, whole = chosen_law(options), read_box(options.box)
    law = discretise(build_law(file), T_S)
    rows: list[dict[str, Any]] = []
    for dc in dict.fromkeys(whole.dc):
        box = replace(whole, dc=(dc,))
        for where, points in (
            ("corners", box.corners()),
            ("random", box.random(options.random, options.seed)),
        ):
            sigma = _loops(file, points).sigma(_values(file))
            k = int(np.argmax(sigma))
            row = _row(dc, f"sigma, {where} [1/s]", len(points), sigma[k], points[k])
            worst = points[k].loop(law).modes()[0]
            rows.append(row | {"mode_hz": worst.frequency_hz})
        gamma = _gamma(file, dc)
        rows.append(_row(dc, "gamma with this source", 1, gamma["gamma"], Point(dc=dc)))
        nominal = Point(dc=dc)
        margin = overall_delay(nominal.loop(law)).seconds
        rows.append(_row(dc, "delay margin [s]", 1, margin, nominal))
        if options.bench:
            rows += _bench(options, box)
    result = {
        "law": file.name,
        "inner": file.inner.type if file.inner else None,
        **_gamma(file, "controlled"),
        "box": rows,
    }
    if options.json:
        print(json.dumps(result, indent=2))
    else:
        _print(result, problem_name(file))
    return 0


def margin_text(seconds: float) -> str:
    """A delay margin for a reader."""
    if np.isinf(seconds):
        return f"> {1e3 * longest(T_S):g} ms"
    return f"{1e3 * seconds:.2f} ms"


def _values(file: LawFile) -> Any:
    return np.array([g.start for g in free_gains(file)])


def _loops(file: LawFile, points: Sequence[Point]) -> Loops:
    return Loops(file, free_gains(file), points)


def _gamma(file: LawFile, dc: Source) -> dict[str, Any]:
    try:
        problem = paper_problem(file, free_gains(file), dc)
        return channels_as_json(problem.channels(_values(file)))
    except Unstable as problem:
        return {"gamma": None, "reason": str(problem)}


def _bench(options: argparse.Namespace, box: Box) -> list[dict[str, Any]]:
    """Worst overshoot of each L_g on the nonlinear bench, and how many runs ended early."""
    points = replace(box, P_ref=(STEP[0],)).corners()
    console = terminal(stderr=True, quiet=options.json)
    bar = track(points, "P_ref steps", console=console, transient=True)
    runs = [step_run(p, options.law, options.inner) for p in bar]
    rows = []
    for L_g in box.L_g:
        some = [r for r in runs if r.point.L_g == L_g]
        ended = [r for r in some if r.ended]
        name = f"bench overshoot, L_g x {L_g:g}"
        if ended:
            text = f"{name}: {len(ended)} tripped, e.g. {ended[0].ended}"
            rows.append(_row(box.dc[0], text, len(some), None, ended[0].point))
        else:
            worst = max(some, key=lambda r: r.overshoot)
            row = _row(box.dc[0], name, len(some), worst.overshoot, worst.point)
            rows.append(row | {"ripple": worst.ripple})
    return rows


def _row(dc: str, what: str, count: int, worst: float | None, at: Point) -> dict[str, Any]:
    number = None if worst is None or not np.isfinite(worst) else float(worst)
    return {"dc": dc, "what": what, "points": count, "worst": number, "at": asdict(at)}


def _print(result: dict[str, Any], problem: str) -> None:
    console = terminal(highlight=False)
    gamma = "none" if result["gamma"] is None else f"{result['gamma']:.4f}"
    console.print(f"[bold]{result['law']}[/]: γ = {gamma} of {problem}")
    table = Table("DC source", "what", "points", "worst", "at", box=None, pad_edge=False)
    for row in result["box"]:
        what = row["what"].replace("[", "\\[")
        worst = "–" if row["worst"] is None else f"{row['worst']:.4g}"
        if "mode_hz" in row:
            worst += f" ({row['mode_hz']:.3g} Hz)"
        if "ripple" in row:
            worst += f" (ripple {row['ripple']:.2g})"
        table.add_row(row["dc"], what, str(row["points"]), worst, _at(row["at"]))
    console.print(table)


def _at(values: dict[str, Any]) -> str:
    return str(Point(**values)).rsplit(",", 1)[0]
