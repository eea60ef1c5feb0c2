"""A scenario made ready: the plant's and the controller's records at the operating point.

Both sides build the same bench from the same scenario, possibly on two machines, so that only
frames have to cross the link.
"""

from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.operating_point import (
    OperatingPoint,
    check_dc_side,
    operating_point,
    operating_points,
)
from gfm_hil.core.errors import UserError
from gfm_hil.engine.external_ticks import SteppedController
from gfm_hil.engine.replay import Trace, no_trace, trace_of
from gfm_hil.engine.snapshot import start_from
from gfm_hil.recording.columns import ColumnSet
from gfm_hil.scenario import Scenario, plant_of
from gfm_hil.scenario.events.fault import Fault
from gfm_hil.scenario.events.gains import gains_of
from gfm_plant import Network, NoEquilibrium, begin_set_points, start_again, take_out
from gfm_plant.model import DELTA
from gfm_plant.names import MAY_START
from gfm_plant.parted import cut
from gfm_plant.wiring import Wiring
from gfm_runtime import law_titles, load_law
from gfm_runtime.assembly import Controller, copied
from gfm_runtime.signals import (
    COUNTS,
    NU_INNER,
    NY,
    NY_INNER,
    REF_NAMES,
    SET_REF,
    VectorName,
    carried,
)
from gfm_runtime.states import READY, SAFE, STATES

ONE_CONVERTER = (
    "network: this takes one converter on its own grid; for a network, gfmhil run or"
    " gfmhil.run_network"
)


@dataclass
class Bench:
    """Everything that one run changes."""

    scenario: Scenario
    plant: Network  # in common with the other converters of a network, or of its part
    place: int  # the converter's index in it
    controller: Controller  # the controller, its first law at rest and RUNNING
    start: OperatingPoint
    # measurements of the current tick, shape (5,), or (11,) with an inner stage, p.u.; and the same
    # memory with the set-points of a plant controller after them, if there is one
    y: NDArray[np.float64]
    y_sent: NDArray[np.float64]
    # inputs of the current tick, shape (3,), or (4,) with an inner stage, p.u.
    u: NDArray[np.float64]
    columns: ColumnSet  # what its recording has
    # what computes u in place of the law; None for the law
    external: SteppedController | None = None
    trace: Trace = field(default_factory=no_trace)  # what the run replays
    before: int = 0  # ticks of the plant before tick 0, of a run that starts from a snapshot

    @property
    def signal_set(self) -> int:
        """What frames and recording carry, see ``Scenario.signal_set``."""
        return self.columns.signal_set

    def keep(self, plant: Network) -> None:
        """Remember this instant as the start, to which a reset goes back; ``plant`` is a copy of
        the plant, one for all converters."""
        c = self.controller
        self._plant = plant
        self._controller = tuple(map(copied, (c.ctl, c.laws, c.states, c.est)))
        self._asked = c.asked

    @property
    def wired(self) -> Wiring:
        """How the plant was connected at the start."""
        return self._plant.wiring

    def restore_plant(self, tick: int) -> None:
        """Put the plant and its grid back to their start at a tick, and clear the trip."""
        self.plant.restore(self._plant)
        self.plant.st["tick"] = tick + self.before
        self.u[:] = _commands(self.start, self.signal_set)

    def reset_controller(self) -> None:
        """Take the controller from SAFE to READY, with its first law and references.

        That of a converter in a network will begin with the voltage and frequency that it measures.
        Raises ValueError: it is not in SAFE.
        """
        c = self.controller
        state, changes, inner_tick = (
            int(c.ctl[name][0]) for name in ("state", "changes", "inner_tick")
        )
        if state != SAFE:
            raise ValueError(f"reset: the controller is {STATES[state]}, not SAFE")
        c.ctl[:], c.laws[:], c.states[:], c.est[:] = self._controller
        c.asked, c.gains = self._asked, {}
        c.ctl["state"], c.ctl["changes"], c.ctl["inner_tick"] = READY, changes, inner_tick
        c.ctl["joins"] = self.plant.net["joins"]
        c.ctl["aligns"] = self.signal_set == COUNTS
        self.u[:] = _commands(self.start, self.signal_set)


def _commands(start: OperatingPoint, signal_set: int) -> NDArray[np.float64]:
    """u at rest; without compare values, so that the plant's own modulator gives them until the
    controller does."""
    u = np.full(len(carried("u", signal_set)), -1.0)
    u[:NU_INNER] = start.commands[: len(u)]
    return u


def follow_trips(plant: Network) -> list[int]:
    """Do between two ticks what the trips of a network's converters ask for: the circuits without
    one that has tripped, and the new start of each that was reset and may start.

    Returns:
        The indices of those that have started.
    """
    take_out(plant)
    started = [int(k) for k in np.flatnonzero(plant.st["waits"] == MAY_START)]
    for k in started:
        start_again(plant, k)
    return started


def make_bench(scenario: Scenario, real: str = "float64", plant: Network | None = None) -> Bench:
    """Build both sides of a scenario of one converter at its operating point.

    Args:
        scenario: checked.
        real: float64 or float32, for the laws' arithmetic.
        plant: what ``plant_of`` makes of the scenario, if someone has made it already; the bench
            starts it.

    Raises:
        UserError: the law has no steady state on this grid, or the scenario has a network.
    """
    if scenario.parts:
        raise UserError(ONE_CONVERTER)
    (bench,) = make_benches(scenario, real, plant)
    return bench


def make_benches(
    scenario: Scenario, real: str = "float64", plant: Network | None = None
) -> list[Bench]:
    """Build both sides of a scenario at its operating point: a bench for each converter, with a
    controller of its own and one plant in common; as the controller of one of them sees it, the
    bench of that one. Arguments and errors as of ``make_bench``.
    """
    benches = unstarted_benches(scenario, real, plant)
    plant = benches[0].plant
    laws = [bench.controller.active_law for bench in benches]
    refs = [np.asarray(bench.scenario.references.vector()) for bench in benches]
    try:
        if scenario.network is None:
            grid = scenario.plant.grid
            starts = [operating_point(plant.par, laws[0], refs[0], grid.omega_g, grid.V_g)]
            rests, voltages = list[tuple[NDArray[np.float64], float]](), None
        else:
            starts, rests, voltages = operating_points(plant, laws, refs)
        for k, bench in enumerate(benches):
            for law in bench.controller.discrete:  # to which an event may change
                check_dc_side(plant.par[k : k + 1], law)
        x, u = (np.array([getattr(s, name) for s in starts]) for name in ("x", "commands"))
        plant.start(x, u, rests, voltages)
        begin_set_points(plant, np.stack(refs)[:, SET_REF])
    except NoEquilibrium as problem:
        where = "references, plant.grid" if scenario.network is None else "network"
        raise UserError(f"{where}: {problem}") from None
    plants = _plants(scenario, plant, x, u)
    for k, (bench, start) in enumerate(zip(benches, starts, strict=True)):
        bench.plant, kept, bench.place = plants[k]
        bench.start, controller = start, bench.controller
        if bench.signal_set:
            own = np.concatenate([start.y, start.x[: NY_INNER - NY]])
            angle = np.exp(1j * start.x[DELTA])
            rows = plant.without_current(k, controller.calibrations)
            controller.start(start.x_law, start.u, own, start.e, angle, rows)
        else:
            controller.start(start.x_law, start.u)
        bench.u[:] = _commands(start, bench.signal_set)
        bench.trace = trace_of(bench.scenario, bench.u)
        bench.keep(kept)
        gains_of(bench.scenario, controller.omega_b)
    if scenario.start_from is not None:
        start_from(scenario, benches)
    return [b for b in benches if scenario.converter in (None, b.scenario.converter)]


def _plants(
    scenario: Scenario, plant: Network, x: NDArray[np.float64], u: NDArray[np.float64]
) -> list[tuple[Network, Network, int]]:
    """Of each converter its plant, the one or with ``cores`` a part of it, a copy of that, and
    its place there. Raises UserError: the plant cannot be cut."""
    parts = [(plant, tuple(range(len(x))))]
    if scenario.cores is not None:
        try:
            faults = [e.acts_on() or "" for e in scenario.events if isinstance(e, Fault)]
            parts = cut(plant, x, u, faults)
        except ValueError as problem:
            raise UserError(f"cores = {scenario.cores}: {problem}") from None
    found = dict[int, tuple[Network, Network, int]]()
    for part, units in parts:
        kept = part.copy()
        found |= {k: (part, kept, place) for place, k in enumerate(units)}
    return [found[k] for k in range(len(x))]


def unstarted_benches(
    scenario: Scenario, real: str = "float64", plant: Network | None = None
) -> list[Bench]:
    """The benches of all converters before anyone knows the operating point: none can run, but the
    loops can be compiled for their records. Arguments as of ``make_bench``."""
    plant, nowhere, benches = plant or plant_of(scenario), cast(OperatingPoint, None), list[Bench]()
    vectors: tuple[VectorName, VectorName] = "y", "u"
    for k, one in enumerate([*scenario.each.values()] or [scenario]):
        controller = _controller(one, plant, real)
        columns = ColumnSet.of(scenario, k)
        controller.signal_set = columns.signal_set
        y, u = (np.zeros(len(carried(group, scenario.frame_signals))) for group in vectors)
        own = y[: len(carried("y", columns.signal_set))]
        benches.append(Bench(one, plant, k, controller, nowhere, own, y, u, columns))
    return benches


def _controller(scenario: Scenario, plant: Network, real: str) -> Controller:
    names, inner, counts = tuple(scenario.laws()), scenario.inner, scenario.counts
    files = [name for name in (*names, inner or "", counts or "") if name.endswith(".toml")]
    made = _ready(
        names, inner, counts, scenario.T_s, scenario.late_policy.hold, real, plant.wiring.omega_b,
        tuple(map(_text, files)),
    )  # fmt: skip
    return made.anew(scenario.references.vector())


@lru_cache(maxsize=16)
def _ready(
    names: tuple[str, ...],
    inner: str | None,
    counts: str | None,
    T_s: float,
    hold: int,
    real: str,
    omega_b: float,
    contents: tuple[str, ...],
) -> Controller:
    """A controller with these laws; runs that differ in something else need not make it again.

    Args:
        contents: of the files among names and inner stage.
    """
    titles = law_titles(names)
    sets = [replace(load_law(name, inner, counts), name=titles[name]) for name in names]
    return Controller(sets, T_s, [0.0] * len(REF_NAMES), hold, real, omega_b)


def _text(file: str) -> str:
    try:
        return Path(file).read_text(encoding="utf-8")
    except (OSError, ValueError):
        return ""  # load_law says what is wrong with it
