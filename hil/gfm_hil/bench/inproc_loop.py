"""Time of the whole closed loop in one process, and of its parts.

The loop is that of ``gfmhil run --link inproc``, on a scenario's own records, from a step of P_ref
at tick 0. The parts are timed separately with the data of the whole run: the plant gets the
recorded u of every tick, the controller the y. The processor can overlap the ticks of a part alone,
but not of the closed loop, so the parts need not add up to the whole.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numba.core.runtime import _nrt_python  # type: ignore[attr-defined]
from numba.core.runtime.nrt import rtsys

from gfm_hil.bench.rounds import RUNS, ShowProgress, quickest, seconds, spread, take_turns
from gfm_hil.core.errors import UserError
from gfm_hil.engine.inproc import run_ticks, stack
from gfm_hil.engine.setup import make_bench
from gfm_hil.recording.parts import RolePart
from gfm_hil.recording.recorder import record_command, record_controller, record_sample
from gfm_hil.scenario import load_scenario
from gfm_plant import plant_advance, plant_sample
from gfm_runtime.compiled import compiled
from gfm_runtime.controller import control
from gfm_runtime.signals import NU, NY

# Laws whose defaults are stable on the paper's stiff grid; the last row adds the rig's noise,
# sensor filters, quantisation and delay.
LAWS = (
    "mimo-gfm", "mimo-gfm-scheduled", "vsg-2", "vsg-11", "droop-2", "droop-5", "psc-2",
    "matching-1", "hybrid-angle",
)  # fmt: skip
RIG = "mimo-gfm, rig"
_TICKS = 2_000  # of a short run


@compiled
def plant_alone(plant, y, u, us):
    """The plant under the recorded commands ``us`` (ticks, 3)."""
    for k in range(len(us)):
        for i in range(NU):
            u[i] = us[k, i]
        plant_sample(plant, 0, y)
        plant_advance(plant, u)


@compiled
def plants_half(plant, y, u, us, rows):
    """The tick of the plant's process without the link: the plant and its recording."""
    for k in range(len(us)):
        for i in range(NU):
            u[i] = us[k, i]
        plant_sample(plant, 0, y)
        record_sample(rows[k], y, plant, 0)
        record_command(rows[k], u)
        plant_advance(plant, u)


@compiled
def controller_alone(ctl, laws, states, est, y, u, ys):
    """The controller on the recorded measurements ``ys`` (ticks, 5)."""
    for k in range(len(ys)):
        for j in range(NY):
            y[j] = ys[k, j]
        control(ctl, laws, states, est, y, u)


@compiled
def recording_alone(plant, ctl, states, est, y, u, plant_rows, controller_rows):
    """Record the same tick into every row."""
    for k in range(len(plant_rows)):
        record_controller(controller_rows[k], ctl, states, est)
        record_sample(plant_rows[k], y, plant, 0)
        record_command(plant_rows[k], u)


class InprocLoop:
    """A bench that can be reset to its start, and files for its recording.

    What measures returns ns per tick.
    """

    def __init__(self, scenario: str, law: str, ticks: int, folder: Path) -> None:
        b = make_bench(load_scenario(scenario, law=law, in_process=True))
        b.controller.set("P_ref", 0.8)
        self.bench, self.ticks, self.T_s = b, ticks, b.scenario.T_s
        plant, controller = (
            RolePart.create(folder, role, ticks).signals for role in ("plant", "controller")
        )
        self._rows = plant, controller
        step = b.controller.ctl, b.controller.laws, b.controller.states, b.controller.est
        self._kept = [*b.plant.memory, *step, b.y, b.u]
        self._start = [a.copy() for a in self._kept]
        self.whole()
        y, u = np.split(plant[:, : NY + NU].copy(), [NY], axis=1)
        records, out = b.plant.records, (b.y, b.u)
        self._parts: dict[str, tuple[Callable[..., object], tuple[Any, ...]]] = {
            "plant": (plant_alone, (records, *out, u)),
            "controller": (controller_alone, (*step, *out, y)),
            "recording": (
                recording_alone, (records, step[0], *step[2:], *out, plant, controller)
            ),
            "plant's half": (plants_half, (records, *out, u)),
        }  # fmt: skip
        # as in a run, rows that were not written lately
        fresh = RolePart.create(folder / "long", "plant", RUNS * ticks).signals
        self._fresh = itertools.cycle(np.split(fresh, RUNS))

    def _reset(self) -> None:
        for array, start in zip(self._kept, self._start, strict=True):
            array[:] = start

    def whole(self, ticks: int | None = None) -> float:
        """The closed loop. Raises UserError: the run ended early, so that there is nothing to
        time."""
        self._reset()
        b, n = self.bench, ticks or self.ticks
        done, controllers = 0, stack([b])
        plant, controller = self._rows

        def run() -> None:
            nonlocal done
            done = run_ticks(b.plant.records, controllers, plant[None], controller[None], 0, n)

        time = seconds(run) / n * 1e9
        if done != n:
            raise UserError(f"{b.controller.active}: tripped or safe at tick {done - 1} of {n}")
        return time

    def part(self, name: str) -> float:
        """The plant, the controller or the recording alone, or the plant's half: the plant and its
        recording."""
        self._reset()
        work, arguments = self._parts[name]
        more = [next(self._fresh)] if work is plants_half else []
        return seconds(lambda: work(*arguments, *more)) / self.ticks * 1e9

    def allocations_per_tick(self) -> float:
        """Allocations of numba's runtime per tick; those per call cancel."""

        def allocations(ticks: int) -> int:
            before = rtsys.get_allocation_stats().alloc
            self.whole(ticks)
            return int(rtsys.get_allocation_stats().alloc - before)

        _nrt_python.memsys_enable_stats()
        short, long = allocations(self.ticks // 2), allocations(self.ticks)
        _nrt_python.memsys_disable_stats()
        return (long - short) / (self.ticks - self.ticks // 2)


def measure_laws(
    laws: Sequence[str], rounds: int, folder: Path, show: ShowProgress
) -> Iterator[dict[str, Any]]:
    """ns per tick of laws and of the rig, one row each; ``folder`` is for the recordings. Raises
    UserError: a run ended early, so that there is nothing to time."""
    runs = {name: ("pref_step", name) for name in laws or LAWS}
    runs[RIG] = ("rig_pref_step", "mimo-gfm")
    for k, (name, (scenario, law)) in enumerate(runs.items()):
        show(f"loop in process, {name}", k / len(runs))
        loop = InprocLoop(scenario, law, _TICKS, folder / name)
        parts: dict[str, Callable[[], float]] = {"whole": loop.whole}
        parts |= {n: partial(loop.part, n) for n in ("plant", "controller", "recording")}
        times = take_turns({n: partial(quickest, part) for n, part in parts.items()}, rounds)
        yield {
            "law": name,
            **{f"{part}_ns": spread(ns) for part, ns in times.items()},
            "times_real_time": spread([loop.T_s * 1e9 / ns for ns in times["whole"]]),
            "allocations_per_tick": loop.allocations_per_tick(),
        }
