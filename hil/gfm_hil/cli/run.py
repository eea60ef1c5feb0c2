"""gfmhil run: one scenario, one run folder."""

import argparse
import contextlib
import os
import subprocess
import sys
from typing import Any

from gfm_hil.api.runs import run as run_one
from gfm_hil.api.runs import run_network
from gfm_hil.cli import common
from gfm_hil.controllers import PIL
from gfm_hil.core.errors import UserError
from gfm_hil.ports import PORTS, make_port
from gfm_hil.ports.port import OWN_NUMBER, companion
from gfm_hil.recording.run import Run
from gfm_hil.results.report import PAGE
from gfm_hil.run.network_run import NetworkRun


def add(command: argparse.ArgumentParser) -> None:
    common.add_scenario_options(command)
    command.add_argument(
        "--law", help="override law: catalogue name or law file; of a network see --converter"
    )
    command.add_argument(
        "--converter", metavar="NAME",
        help="of a network: the one that gets --law and --inner; all get them by default, if none"
        " has its own",
    )  # fmt: skip
    command.add_argument(
        "--controller", metavar="[NAME=]KIND:NAME", action="append", default=[],
        help="dll:FILE (IEEE/CIGRE), fmu:FILE or c:FILE: the controller, in place of a law of ours;"
        " or pil:TARGET, the law on a processor in QEMU, see gfmhil firmware check, or"
        " pil:TARGET:FOLDER with a firmware around it; of a network NAME=KIND:NAME, again for each",
    )  # fmt: skip
    common.add_map(command, "--controller", action="append", default=[])
    command.add_argument(
        "--cores", type=int, metavar="N",
        help="processor cores for the parts of a network that lines of travelling waves cut",
    )  # fmt: skip
    command.add_argument(
        "--snapshot", type=float, metavar="S",
        help="keep the state of both sides at this time in the run folder, s; lockstep",
    )  # fmt: skip
    command.add_argument(
        "--from", dest="start_from", metavar="RUN", type=os.path.abspath,
        help="start where the snapshot in this run folder was taken",
    )  # fmt: skip
    command.add_argument("-o", "--out", help="run folder; runs/<scenario>-<time> by default")
    command.add_argument("--json", action="store_true", help="print summary.json and nothing else")
    command.add_argument("--quiet", action="store_true", help="no progress on stderr")
    command.add_argument("--no-figures", action="store_true", help="neither figures nor report")
    common.add_open(command)
    command.add_argument(
        "--waveforms", type=common.window, metavar="FROM:TO",
        help="override waveforms: the window of the figure of the three phases, s",
    )  # fmt: skip
    for name, entry in PORTS.items():
        command.add_argument(
            f"--{name}", nargs="?", type=int, const=OWN_NUMBER, metavar="PORT",
            help=f"{entry.text}, as gfmhil {name} does (port {entry.number})",
        )  # fmt: skip


def call(options: argparse.Namespace) -> int:
    pil = any(text.rpartition("=")[2].startswith(PIL) for text in options.controller)
    if pil and not options.mode:
        options.mode = "lockstep"  # QEMU keeps no time
    scenario = common.resolve(options)
    folder = common.new_folder(options.out, common.short_name(options.scenario))
    figures = not options.no_figures
    controllers = common.by_converter("--controller", options.controller, scenario.parts)
    maps = common.by_converter("--map", list(map(str, options.map)), scenario.parts)
    with contextlib.ExitStack() as stack:
        run: Run | NetworkRun
        stay: dict[str, subprocess.Popen[str]] = {}
        for name, number in _ports(options, bool(scenario.parts)).items():
            beside = companion(name, folder, number, scenario.in_process)
            if (process := stack.enter_context(beside)) is not None:
                stay[name] = process
        with common.progress_bar(scenario, options.quiet) as (progress, notice):
            how: dict[str, Any] = {"figures": figures, "progress": progress, "notice": notice}
            if scenario.network is not None:
                run = run_network(scenario, folder, controllers=controllers, ports=maps, **how)
            else:
                how |= {"controller": controllers.get(""), "ports": maps.get("")}
                run = run_one(scenario, folder=folder, **how)
        common.print_result(options, run.summary, common.run_in_words(run, folder, why=True))
        common.show_page(options, folder / PAGE)
        for name, process in stay.items():
            if process.poll() is None and not _was_stopped(run):
                print(f"the {name} stays open until Ctrl-C", file=sys.stderr, flush=True)
                with contextlib.suppress(KeyboardInterrupt):
                    process.wait()
    return common.exit_code(run)


def _was_stopped(run: Run | NetworkRun) -> bool:
    """Whether an operator ended the run; of a network a side of any converter, whose other side may
    have ended in SAFE by that."""
    if isinstance(run, NetworkRun):
        return bool(run.summary["stopped"])
    return run.status == "interrupted"


def _ports(options: argparse.Namespace, network: bool) -> dict[str, int]:
    """The numbers of the ports that the options name. Raises UserError: one of them looks at one
    converter, and there is a network."""
    named = {name: getattr(options, name) for name in PORTS}
    found = {name: number for name, number in named.items() if number is not None}
    for name in found:
        if network and not make_port(name).networks:
            raise UserError(
                f"--{name}: looks at one converter; start gfmhil {name} beside the run, with the"
                " folder of a converter"
            )
    return found
