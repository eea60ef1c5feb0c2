"""gfmhil controller and gfmhil plant: one side alone, so that two machines can be used."""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from gfm_hil.cli.common import (
    add_map,
    add_scenario_options,
    endpoints,
    exit_code,
    new_folder,
    print_network,
    print_summary,
    resolve,
)
from gfm_hil.controllers import FORMS, BenchContext, open_controller, read_map
from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import Role
from gfm_hil.engine.compiling import compiled_bench, compiled_benches
from gfm_hil.engine.process import run_role
from gfm_hil.links import link_names
from gfm_hil.realtime.priority import one_processor
from gfm_hil.results.network_run import NetworkRun
from gfm_hil.results.run_folder import check_free, cut_short, finish, in_use
from gfm_hil.scenario.model import Scenario
from gfm_plant import load_converter
from gfm_runtime.errors import meant


def add(command: argparse.ArgumentParser) -> None:
    add_scenario_options(command)
    command.add_argument("--law", help="override law: catalogue name or law file")
    command.add_argument("--converter", help="of a network: the one that this controller controls")
    command.add_argument("-o", "--out", help="run folder; runs/<role>-<time> by default")
    command.add_argument("--quiet", action="store_true", help="say nothing but errors")
    command.add_argument(
        "--model", metavar="KIND:NAME", help=f"of the controller: {FORMS}, which computes u",
    )  # fmt: skip
    add_map(command, "--model")
    command.add_argument("--part", action="store_true", help=argparse.SUPPRESS)


def call(options: argparse.Namespace) -> int:
    """Carry one side out; returns the exit code."""
    role: Role = options.command
    scenario = _of_one(role, resolve(options, named=True, law=options.law), options.converter)
    if scenario.in_process:
        raise UserError(f"link.type = 'inproc': a side alone needs a link: {link_names()}")
    given = _given(scenario, endpoints(options))
    if options.model is not None and role == "plant":
        raise UserError("--model: the plant has no model; start the controller with it")
    model = None
    if options.model is not None:
        ports = read_map(options.map)
        with one_processor(scenario.mode):
            model = open_controller(options.model, ports, _bench_context(scenario))
    folder = new_folder(options.out, role)
    places = {name: folder / name for name in scenario.parts} or {"": folder}
    if options.part:  # of `gfmhil run`, which puts the parts together
        with _all_in_use(places):
            run_role(role, scenario, folder, given, lambda text: None, model)
        return 0
    check_free(folder, scenario.ticks * len(places), scenario.has_inner)

    def notice(text: str) -> None:
        if not options.quiet:
            print(text, file=sys.stderr, flush=True)

    if scenario.parts:
        benches = compiled_benches(scenario, notice, (role,))
    else:
        benches = [compiled_bench(scenario, notice, (role,))]
    for place in places.values():
        place.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    with _all_in_use(places), cut_short(folder):
        run_role(role, scenario, folder, given, notice, model)
        wall_s = time.monotonic() - began
        runs = {
            name: finish(bench.scenario, place, bench.controller.labels, wall_s)
            for bench, (name, place) in zip(benches, places.items(), strict=True)
        }
    if scenario.parts:
        whole = NetworkRun(scenario, runs, folder)
        whole.conclude(folder)
        if not options.quiet:
            print_network(whole, folder)
    elif not options.quiet:
        print_summary(runs[""].summary, folder)
    return max(exit_code(run.summary) for run in runs.values())


def _bench_context(scenario: Scenario) -> BenchContext:
    """What a model in place of the controller is connected to."""
    delay, bases = scenario.plant.delay, load_converter(scenario.plant.converter).bases
    return BenchContext(scenario.T_s, scenario.has_inner, bases, delay.samples + delay.fraction)


def _of_one(role: Role, scenario: Scenario, converter: str | None) -> Scenario:
    """The scenario of a controller, which has one converter.

    Raises:
        UserError: --converter is missing, or does not fit.
    """
    known = scenario.parts
    if role == "plant" or not known:
        if converter is not None:
            raise UserError(f"--converter {converter}: for the controller of a network's converter")
        return scenario
    if converter is None:
        raise UserError(f"--converter: which one this controller controls; one of {known}")
    if converter not in known:
        raise UserError(f"--converter {converter}: must be one of {known}{meant(converter, known)}")
    return scenario.of(converter)


def _given(scenario: Scenario, named: dict[str, str]) -> dict[str, str]:
    """The endpoint of each converter that has one by --endpoint.

    Raises:
        UserError: one is missing, or is that of no converter.
    """
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


@contextlib.contextmanager
def _all_in_use(places: dict[str, Path]) -> Iterator[None]:
    with contextlib.ExitStack() as stack:
        for place in places.values():
            stack.enter_context(in_use(place))
        yield
