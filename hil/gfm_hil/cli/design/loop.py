"""gfmhil design bode, nyquist, poles, step: a law's linear loop as a table and a figure."""

import argparse
from collections.abc import Callable
from typing import Any

import numpy as np

from gfm_design.margins.all_margins import UnstableLoop, loop_margins
from gfm_design.model.closed_loop import ClosedLoop
from gfm_design.model.network import NetworkLoop, NetworkMode
from gfm_hil.api.plot import bode, mode_shape, nyquist, pole_map, step, stepped_by_default
from gfm_hil.cli.common import print_result
from gfm_hil.cli.design import common
from gfm_hil.cli.design.margins import channel_as_json, loops_table, no_margins
from gfm_hil.core.errors import UserError
from gfm_hil.results.table import Table
from gfm_hil.studies.linear_loop import network_loop, scenario_loop
from gfm_runtime.signals import Y_NAMES

#: what a command found: as JSON, and as a table
Report = tuple[dict[str, Any], Table]

_LEAST = 0.01  # of a participation that the table shows


def add(kinds: Any) -> None:
    for name, text, find, draw in (
        ("bode", "gain and phase of L, one loop cut, and its margins", _margins, _draw_at(bode)),
        (
            "nyquist", "L in the complex plane, one loop cut, and its margins", _margins,
            _draw_at(nyquist),
        ),
        ("poles", "modes of the closed loop", _modes, _draw_modes),
        (
            "step", "y after a unit step of one input", _step,
            lambda loop, options: step(loop, options.of, options.seconds),
        ),
    ):  # fmt: skip
        command = kinds.add_parser(name, help=text, description=f"{text} (linear model)")
        common.add_loop_options(command)
        if find is _margins:
            command.add_argument(
                "--at", help="channels of u or y, separated by commas; all of u by default"
            )
        if find is _modes:
            command.add_argument(
                "--shape", type=int, metavar="MODE",
                help="of a network: the figure is its diagram, with who swings against whom in the"
                " mode of this number in the table",
            )  # fmt: skip
        if find is _step:
            command.add_argument(
                "--of", help="the input that steps; P_ref by default, in a network as A.P_ref"
            )
            command.add_argument("--seconds", type=_seconds, default=1.0, help="how long, s")
        common.add_figure(command)
        command.set_defaults(call=call, find=find, draw=draw)


def call(options: argparse.Namespace) -> int:
    """Print the table and draw the figure; exit code 3 where an unstable loop has no margins."""
    scenario = common.chosen_scenario(options.scenario, options)
    loop: ClosedLoop | NetworkLoop
    of_all = options.find is _modes or (options.find is _step and options.converter is None)
    if of_all and scenario.network is not None:
        loop = network_loop(scenario)
        label = ", ".join(member.title for member in loop.members)
    else:
        loop, label = scenario_loop(scenario, options.converter)
    if options.find is _modes and options.shape is not None:
        if scenario.network is None or not options.figure:
            raise UserError("--shape: takes a scenario with a network, and --out")
        options.scenario = scenario
    common.save_figure(options, lambda: options.draw(loop, options))
    try:
        content, table = options.find(loop, options)
    except UnstableLoop as problem:
        return no_margins(options, label, scenario.title, problem)
    content = {"law": label, "scenario": scenario.title} | content
    print_result(options, content, [common.heading(label, scenario, options), table])
    return 0


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not 0.0 < value <= 1e4:
        raise argparse.ArgumentTypeError(f"{text!r}: must be a number in (0, 10000]")
    return value


def _at(options: argparse.Namespace) -> list[str]:
    return [] if options.at is None else options.at.split(",")


def _draw_at(draw: Callable[..., object]) -> Callable[[ClosedLoop, argparse.Namespace], object]:
    return lambda loop, options: draw(loop, *_at(options))


def _draw_modes(loop: ClosedLoop | NetworkLoop, options: argparse.Namespace) -> object:
    if isinstance(loop, NetworkLoop) and options.shape is not None:
        return mode_shape(loop, options.scenario, options.shape)
    return pole_map(loop)


def _margins(loop: ClosedLoop, options: argparse.Namespace) -> Report:
    found = loop_margins(loop)
    channels = {c.name: c for c in (*found.u, *found.y)}
    wanted = _at(options) or [c.name for c in found.u]
    if unknown := [name for name in wanted if name not in channels]:
        raise UserError(f"--at {unknown[0]}: the loop has {list(channels)}")
    some = [channels[name] for name in wanted]
    return {"stable": True, "at": {c.name: channel_as_json(c) for c in some}}, loops_table(some)


def _modes(loop: ClosedLoop | NetworkLoop, options: argparse.Namespace) -> Report:
    modes = loop.modes()
    heads = ["σ [1/s]", "frequency [Hz]", "damping ratio"]
    heads = ["mode", *heads, "taking part"] if isinstance(loop, NetworkLoop) else heads
    rows = []
    for k, mode in enumerate(modes, 1):
        cells = [f"{mode.sigma:.4g}", f"{mode.frequency_hz:.4g}", f"{mode.ratio:.3g}"]
        if isinstance(mode, NetworkMode):
            shares = [f"{part} {100 * x:.0f} %" for part, x in mode.participation.items()
                      if x >= _LEAST]  # fmt: skip
            cells = [str(k), *cells, ", ".join(shares)]
        rows.append(cells)
    content = {"stable": modes[0].sigma < 0.0, "modes": [mode.plain() for mode in modes]}
    return content, Table(heads, rows)


def _step(loop: ClosedLoop | NetworkLoop, options: argparse.Namespace) -> Report:
    of = options.of or stepped_by_default(loop)
    try:
        t, found = loop.step_response(of, options.seconds)
    except ValueError as problem:
        raise UserError(f"--of: {problem}") from None
    rows: list[list[Any]] = []
    each = found if isinstance(found, dict) else {"": found}
    content: dict[str, Any] = {}
    for converter, y in each.items():
        own: dict[str, Any] = {}
        for name, column in zip(Y_NAMES, y.T, strict=True):
            k = int(np.argmax(np.abs(column)))
            row = {"peak": float(column[k]), "peak_s": float(t[k]), "end": float(column[-1])}
            own[name] = row
            label = f"{converter}.{name}" if converter else name
            rows.append([label, *row.values()])
        content |= {converter: own} if converter else own
    heads = f"after {of}", "peak [p.u.]", "at [s]", "at the end [p.u.]"
    return {"of": of, "seconds": options.seconds, "y": content}, Table(heads, rows)
