"""gfmhil controller and gfmhil plant: one side alone, so that two machines can be used."""

from __future__ import annotations

import argparse
import sys
import time

from gfm_hil.cli.common import (
    add_map,
    add_scenario_options,
    exit_code,
    new_folder,
    print_summary,
    resolve,
)
from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import Role
from gfm_hil.core.stopping import end_with_parent
from gfm_hil.engine.compiling import compiled_bench
from gfm_hil.engine.process import run_role
from gfm_hil.links import link_names
from gfm_hil.models import open_model, read_map
from gfm_hil.results.run_folder import check_free, finish, in_use
from gfm_hil.scenario.model import INPROC


def add(command: argparse.ArgumentParser) -> None:
    add_scenario_options(command)
    command.add_argument("--law", help="override law: catalogue name or law file")
    command.add_argument("--out", help="run folder; runs/<role>-<time> by default")
    command.add_argument("--quiet", action="store_true", help="say nothing but errors")
    command.add_argument(
        "--model", metavar="KIND:FILE",
        help="of the controller: dll:FILE or fmu:FILE, which computes u in place of the law",
    )  # fmt: skip
    add_map(command, "--model")
    command.add_argument("--part", type=int, metavar="PID", help=argparse.SUPPRESS)


def call(options: argparse.Namespace) -> int:
    """Carry one side out; returns the exit code."""
    role: Role = options.command
    scenario = resolve(options, law=options.law)
    if scenario.link.type == INPROC:
        raise UserError(f"link.type = 'inproc': a side alone needs a link: {link_names()}")
    if scenario.link.endpoint is None:
        raise UserError("link.endpoint: not set; a side started alone needs one (--endpoint)")
    if options.model is not None and role == "plant":
        raise UserError("--model: the plant has no model; start the controller with it")
    model = None
    if options.model is not None:
        ports = read_map(options.map)
        model = open_model(options.model, ports, scenario.T_s, scenario.has_inner)
    folder = new_folder(options.out, role)
    if options.part is not None:  # of `gfmhil run`, which puts the parts together
        end_with_parent(options.part)
        with in_use(folder):
            run_role(role, scenario, folder, lambda text: None, model)
        return 0
    check_free(folder, scenario.ticks, scenario.has_inner)

    def notice(text: str) -> None:
        if not options.quiet:
            print(text, file=sys.stderr, flush=True)

    labels = compiled_bench(scenario, notice, (role,)).controller.labels
    folder.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    with in_use(folder):
        run_role(role, scenario, folder, notice, model)
        wall_s = time.monotonic() - began
        run = finish(scenario, folder, labels, wall_s)
    if not options.quiet:
        print_summary(run.summary, folder)
    return exit_code(run.summary)
