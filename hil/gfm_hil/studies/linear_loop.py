"""The linear loop of a scenario, at the operating point where the run starts."""

import math
import shlex
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.closed_loop import ClosedLoop
from gfm_design.model.network import NetworkLoop
from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import target_of
from gfm_hil.recording.run import Run, nominal_frequency
from gfm_hil.run.network_run import NetworkRun
from gfm_hil.scenario import Scenario, load_scenario, plant_of
from gfm_plant import NoEquilibrium
from gfm_runtime import BuiltLaw, DiscreteLaw, discretise, law_titles, load_law
from gfm_runtime.assembly import Controller

_GROWS = 1e-6  # 1/s; rounding moves a mode at s = 0, such as an island's angle, by less


def initial_law(scenario: Scenario) -> tuple[DiscreteLaw, str]:
    """The law of one converter at its start, of a scheduled law the stage in force; its label."""
    references = scenario.references.vector()
    controller = Controller([load_law(scenario.law, scenario.inner)], scenario.T_s, references)
    return controller.active_law, controller.active


def title_of(loop: ClosedLoop) -> str:
    """The name of the law; of a converter of a network its own name too."""
    if loop.around is not None:
        return loop.around.name
    return loop.origin.law.law.name if loop.origin else "loop"


def converter_of_loop(scenario: Scenario, converter: str | None) -> str | None:
    """The converter of a network whose loop it is: ``converter``, or the one to which this run
    folder belongs; None without a network. Raises UserError: a network, and none is named."""
    if scenario.network is None:
        return None
    name = converter or scenario.converter
    if name is None:
        raise UserError(
            f"network: this takes the loop of one converter; --converter names it, one of"
            f" {scenario.converters}"
        )
    return name


def scenario_loop(scenario: Scenario, converter: str | None = None) -> tuple[ClosedLoop, str]:
    """The loop of the scenario's first law, and its label; in a network that of ``converter``, or
    of the converter to which this run folder belongs. Raises NoEquilibrium, UserError: there is no
    operating point; or no converter is named, or one that the network does not have."""
    name = converter_of_loop(scenario, converter)
    if name is None:
        law, label = initial_law(scenario)
        loop = ClosedLoop.of(law, scenario.plant, scenario.references.vector())
        loop.where = scenario.title
        return loop, label
    try:
        loop = network_loop(scenario).converter(name)
    except ValueError as problem:
        raise UserError(str(problem)) from None
    return loop, title_of(loop)


def unstable_mode(scenario: Scenario, last: str = "") -> tuple[str, str] | None:
    """The first law whose linear loop at the start is unstable, and its modes that grow in words,
    the fastest first; None if there is none.

    Without a network, the laws to which the run changes are checked too, the one of the title
    ``last`` before all others; with one, the law is "". A law without an operating point is
    skipped.
    """
    alone = scenario.network is None
    laws = scenario.model_copy(update={"ready_laws": []}).laws() if alone else [""]
    for law, title in sorted(law_titles(laws).items(), key=lambda one: one[1] != last):
        under = scenario.model_copy(update={"law": law})
        try:
            loop = scenario_loop(under)[0] if alone else network_loop(scenario)
            grow = [mode for mode in loop.modes() if mode.sigma > _GROWS]
        except (UserError, ValueError, ArithmeticError, ModuleNotFoundError):
            continue
        if grow:
            each = [
                (f"{mode.frequency_hz:.4g} Hz" if mode.frequency_hz else "real")
                + f", {mode.sigma:+.3g} 1/s"
                for mode in sorted(grow, key=lambda mode: -mode.sigma)
            ]
            of = f" of {title}" if title else ""
            modes = "an unstable mode" if len(each) == 1 else f"{len(each)} unstable modes"
            words = f"the linear loop{of} has {modes}: {'; '.join(each)}"
            return law, words + (_current_loop_too_fast(under) if alone else "")
    return None


def why_unstable(scenario: Scenario, named: str | Path, last: str = "") -> str:
    """The unstable mode of a scenario's linear loop in one sentence, with the command that shows
    its modes; empty if there is none.

    Args:
        scenario: whose loop it is.
        named: what that command calls the scenario.
        last: title of the law in force when the run ended.
    """
    found = unstable_mode(scenario, last)
    if found is None:
        return ""
    law, words = found
    more = ["--law", law] if law else []
    return f"{words} ({shlex.join(['gfmhil', 'design', 'poles', *more, '--scenario', str(named)])})"


def why_it_ended(run: Run | NetworkRun) -> str:
    """As ``why_unstable``, of a run that did not last, or still oscillated at its end, under laws
    of ours."""
    each = [*run.values()] if isinstance(run, NetworkRun) else [run]
    early = [one for one in each if one.status not in ("completed", "interrupted")]
    if run.folder is None or not any(one.summary["ticks"] for one in early):  # none ever began
        return ""
    if any(target_of(one.summary["controller"]) is None for one in each):
        return ""
    last = "" if isinstance(run, NetworkRun) else run.summary["laws"][-1]
    return why_unstable(run.scenario, run.folder / "scenario.toml", last)


def _current_loop_too_fast(scenario: Scenario) -> str:
    """What to change where the current loop of the law's inner stage is too fast for T_s, or "".

    The loop on L_f alone, i[k+1] = i[k] - g i[k-d] with g = k_c omega_b T_s / L_f, is stable for
    g below 2 sin(pi / (4 d + 2)) (Levin and May, Theor. Popul. Biol. 9, 1976).
    """
    (inner, *_) = (law.inner for law in load_law(scenario.law, scenario.inner).laws)
    if inner is None:
        return ""
    delay = scenario.plant.delay
    d = math.ceil(delay.samples + delay.fraction)
    turn = 2 * math.pi * nominal_frequency(scenario) * scenario.T_s
    most = 2 * math.sin(math.pi / (4 * d + 2)) * inner.L_f / turn
    if inner.k_c < most:
        return ""
    return (
        f"; at T_s = {1e3 * scenario.T_s:g} ms, u {d} ticks late, the current loop needs "
        f"k_c below {most:.3g} p.u. (it is {inner.k_c:g})"
    )


def network_loop(
    on: str | Path | Scenario | dict[str, Any],
    laws: Mapping[str, BuiltLaw] = MappingProxyType({}),
    **changes: Any,
) -> NetworkLoop:
    """The linear loop of a scenario with a network, as it is when the run starts. Raises UserError:
    one line a mistake; the scenario has no network; there is no operating point.

    Args:
        on: a scenario: its name, file or content, or a checked one.
        laws: by converter, other laws than the scenario's; they bring their own inner stage.
        changes: keys of the scenario with ``__`` for the dot, as for ``gfmhil.run``.
    """
    scenario = load_scenario(on, **changes)
    if scenario.network is None:
        raise UserError("network: the scenario has none; use Law.closed_loop")
    try:
        return linearise(scenario, laws)
    except NoEquilibrium as problem:
        raise UserError(f"network: {problem}") from None


def loop_under(law: BuiltLaw, scenario: Scenario, converter: str | None) -> ClosedLoop:
    """The sampled loop of a checked scenario under another law, of one converter if there is a
    network. Raises NoEquilibrium: there is no operating point."""
    if converter is not None:
        return linearise(scenario, {converter: law}).converter(converter)
    return ClosedLoop.of(law, scenario.plant, scenario.references.vector(), T_s=scenario.T_s)


def linearise(
    scenario: Scenario,
    laws: Mapping[str, BuiltLaw],
    references: Mapping[str, NDArray[np.float64]] = MappingProxyType({}),
) -> NetworkLoop:
    """The linear loop of a checked scenario with a network. Raises NoEquilibrium: there is no
    operating point.

    Args:
        laws: by converter, other laws than the scenario's; they bring their own inner stage.
        references: by converter, other ones than the scenario's, (5,), p.u.
    """
    each = scenario.each
    built = [
        discretise(laws[name], scenario.T_s) if name in laws else initial_law(one)[0]
        for name, one in each.items()
    ]
    refs = [references.get(name, one.references.vector()) for name, one in each.items()]
    return NetworkLoop.of(plant_of(scenario), built, refs)
