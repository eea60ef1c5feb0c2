"""gfmhil run: one scenario, one run folder."""

from __future__ import annotations

import argparse
import contextlib
import json
import subprocess
import sys
from pathlib import Path

from gfm_hil.api.runs import run as run_one
from gfm_hil.api.runs import run_network
from gfm_hil.cli.common import (
    add_map,
    add_scenario_options,
    exit_code,
    new_folder,
    print_run,
    progress_bar,
    resolve,
    window,
)
from gfm_hil.cli.companion import companion
from gfm_hil.cli.modbus import PORT as MODBUS_PORT
from gfm_hil.cli.scope import need_websockets
from gfm_hil.cli.stream import PORT
from gfm_hil.controllers import PIL
from gfm_hil.core.errors import UserError
from gfm_hil.recording.run import Run
from gfm_hil.run.network_run import NetworkRun
from gfm_hil.scenario import INPROC, Scenario, find_scenario


def add(command: argparse.ArgumentParser) -> None:
    add_scenario_options(command)
    command.add_argument(
        "--law",
        help="override law: catalogue name or law file; of a network see --converter",
    )
    command.add_argument(
        "--converter", metavar="NAME",
        help="of a network: the one that gets --law and --inner; all get them by default, if none"
        " has its own",
    )  # fmt: skip
    command.add_argument(
        "--controller", metavar="KIND:NAME",
        help="dll:FILE (IEEE/CIGRE), fmu:FILE or c:FILE: the controller, in place of a law of ours;"
        " or pil:TARGET, the law on a processor in QEMU, see gfmhil firmware check",
    )  # fmt: skip
    add_map(command, "--controller")
    command.add_argument("-o", "--out", help="run folder; runs/<scenario>-<time> by default")
    command.add_argument("--json", action="store_true", help="print summary.json and nothing else")
    command.add_argument("--quiet", action="store_true", help="no progress on stderr")
    command.add_argument("--no-figures", action="store_true", help="neither figures nor report")
    command.add_argument(
        "--waveforms", type=window, metavar="FROM:TO",
        help="override waveforms: the window of the figure of the three phases, s",
    )  # fmt: skip
    command.add_argument(
        "--scope", nargs="?", type=int, const=-1, metavar="PORT",
        help="serve a scope of it to the browser; it stays when the run is over, until Ctrl-C",
    )  # fmt: skip
    command.add_argument(
        "--stream", nargs="?", type=int, const=PORT, metavar="PORT",
        help="stream it while it goes on, as gfmhil stream does",
    )  # fmt: skip
    command.add_argument(
        "--modbus", nargs="?", type=int, const=MODBUS_PORT, metavar="PORT",
        help="serve it as a SunSpec device while it goes on, as gfmhil modbus does",
    )  # fmt: skip


def call(options: argparse.Namespace) -> int:
    if options.controller is not None and options.controller.startswith(PIL) and not options.mode:
        options.mode = "lockstep"  # QEMU keeps no time
    scenario = resolve(options, law=options.law, waveforms=options.waveforms)
    folder = new_folder(options.out, find_scenario(options.scenario).stem)
    figures = not options.no_figures
    with contextlib.ExitStack() as stack:
        run: Run | NetworkRun
        if scenario.network is not None:
            _check_network(options)
            with progress_bar(scenario, scenario.title, options.quiet) as (progress, notice):
                run = run_network(
                    scenario, folder, figures=figures, progress=progress, notice=notice
                )
            scope = None
        else:
            scope = _companions(stack, scenario, folder, options)
            with progress_bar(scenario, scenario.title, options.quiet) as (progress, notice):
                run = run_one(
                    scenario, folder=folder, controller=options.controller, ports=options.map,
                    figures=figures, progress=progress, notice=notice,
                )  # fmt: skip
        if options.json:
            print(json.dumps(run.summary, indent=2), flush=True)
        else:
            print_run(run, folder, why=True)
        if scope is not None and scope.poll() is None and run.status != "interrupted":
            print("the scope stays open until Ctrl-C", file=sys.stderr, flush=True)
            with contextlib.suppress(KeyboardInterrupt):
                scope.wait()
    return exit_code(run)


def _companions(
    stack: contextlib.ExitStack, scenario: Scenario, folder: Path, options: argparse.Namespace
) -> subprocess.Popen[str] | None:
    """Start what serves the run while it goes on; returns the scope, if it is asked for."""
    scope = None
    if options.scope is not None:
        need_websockets()
        port = None if options.scope < 0 else options.scope
        scope = stack.enter_context(companion("scope", folder, port, ends_itself=False))
    if options.stream is not None:
        stack.enter_context(companion("stream", folder, options.stream, ready=2))
    if options.modbus is not None:
        if scenario.link.type == INPROC:
            raise UserError("--modbus: a run in process takes no commands; choose --link")
        stack.enter_context(companion("modbus", folder, options.modbus))
    return scope


def _check_network(options: argparse.Namespace) -> None:
    """Refuse what is of one converter."""
    if options.controller is not None:
        raise UserError("--controller: controls one converter; a network runs without it")
    for name in ("scope", "stream", "modbus"):
        if getattr(options, name) is not None:
            raise UserError(
                f"--{name}: looks at one converter; start gfmhil {name} beside the run, with the"
                " folder of a converter"
            )
