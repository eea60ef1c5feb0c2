"""What the design commands share: gains and weights from outside, channels as JSON and a table."""

from __future__ import annotations

import argparse
import functools
from collections.abc import Callable, Sequence

import numpy as np

from gfm_design.norms.performance import WeightedChannel
from gfm_hil.api.tuned_law import channels_as_json as channels_as_json
from gfm_hil.api.tuned_law import problem_name
from gfm_hil.cli.common import OPTIONS
from gfm_hil.core.errors import UserError
from gfm_hil.core.terminal import terminal
from gfm_hil.results.table import Table
from gfm_hil.scenario import Scenario, load_scenario
from gfm_runtime import law_file
from gfm_runtime.inner_file import named_inner
from gfm_runtime.lawfile import LawFile


def add_inner_option(command: argparse.ArgumentParser) -> None:
    """The inner stage."""
    command.add_argument(
        "--inner", metavar="NAME",
        help="inner stage: a shipped name (gfmhil laws), a file, or none; the law's own by default",
    )  # fmt: skip


def add_converter_option(command: argparse.ArgumentParser) -> None:
    """The converter of a network."""
    command.add_argument(
        "--converter", metavar="NAME",
        help="of a scenario with a network: the converter whose loop it is, and that gets --law and"
        " --inner",
    )  # fmt: skip


def chosen_scenario(given: str, options: argparse.Namespace) -> Scenario:
    """A scenario with the law and the inner stage of --law and --inner; in a network those of
    --converter.

    Raises:
        UserError: as ``load_scenario``; --converter does not name a converter of the network.
    """
    names = {**OPTIONS, "converter": "--converter"}
    return load_scenario(
        given, names, converter=options.converter, law=options.law, inner=options.inner
    )


def chosen_law(options: argparse.Namespace) -> LawFile:
    """The law file of --law, with the inner stage of --inner if it is given.

    Raises:
        LawError: no such law or stage, or a mistake in its file.
    """
    file = law_file(options.law)
    if options.inner is None:
        return file
    return file.model_copy(update={"inner": named_inner(options.inner)})


def judged(file: LawFile, on: Scenario | None = None, converter: str | None = None) -> str:
    """The name of a law, and which problem its gamma is that of if it is not the paper's."""
    if on is None and file.inner is None:
        return file.name
    return f"{file.name}, {problem_name(file, on, converter)}"


def add_judged_on(command: argparse.ArgumentParser) -> None:
    """Where else than on the paper's converter gamma is judged."""
    command.add_argument(
        "--scenario",
        help="scenario file or shipped name: its sampled loop in place of the paper's problem",
    )
    add_converter_option(command)


def judged_on(options: argparse.Namespace) -> Scenario | None:
    """The scenario of --scenario, under --law and --inner.

    Raises:
        UserError: as ``chosen_scenario``; --converter is missing, or without --scenario.
    """
    if options.scenario is None:
        if options.converter is not None:
            raise UserError(f"--converter {options.converter}: needs --scenario with a network")
        return None
    if options.converter is None and (names := load_scenario(options.scenario).converters):
        raise UserError(f"--scenario {options.scenario}: --converter names the one of {names}")
    return chosen_scenario(options.scenario, options)


def add_law_options(command: argparse.ArgumentParser) -> None:
    """The law, its inner stage, its gains, the weights, and JSON."""
    command.add_argument("--law", required=True, help="catalogue name or law file")
    add_inner_option(command)
    command.add_argument("--gains", help="k=v,…: other values (tune: other starts)")
    command.add_argument("--weights", help="TOML file of weights; the paper's six by default")
    command.add_argument("--json", action="store_true", help="as JSON")


def read_gains(text: str | None, option: str = "--gains") -> dict[str, float]:
    """``k_22=5,k_34=1`` as a dict.

    Raises:
        UserError: an entry that is not NAME=NUMBER, or a name given twice.
    """
    found: dict[str, float] = {}
    for entry in text.split(",") if text is not None else []:
        name, _, value = (part.strip() for part in entry.partition("="))
        try:
            number = float(value)
        except ValueError:
            number = np.nan
        if not name or not np.isfinite(number):
            raise UserError(f"{option} {entry!r}: must be NAME=NUMBER, e.g. k_22=5.98")
        if name in found:
            raise UserError(f"{option}: {name} is given twice")
        found[name] = number
    return found


def singular_is_users(
    call: Callable[[argparse.Namespace], int],
) -> Callable[[argparse.Namespace], int]:
    """A command that says in one line that its problem is singular."""

    @functools.wraps(call)
    def checked(options: argparse.Namespace) -> int:
        try:
            return call(options)
        except np.linalg.LinAlgError as problem:
            raise UserError(
                f"{options.law}: the problem is singular ({problem}); a gain may be 0 or far "
                "out of range"
            ) from None

    return checked


#: what a channel leads from and to, by its j and i
_W = {1: "P_ref", 2: "ω_g"}
_Z = {1: "P_ref − p", 2: "p", 3: "ω_u", 4: "q + V/D_q"}


def print_channels(name: str, channels: Sequence[WeightedChannel]) -> None:
    """gamma and its channels as a table."""
    rows = [
        [f"W_{c.i}{c.j} T_{c.i}{c.j}", f"{c.norm:.6g}", "∞" if np.isinf(c.omega) else c.omega]
        for c in channels
    ]
    console = terminal(highlight=False)
    console.print(f"[bold]{name}[/]: γ = {max(c.norm for c in channels):.6g}")
    console.print(Table(("channel", "‖W T‖∞", "at [rad/s]"), rows, text=None))
    for c in channels:
        if np.isinf(c.omega):
            console.print(
                f"W_{c.i}{c.j} T_{c.i}{c.j} is largest at infinite frequency: {_W[c.j]} acts on "
                f"{_Z[c.i]} at once, and W_{c.i}{c.j} does not fall there",
                soft_wrap=True,
            )
