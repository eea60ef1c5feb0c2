"""gfmhil controller and gfmhil plant: one side alone, so that two machines can be used."""

import argparse
import sys

from gfm_hil.cli import common
from gfm_hil.controllers import FORMS, BenchContext, open_controller, read_map
from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import Role
from gfm_hil.links import link_names
from gfm_hil.realtime.priority import one_processor
from gfm_hil.recording.run import bases
from gfm_hil.results.report import write_report
from gfm_hil.run.runner import run_part, run_side
from gfm_hil.scenario import Scenario
from gfm_runtime.children import name_process
from gfm_runtime.errors import meant


def add(command: argparse.ArgumentParser) -> None:
    common.add_scenario_options(command)
    command.add_argument("--law", help="override law: catalogue name or law file")
    command.add_argument("--converter", help="of a network: the one that this controller controls")
    command.add_argument("-o", "--out", help="run folder; runs/<role>-<time> by default")
    command.add_argument("--quiet", action="store_true", help="say nothing but errors")
    command.add_argument(
        "--model", metavar="KIND:NAME", help=f"of the controller: {FORMS}, which computes u"
    )
    common.add_map(command, "--model")
    command.add_argument("--part", action="store_true", help=argparse.SUPPRESS)


def call(options: argparse.Namespace) -> int:
    role: Role = options.command
    name_process(f"gfm {role}")
    scenario = _of_one(role, common.resolve(options, named=True), options.converter)
    if scenario.in_process:
        raise UserError(f"link.type = 'inproc': a side alone needs a link: {link_names()}")
    given = _match_endpoints(scenario, common.endpoints(options))
    if options.model is not None and role == "plant":
        raise UserError("--model: the plant has no model; start the controller with it")
    external = None
    if options.model is not None:
        ports = read_map(options.map)
        with one_processor(scenario.mode):
            external = open_controller(options.model, ports, _bench_context(scenario))
    folder = common.new_folder(options.out, role)
    if options.part:  # of `gfmhil run`, which puts the parts together
        run_part(role, scenario, folder, given, external)
        return 0

    def notice(text: str) -> None:
        if not options.quiet:
            print(text, file=sys.stderr, flush=True)

    run = run_side(role, scenario, folder, given, notice, write_report, external)
    if not options.quiet:
        common.print_parts(common.run_in_words(run, folder))
    return common.exit_code(run)


def _bench_context(scenario: Scenario) -> BenchContext:
    """What a model in place of the controller is connected to."""
    delay = scenario.plant.delay.samples + scenario.plant.delay.fraction
    return BenchContext(scenario.T_s, scenario.signal_set, bases(scenario), delay)


def _of_one(role: Role, scenario: Scenario, converter: str | None) -> Scenario:
    """The scenario of a controller, which has one converter. Raises UserError: --converter is
    missing, or does not fit."""
    known = scenario.parts
    if role == "plant" or not known:
        if converter is not None:
            raise UserError(f"--converter {converter}: for the controller of a network's converter")
        return scenario
    if converter is None:
        raise UserError(f"--converter: which one this controller controls; one of {known}")
    if converter not in known:
        raise UserError(f"--converter {converter}: must be one of {known}{meant(converter, known)}")
    return scenario.each[converter]


def _match_endpoints(scenario: Scenario, named: dict[str, str]) -> dict[str, str]:
    """The endpoint of each converter that has one by --endpoint. Raises UserError: one is missing,
    or is that of no converter."""
    known = scenario.parts or [scenario.converter or ""]
    if not scenario.parts and "" in named:
        named = {known[0]: named[""]}
    for name in named:
        if name not in known:
            wrong = f"{name}={named[name]}" if name else named[name]
            allowed = f"NAME=ENDPOINT with NAME in {known}" if known != [""] else "ENDPOINT alone"
            raise UserError(f"--endpoint {wrong}: must be {allowed}")
    for name, link in zip(known, scenario.links, strict=True):
        if link.endpoint is None and name not in named:
            of = f" of {name}" if scenario.parts else ""
            raise UserError(
                f"link.endpoint{of}: not set; a side started alone needs one (--endpoint)"
            )
    return named
