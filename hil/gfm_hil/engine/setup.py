"""A scenario made ready: the plant's and the controller's records at the operating point.

Both sides build the same bench from the same scenario, possibly on two machines, so that only
frames have to cross the link.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.operating_point import OperatingPoint, operating_point
from gfm_hil.core.errors import UserError
from gfm_hil.engine.retune import retuned
from gfm_hil.scenario.events import Gains, LawChange, Reset
from gfm_hil.scenario.model import Scenario
from gfm_plant import Network, NoEquilibrium, make_plant
from gfm_runtime import load_law
from gfm_runtime.assembly import Controller
from gfm_runtime.signals import NY, NY_INNER, carried
from gfm_runtime.states import READY, SAFE, STATES


@dataclass
class Bench:
    """Everything that one run changes.

    Attributes:
        plant: the plant.
        controller: the controller, its first law at rest and RUNNING.
        y: measurements of the current tick, shape (5,), or (11,) with an inner stage, p.u.
        u: inputs of the current tick, shape (3,), or (4,) with an inner stage, p.u.
    """

    scenario: Scenario
    plant: Network
    controller: Controller
    start: OperatingPoint
    y: NDArray[np.float64]
    u: NDArray[np.float64]

    @property
    def inner(self) -> bool:
        """Whether frames and recording carry the signals of an inner stage."""
        return self.controller.inner

    def keep(self) -> None:
        """Remember this instant as the start, to which a reset goes back."""
        c = self.controller
        self._plant = self.plant.copy()
        self._controller = c.ctl.copy(), c.laws.copy(), c.states.copy(), c.est.copy()
        self._asked = c.asked

    def restore_plant(self, tick: int) -> None:
        """Put the plant and its grid back to their start at a tick, and clear the trip."""
        self.plant.restore(self._plant)
        self.plant.st["tick"], self.u[:] = tick, self.start.commands[: len(self.u)]

    def reset_controller(self) -> None:
        """Take the controller from SAFE to READY, with its first law and references.

        Raises:
            ValueError: it is not in SAFE.
        """
        c = self.controller
        state, changes = int(c.ctl["state"][0]), int(c.ctl["changes"][0])
        if state != SAFE:
            raise ValueError(f"reset: the controller is {STATES[state]}, not SAFE")
        c.ctl[:], c.laws[:], c.states[:], c.est[:] = self._controller
        c.asked, c.gains = self._asked, {}
        c.ctl["state"], c.ctl["changes"] = READY, changes
        self.u[:] = self.start.commands[: len(self.u)]


def make_bench(scenario: Scenario) -> Bench:
    """Build both sides of a scenario at its operating point.

    Raises:
        UserError: the law has no steady state on this grid.
    """
    options = scenario.plant
    if scenario.seed:
        options = options.model_copy(
            update={"sensors": options.sensors.model_copy(update={"seed": scenario.seed})}
        )
    plant = make_plant(options, scenario.T_s)
    references = scenario.references.vector()
    # under the name that events use: the name inside a law file may differ
    sets = [replace(load_law(name, scenario.inner), name=name) for name in scenario.laws()]
    controller = Controller(
        sets,
        scenario.T_s,
        references,
        hold=scenario.late_policy.hold,
        omega_b=float(plant.par[0]["omega_b"]),
    )
    try:
        start = operating_point(
            plant.par,
            controller.active_law,
            np.asarray(references),
            scenario.plant.grid.omega_g,
            scenario.plant.grid.V_g,
        )
    except NoEquilibrium as problem:
        raise UserError(f"references, plant.grid: {problem}") from None
    plant.start(start.x, start.commands)
    y = np.zeros(len(carried("y", controller.inner)))
    if controller.inner:
        y[:NY], y[NY:] = start.y, start.x[: NY_INNER - NY]
        controller.start(start.x_law, start.u, y, start.e)
    else:
        controller.start(start.x_law, start.u)
    u = start.commands[: len(carried("u", controller.inner))].copy()
    bench = Bench(scenario, plant, controller, start, np.zeros(len(y)), u)
    bench.keep()
    _ready_gains(scenario)
    return bench


def _ready_gains(scenario: Scenario) -> None:
    """Prepare every change of gains that the scenario names before it runs.

    Raises:
        UserError: a change that is not possible.
    """
    name, gains = scenario.law, dict[str, float]()
    for event in scenario.sorted_events():
        if isinstance(event, LawChange):
            name, gains = event.law, {}
        elif isinstance(event, Reset):
            name, gains = scenario.law, {}
        elif isinstance(event, Gains):
            gains.update(event.values)
            try:
                retuned(name, tuple(sorted(gains.items())), scenario.T_s, scenario.inner)
            except ValueError as problem:
                raise UserError(f"events, {event.label()}: {problem}") from None
