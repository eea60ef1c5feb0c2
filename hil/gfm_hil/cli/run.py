"""gfmhil run: one scenario, one run folder."""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
from pathlib import Path

from gfm_hil.cli.common import (
    add_map,
    add_scenario_options,
    exit_code,
    new_folder,
    print_network,
    print_summary,
    progress_bar,
    resolve,
    why_it_ended,
    window,
)
from gfm_hil.core.errors import UserError
from gfm_hil.engine.compiling import compile_for_model
from gfm_hil.models import FORMS, PIL, check_currents, model_file, precision, read_map
from gfm_hil.ports import PORTS
from gfm_hil.ports.companion import OWN_NUMBER, companion
from gfm_hil.results.runner import Notice, model_command, run_network, run_scenario
from gfm_hil.scenario.model import INPROC, Scenario, find_scenario


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
    for name, entry in PORTS.items():
        command.add_argument(
            f"--{name}", nargs="?", type=int, const=OWN_NUMBER, metavar="PORT",
            help=f"{entry.text}, as gfmhil {name} does (port {entry.number})",
        )  # fmt: skip


def call(options: argparse.Namespace) -> int:
    if options.controller is not None and options.controller.startswith(PIL) and not options.mode:
        options.mode = "lockstep"  # QEMU keeps no time
    scenario = resolve(options, law=options.law, waveforms=options.waveforms)
    folder = new_folder(options.out, find_scenario(options.scenario).stem)
    if scenario.network is not None:
        return _run_network(scenario, folder, options)
    with contextlib.ExitStack() as stack:
        stay = {}
        for name, number in _ports(options).items():
            beside = companion(name, folder, number, scenario.link.type == INPROC)
            if (process := stack.enter_context(beside)) is not None:
                stay[name] = process
        with progress_bar(scenario, scenario.title, options.quiet) as (progress, notice):
            command = _model_command(scenario, options, notice)
            figures = not options.no_figures
            run = run_scenario(scenario, folder, progress, notice, figures, command)
        if options.json:
            print(json.dumps(run.summary, indent=2), flush=True)
        else:
            print_summary(run.summary, folder, why_it_ended(run))
        for name, process in stay.items():
            if process.poll() is None and run.summary["status"] != "interrupted":
                print(f"the {name} stays open until Ctrl-C", file=sys.stderr, flush=True)
                with contextlib.suppress(KeyboardInterrupt):
                    process.wait()
    return exit_code(run.summary)


def _ports(options: argparse.Namespace) -> dict[str, int]:
    """The numbers of the ports that the options name."""
    named = {name: getattr(options, name) for name in PORTS}
    return {name: number for name, number in named.items() if number is not None}


def _model_command(scenario: Scenario, options: argparse.Namespace, notice: Notice) -> list[str]:
    """The program that steps the model of --controller; empty without one.

    Raises:
        UserError: there is no such model or map, the run is in process, has no operating point, or
            does not carry what the model measures.
    """
    if options.controller is None:
        if options.map is not None:
            raise UserError("--map: is of a model; name it by --controller")
        return []
    if scenario.link.type == INPROC:
        raise UserError("--controller: is a process, and a run in process has none; choose --link")
    real = precision(options.controller)
    if not options.controller.startswith(PIL):
        model_file(options.controller, FORMS)
    read_map(options.map)
    check_currents(options.controller, scenario.has_inner)
    compile_for_model(scenario, notice, real)
    return model_command(options.controller, options.map)


def _run_network(scenario: Scenario, folder: Path, options: argparse.Namespace) -> int:
    """Run several converters, each of which gets a run folder of its own."""
    if options.controller is not None:
        raise UserError("--controller: controls one converter; a network runs without it")
    for name in _ports(options):
        raise UserError(
            f"--{name}: looks at one converter; start gfmhil {name} beside the run, with the"
            " folder of a converter"
        )
    with progress_bar(scenario, scenario.title, options.quiet) as (progress, notice):
        figures = not options.no_figures
        runs = run_network(scenario, folder, progress, notice, figures=figures)
    if options.json:
        print(json.dumps(runs.summary, indent=2), flush=True)
    else:
        print_network(runs, folder)
    return max(exit_code(run.summary) for run in runs.values())
