"""What a run calls in its ticks, compiled set by set before it starts.

numba compiles a function when it is first called, and keeps the result in its cache. So the first
run of an installation on a machine compiles for minutes, and those after it only load.
"""

import json
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from numba.core import event

from gfm_hil.controllers import ExternalController
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.engine.external_ticks import SteppedController
from gfm_hil.engine.inproc import compile_loop, rows
from gfm_hil.engine.process import compile_role
from gfm_hil.engine.setup import Bench, make_bench, make_benches
from gfm_hil.links import link_kind, link_names
from gfm_hil.links.impaired import link as impaired
from gfm_hil.realtime import prevent_idle
from gfm_hil.recording.columns import kept_of
from gfm_hil.recording.parts import RolePart
from gfm_hil.scenario import Scenario
from gfm_runtime.compiled import wheel_code

#: a name for people, and what compiles the functions, or loads them from the cache
Set = tuple[str, Callable[[], object]]


class _Listener(event.Listener):
    """Calls a function at the first compilation that is none of another one's parts."""

    def __init__(self, begun: Callable[[], None]) -> None:
        self._begun, self.heard = begun, False

    def on_start(self, event: Any) -> None:
        if not self.heard:
            self.heard = True
            self._begun()

    def on_end(self, event: Any) -> None:
        """Nothing is said at the end."""


def compile_sets(sets: Sequence[Set], notice: Callable[[str], None]) -> int:
    """Compile sets of functions; ``notice`` is told of each set that numba has not in its cache,
    and before the first of them why the wheel's code does not serve, where it has some.

    Returns:
        How many sets those were.
    """
    compiled = 0
    for k, (name, compile_set) in enumerate(sets, 1):
        text = f"compiling {name} ({k} of {len(sets)}, once a machine) …"
        if not compiled and (why := wheel_code().unfit):
            text = f"the code in this wheel is not used ({why})\n{text}"
        listener = _Listener(lambda text=text: notice(text))  # type: ignore[misc]
        with event.install_listener("numba:compile", listener):
            compile_set()
        compiled += listener.heard
    return compiled


def compiled_benches(
    scenario: Scenario, notice: Callable[[str], None], roles: Iterable[Role] = ROLES
) -> list[Bench]:
    """The benches of a scenario's converters, with everything compiled that a tick calls.

    Args:
        scenario: checked.
        notice: told of each set of functions that numba has to compile.
        roles: the sides to compile for.

    Raises:
        UserError: as ``make_benches``.
    """
    found: list[Bench] = []
    sets: list[Set] = [("the operating point", lambda: found.extend(make_benches(scenario)))]
    if scenario.in_process:
        sets.append(_both(found))
    else:
        sets += [_role(role, found) for role in roles]
        links = {json.dumps([link.type, link.options]): link for link in scenario.links}
        sets += [_link(link.type, link.options, scenario.carries) for link in links.values()]
        if any(link.impairment is not None for link in links.values()):
            sets.append(("the link's impairment", impaired.warm_up))
        if scenario.mode == "realtime":
            sets.append(_IDLE)
    compile_sets(sets, notice)
    return found


def compile_everything(notice: Callable[[str], None]) -> tuple[int, int]:
    """Compile what any run may call, over every link there is.

    Returns:
        How many sets of functions numba had to compile, and how many there are.
    """
    scenario = Scenario(title="warm-up", duration=1.0)
    limited = Scenario(title="warm-up", duration=1.0, inner="virtual-stator")
    found: list[Bench] = []
    inner: list[Bench] = []
    sets: list[Set] = [
        ("the operating point", lambda: found.append(make_bench(scenario))),
        _both(found),
        *(_role(role, found) for role in ROLES),
        ("the operating point of an inner stage", lambda: inner.append(make_bench(limited))),
        *(_role(role, inner, " with an inner stage") for role in ROLES),
        *(_link(name, {}) for name in link_names()),
        ("a link's impairment", impaired.warm_up),
        _IDLE,
    ]
    return compile_sets(sets, notice), len(sets)


def compile_external(
    scenario: Scenario, notice: Callable[[str], None], real: str = "float64"
) -> None:
    """Compile what the controller's side calls to step an external controller.

    Args:
        scenario: of one converter, or of a network as the controller of one sees it.
        notice: as for ``compiled_benches``.
        real: of its laws.

    Raises:
        UserError: as ``make_benches``.
    """
    (bench,) = make_benches(scenario, real)
    nothing = ExternalController()
    nothing.name = "nothing"
    bench.external = SteppedController(nothing, bench.controller, bench.u)
    compile_sets([_role("controller", [bench], " of an external controller")], notice)


_IDLE: Set = ("the thread that keeps a processor busy", prevent_idle.warm_up)


def _both(found: list[Bench]) -> Set:
    return "the loop of both sides", lambda: compile_loop(found)


def _role(role: Role, found: list[Bench], which: str = "") -> Set:
    def compile_it() -> None:
        parts = [
            RolePart(
                rows(1, 1, bench.inner, bench.options)[role == "controller"][0],
                np.empty((0, len(kept_of(role))), np.int64),
                np.zeros(2, np.int64),
            )
            for bench in found
        ]
        compile_role(role, found, parts)

    return f"the {role}{which}", compile_it


def _link(name: str, options: dict[str, Any], inner: int = False) -> Set:
    kind = link_kind(name)
    checked = kind.options.model_validate(options).of_run(inner)
    return f"the link {name}", lambda: kind.warm_up(checked)
