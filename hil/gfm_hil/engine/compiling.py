"""What a run calls in its ticks, compiled set by set before it starts.

numba compiles a function when it is first called, and keeps the result in its cache. So the first
run of an installation on a machine compiles for minutes, and those after it only load.
"""

import json
from collections.abc import Callable, Collection, Iterable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba.core import event

from gfm_hil.controllers import ExternalController
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.engine.compiling_beside import Beside
from gfm_hil.engine.external_ticks import SteppedController
from gfm_hil.engine.inproc import compile_loop, rows
from gfm_hil.engine.lanes import Lanes
from gfm_hil.engine.process import compile_role
from gfm_hil.engine.setup import Bench, make_bench, make_benches, unstarted_benches
from gfm_hil.links import link_kind, link_names
from gfm_hil.links.impaired import link as impaired
from gfm_hil.realtime import prevent_idle
from gfm_hil.recording.columns import kept_of
from gfm_hil.recording.parts import RolePart
from gfm_hil.scenario import Scenario
from gfm_plant.names import WAYS
from gfm_plant.ways import find_ways
from gfm_runtime.compiled import wheel_code
from gfm_runtime.garbage import garbage_kept
from gfm_runtime.inner_tick import inner_tick
from gfm_runtime.signals import PLAIN


class Set(NamedTuple):
    """Functions that a run calls."""

    name: str  # for people
    compile: Callable[[], object]  # or load from the cache
    after: tuple[str, ...] = ()  # those it shares functions with and that had better come before


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
    with garbage_kept():
        for k, one in enumerate(sets, 1):
            text = f"compiling {one.name} ({k} of {len(sets)}, once a machine) …"
            if not compiled and (why := wheel_code().unfit):
                text = f"the code in this wheel is not used ({why})\n{text}"
            listener = _Listener(lambda text=text: notice(text))  # type: ignore[misc]
            with event.install_listener("numba:compile", listener):
                one.compile()
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
    first, second = _shares(scenario, roles, lambda: found)
    with Beside(scenario, [*roles], notice) as beside:
        start = Set(_START, lambda: found.extend(make_benches(scenario)))
        compile_sets([start, *first, Set("the rest", beside.wait), *second], beside.begin)
    return found


def compile_share(scenario: Scenario, roles: Iterable[Role]) -> None:
    """Compile what the second process does of a scenario, without its operating point. Arguments
    and errors as of ``compiled_benches``."""
    benches = _unstarted(scenario)
    _, second = _shares(scenario, roles, lambda: benches)
    compile_sets(second, lambda _: None)


def _unstarted(scenario: Scenario) -> list[Bench]:
    benches = unstarted_benches(scenario)
    benches[0].plant.records = benches[0].plant.typed
    return [b for b in benches if scenario.converter in (None, b.scenario.converter)]


def _shares(
    scenario: Scenario, roles: Iterable[Role], found: Callable[[], list[Bench]]
) -> tuple[list[Set], list[Set]]:
    """Split what the ticks of a scenario call between two processes, so that they take as long.
    The first one also compiles the operating point."""
    period = [Set(_PERIOD, lambda: _find_ways(found()[0]))] if "plant" in roles else []
    if scenario.in_process:
        sensors = Set("the sensors", lambda: _find_ways(found()[0], ("sample",)))
        first, second = [_both(found), sensors], period
    else:
        first, second = period, [_role(role, found) for role in sorted(roles)]
        links = {json.dumps([link.type, link.options]): link for link in scenario.links}
        second += [_link(link.type, link.options, scenario.signal_set) for link in links.values()]
        if any(link.impairment is not None for link in links.values()):
            second.append(_IMPAIRMENT)
        if scenario.mode == "realtime":
            second.append(_IDLE)
    # an operator may have anything happen, and in real time nobody waits until it is compiled
    foreseen = any(event.opens_phases for event in scenario.events)
    if "plant" in roles and (scenario.mode == "realtime" or foreseen):
        second.append(Set(_EVENTS, lambda: [*map(_find_event_ways, found())]))
    return first, second


def _find_ways(bench: Bench, names: Collection[str] = WAYS) -> None:
    find_ways(bench.plant.typed, bench.plant.wiring, names)


def _find_event_ways(bench: Bench) -> None:
    plant = bench.plant
    find_ways(plant.typed, plant.wiring, ("clear", "join", "watch"), all_events=True)


def everything() -> list[Set]:
    """What any run may call, over every link there is; but for a switched bridge's way through a
    period, and the loops of several converters over links, which their first run compiles."""
    limited = Scenario(title="warm-up", duration=1.0, inner="virtual-stator")

    @cache
    def found() -> list[Bench]:
        return _unstarted(Scenario(title="warm-up", duration=1.0))

    def with_inner() -> None:
        controller = found()[0].controller
        inner_tick(controller.laws.dtype, controller.states.dtype)

    def between(large: int) -> None:
        plant = found()[0].plant.copy()
        for name in ("n_dynamic", "sparse", "connections"):
            plant.net[name] = large
        find_ways(plant.typed, plant.wiring)

    return [
        Set(_PERIOD, lambda: find_ways(found()[0].plant.typed, found()[0].plant.wiring, ("step",))),
        Set(_START, lambda: make_bench(Scenario(title="warm-up", duration=1.0))),
        *(_link(name, {}) for name in link_names()),
        _IMPAIRMENT,
        _IDLE,
        *(_role(role, found) for role in reversed(ROLES)),
        Set("the operating point of an inner stage", lambda: make_bench(limited), (_START,)),
        Set("the plant between two instants", lambda: between(0), (_PERIOD,)),
        Set("the components of networks", lambda: between(1), (_PERIOD,)),
        Set("laws with an inner stage", with_inner),
        Set(_EVENTS, lambda: _find_event_ways(found()[0])),
        _both(found),
        SIDE_BY_SIDE,
    ]


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
    compile_sets([_role("controller", lambda: [bench], " of an external controller")], notice)


_START = "the operating point"
_PERIOD = "the plant's period"
_EVENTS = "what faults and breakers call"
_IDLE = Set("the thread that keeps a processor busy", prevent_idle.warm_up)
SIDE_BY_SIDE = Set("the loop of several runs", lambda: Lanes().run(0))
_IMPAIRMENT = Set("a link's impairment", impaired.warm_up)


def _both(found: Callable[[], list[Bench]]) -> Set:
    sides = tuple(f"the {role}" for role in ROLES)
    return Set("the loop of both sides", lambda: compile_loop(found()), (_START, *sides))


def _role(role: Role, found: Callable[[], list[Bench]], which: str = "") -> Set:
    def compile_it() -> None:
        benches = found()
        parts = [
            RolePart(
                rows(1, 1, bench.columns)[role == "controller"][0],
                np.empty((0, len(kept_of(role))), np.int64),
                np.zeros(2, np.int64),
            )
            for bench in benches
        ]
        compile_role(role, benches, parts)

    return Set(f"the {role}{which}", compile_it)


def _link(name: str, options: dict[str, Any], signal_set: int = PLAIN) -> Set:
    kind = link_kind(name)
    checked = kind.options.model_validate(options).of_run(signal_set)
    return Set(f"the link {name}", lambda: kind.warm_up(checked))
