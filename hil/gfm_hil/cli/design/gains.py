"""gfmhil design gamma and tune: gamma of given gains, and the free gains for the least gamma."""

import argparse
import functools
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gfm_design.model.closed_loop import T_S
from gfm_design.norms.hinf import Unstable
from gfm_design.norms.performance import WeightedChannel
from gfm_design.tuning.paper import EVALUATIONS
from gfm_hil.api import design
from gfm_hil.api.law import Law
from gfm_hil.cli import common
from gfm_hil.cli.design.common import add_converter_option, chosen_scenario
from gfm_hil.core.errors import UserError
from gfm_hil.core.terminal import terminal
from gfm_hil.results.table import Table
from gfm_hil.scenario import Scenario, load_scenario
from gfm_runtime import law_file
from gfm_runtime.lawfile import LawFile


def add(kinds: Any) -> None:
    _add_gamma(kinds)
    _add_tune(kinds)


def chosen_law(options: argparse.Namespace) -> LawFile:
    """The law file of --law, with the inner stage of --inner if it is given. Raises LawError: no
    such law or stage, or a mistake in its file."""
    return law_file(options.law).behind(options.inner)


def problem_title(file: LawFile, on: Scenario | None = None, *more: Any) -> str:
    """The name of a law, and which problem its gamma is that of if it is not the paper's; arguments
    as of ``problem_name``."""
    if on is None and file.inner is None:
        return file.name
    return f"{file.name}, {design.problem_name(file, on, *more)}"


def add_judged_on(command: argparse.ArgumentParser) -> None:
    """Where else than on the paper's converter gamma is judged."""
    command.add_argument(
        "--scenario",
        help="scenario file or shipped name: its sampled loop in place of the paper's problem",
    )
    add_converter_option(command)
    common.add_settings(command)


def judged_on(options: argparse.Namespace) -> Scenario | None:
    """The scenario of --scenario, under --law, --inner and --set. Raises UserError: as
    ``chosen_scenario``; --converter is missing, or without --scenario."""
    if options.scenario is None:
        if options.converter is not None:
            raise UserError(f"--converter {options.converter}: needs --scenario with a network")
        if options.settings:
            raise UserError(f"--set {options.settings[0][0]}: needs --scenario")
        return None
    if options.converter is None and (names := load_scenario(options.scenario).converters):
        raise UserError(f"--scenario {options.scenario}: --converter names the one of {names}")
    return chosen_scenario(options.scenario, options)


def add_law_options(command: argparse.ArgumentParser) -> None:
    """The law, its inner stage, its gains, the weights, and JSON."""
    command.add_argument("--law", required=True, help="catalogue name or law file")
    common.add_inner(command)
    command.add_argument("--gains", help="k=v,…: other values (tune: other starts)")
    command.add_argument("--weights", help="TOML file of weights; the paper's six by default")
    command.add_argument("--json", action="store_true", help="as JSON")


def read_gains(text: str | None, option: str = "--gains") -> dict[str, float]:
    """``k_22=5,k_34=1`` as a dict. Raises UserError: an entry that is not NAME=NUMBER, or a name
    given twice."""
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
    def run(options: argparse.Namespace) -> int:
        try:
            return call(options)
        except np.linalg.LinAlgError as problem:
            raise UserError(
                f"{options.law}: the problem is singular ({problem}); a gain may be 0 or far "
                "out of range"
            ) from None

    return run


#: what a channel leads from and to, by its j and i
_W = {1: "P_ref", 2: "ω_g"}
_Z = {1: "P_ref − p", 2: "p", 3: "ω_u", 4: "q + V/D_q"}


def channels_in_words(
    name: str, channels: Sequence[WeightedChannel], more: str = ""
) -> Iterator[str | Table]:
    """gamma, with ``more`` behind it, and its channels as a table."""
    rows = [
        [f"W_{c.i}{c.j} T_{c.i}{c.j}", f"{c.norm:.6g}", "∞" if np.isinf(c.omega) else c.omega]
        for c in channels
    ]
    yield f"[bold]{name}[/]: γ = {max(c.norm for c in channels):.6g}{more}"
    yield Table(("channel", "‖W T‖∞", "at [rad/s]"), rows, text=None)
    for c in channels:
        if np.isinf(c.omega):
            yield (
                f"W_{c.i}{c.j} T_{c.i}{c.j} is largest at infinite frequency: {_W[c.j]} acts on "
                f"{_Z[c.i]} at once, and W_{c.i}{c.j} does not fall there"
            )


def _add_gamma(kinds: Any) -> None:
    command = kinds.add_parser("gamma", help="gamma of a law's gains, channel by channel")
    add_law_options(command)
    add_judged_on(command)
    command.add_argument(
        "--discrete",
        action="store_true",
        help="of the loop sampled at 10 kHz: law and weights by Tustin, no delay; with an inner "
        "stage the loop is sampled in any case",
    )
    command.set_defaults(call=_gamma)


@singular_is_users
def _gamma(options: argparse.Namespace) -> int:
    """Report gamma of given gains; exit code 3 for an unstable loop, which has none."""
    law, given = Law(chosen_law(options)), read_gains(options.gains)
    on, converter = judged_on(options), options.converter
    if given:
        law = law.with_gains(law.name, **given)
    try:
        T_s = T_S if options.discrete else None
        channels = design.gamma(law, options.weights, T_s, on=on, converter=converter).channels
    except Unstable as found:
        none = {"law": law.name, "gamma": None, "reason": str(found)}
        common.print_result(options, none, [f"{law.name}: no gamma, {found}"])
        return common.EXIT_OTHERWISE
    content = {"law": law.name, **design.channels_as_json(channels)}
    title = problem_title(law.file, on, converter)
    common.print_result(options, content, channels_in_words(title, channels))
    return 0


def _add_tune(kinds: Any) -> None:
    command = kinds.add_parser("tune", help="choose the free gains for the least gamma")
    add_law_options(command)
    add_judged_on(command)
    command.add_argument("--seed", type=int, default=0, help="of the search")
    command.add_argument(
        "--evaluations", type=int, default=EVALUATIONS, help="of each start, before its polish"
    )
    command.add_argument(
        "--starts",
        type=int,
        help="the given start and random ones; 6, and one more a gain, if left out",
    )
    command.add_argument("--only", help="free gains to move, separated by commas; all by default")
    command.add_argument(
        "--decay", type=float, default=0.0, metavar="A",
        help="every mode of the loop must decay at least this fast, 1/s",
    )  # fmt: skip
    command.add_argument(
        "--scr", metavar="A,B,…", type=common.numbers, default=[],
        help="short-circuit ratios of the scenario's grid, in all of which the law is judged",
    )  # fmt: skip
    command.add_argument("--full-order", action="store_true", help="also compute a lower bound")
    command.add_argument("-o", "--out", help="write the tuned law to this file")
    command.add_argument("--quiet", action="store_true", help="no progress on stderr")
    command.set_defaults(call=_tune)


@singular_is_users
def _tune(options: argparse.Namespace) -> int:
    """Tune a law's free gains; exit code 3 if no stabilising ones are found."""
    if options.out and not Path(options.out).parent.is_dir():
        raise UserError(f"--out {options.out}: {Path(options.out).parent} is no folder")
    law, on = Law(chosen_law(options)), judged_on(options)
    if options.full_order and on is not None:
        raise UserError("--full-order: the bound is that of the paper's problem; omit --scenario")
    if options.full_order and law.file.inner is not None:
        raise UserError("--full-order: the bound is that of a law on the bridge; use --inner none")
    try:
        with common.watching(f"tuning {law.name}", options.quiet) as watch:
            found = design.tune(
                law, start=read_gains(options.gains),
                only=None if options.only is None else options.only.split(","),
                weights=options.weights, on=on, converter=options.converter, decay=options.decay,
                scr=options.scr, seed=options.seed, evaluations=options.evaluations,
                starts=options.starts, watch=watch,
            )  # fmt: skip
    except design.NotTuned as none:
        if options.json:
            print(json.dumps({"law": law.name, "gamma": None, "reason": str(none)}))
        else:
            terminal(stderr=True).print(f"{law.name}: {none}", highlight=False, soft_wrap=True)
        return common.EXIT_OTHERWISE
    named, channels = found.gains, found.gamma.channels
    result = {
        "law": law.name,
        **design.channels_as_json(channels),
        "gamma_before": None if found.before is None else found.before.value,
        "gamma_full_order": None,
        "gains": named,
        "at_bounds": found.at_bounds,
        "unmoved": [f"W_{c.i}{c.j}" for c in found.unmoved],
        "seconds": found.seconds,
        "evaluations": found.evaluations,
        "seed": found.seed,
    }
    said = _bound(found, result) if options.full_order else ""
    more = options.converter, options.weights, options.scr
    if options.out:
        problem = None if on is None else design.problem_name(law.file, on, *more)
        design.write_law(Path(options.out), law.file, named, result, problem=problem)
    began = "unstable" if found.before is None else f"{found.before.value:.6g}"
    title = problem_title(law.file, on, *more)
    lines: list[str | Table] = [
        *channels_in_words(title, channels, f", before the search {began}"),
        *(f"no free gain moves W_{c.i}{c.j} T_{c.i}{c.j}, the largest" for c in found.unmoved),
        ", ".join(f"{n} = {v:.6g}" for n, v in named.items()),
        f"{found.evaluations} evaluations in {found.seconds:.1f} s, seed {found.seed}"
        + (f"; law file: {options.out}" if options.out else ""),
        *(f"{n} is at its bound {x:g}: γ may fall beyond it" for n, x in found.at_bounds.items()),
        said,
    ]
    common.print_result(options, result, [line for line in lines if line])
    return 0


def _bound(tuning: design.Tuning, result: dict[str, Any]) -> str:
    """The full-order bound into the result; what to say of it."""
    try:
        found = tuning.bound()
    except UserError as missing:
        terminal(stderr=True).print(str(missing), highlight=False, soft_wrap=True)
        return ""
    if found is None:
        return "full order: the solver came to no result in time"
    result["gamma_full_order"] = found.bound
    result["full_order_columns"] = list(found.columns)
    columns = ", ".join("not solved" if c is None else f"{c:.4g}" for c in found.columns)
    return f"no controller at all goes below {found.bound:.4g}; stack of P_ref, of ω_g: {columns}"
