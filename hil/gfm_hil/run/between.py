"""What a switched bridge does between the ticks of a run: the run again, with a look at every edge.

A recording has one row a tick. In a window the run is repeated in this process: before each tick
the plant is copied, and afterwards the copy goes through the tick in pieces of a microsecond and
less (`gfm_plant.between`). The run itself is not touched, so that its true currents have to be
those of the recording, to the bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import OUR_CONTROLLER
from gfm_hil.engine.inproc import run_inproc
from gfm_hil.engine.setup import Bench, make_bench
from gfm_hil.engine.timeline import TimelineInMemory
from gfm_hil.recording.columns import PHASES, WAVES, wave
from gfm_hil.recording.parts import MemoryPart
from gfm_hil.recording.run import Run, bases
from gfm_hil.scenario import Scenario
from gfm_plant import Bases, Network, plant_command, plant_is_delayed
from gfm_plant.between import N_SEEN, watch_period
from gfm_plant.bridge import TOPOLOGIES

_SAME = ("true_i_re", "true_i_im")  # columns that tell whether a run was repeated
_LONGEST = 2.0  # s of a window
_FINEST = 1e-8  # s
_NO_CURRENT = 1e-10  # p.u.; a leg with less has none


@dataclass(frozen=True)
class BetweenTicks:
    """A window of a run between the ticks, piece by piece.

    Attributes:
        t: where each piece begins, and last where the window ends, (n + 1,), s.
        columns: by name, (n + 1,) each: ``v_dc`` and, of a bridge of three levels, ``mid``, by
            which the upper half of C_dc has more than the lower one, p.u. of V_dcref; ``i_a`` … of
            L_f, ``v_a`` … of C_f and ``i_oa`` … of the line, p.u. of a phase's nominal peak value.
        legs: voltages of the legs against the middle of v_dc in each piece, (n, 3), p.u. of
            V_dcref.
        ways: rail and device by which the current of each leg flows in each piece, (n, 3), places
            in ``WAYS``.
        bases: of the converter.
        C_dc: the DC capacitor, p.u.
        T_s: the sampling time, s.
        step: the longest time between two points, s.
    """

    t: NDArray[np.float64]
    columns: dict[str, NDArray[np.float64]]
    legs: NDArray[np.float64]
    ways: NDArray[np.int8]
    bases: Bases
    C_dc: float
    T_s: float
    step: float

    if TYPE_CHECKING:  # functions of other modules, which ``gfm_hil.api.runs`` adds
        spectrum: ClassVar[Callable[..., Any]]
        losses: ClassVar[Callable[..., Any]]
        plot: ClassVar[Callable[..., Any]]

    def capacitor_current(self) -> NDArray[np.float64]:
        """The mean current of the upper half of C_dc in each piece, positive where it charges,
        (n,), p.u. of S_n/V_dcref; that of both halves is the same with two levels."""
        v = self.columns["v_dc"] + self.columns.get("mid", 0.0)
        return np.diff(v) / np.diff(self.t) * (self.C_dc / self.bases.omega_b)

    def capacitor_rms(self) -> float:
        """RMS of that current over the window, p.u. of S_n/V_dcref."""
        h, i = np.diff(self.t), self.capacitor_current()
        return math.sqrt(float(np.sum(h * i**2) / np.sum(h)))

    def ripple(self, name: str) -> float:
        """The largest distance, from peak to peak in any tick, of a column from the straight line
        between the values at the ticks around it; in the unit of the column."""
        x = self.columns[name]
        tick = np.floor(self.t / self.T_s + 1e-6).astype(int)
        at = np.flatnonzero(np.diff(tick, prepend=tick[0] - 1))
        away = x - np.interp(self.t, self.t[at], x[at])
        high, low = np.maximum.reduceat(away, at), np.minimum.reduceat(away, at)
        return float((high - low)[:-1].max(initial=0.0))

    def table(self, si: bool = False) -> dict[str, NDArray[np.float64]]:
        """All of it by name, (n,) each: t in s, the columns, ``u_a`` … of the legs and ``i_C``, the
        capacitor's mean in each piece; in V and A under names such as u_a_V if ``si``."""
        b = self.bases
        units = {"V": b.V_peak, "A": b.I_peak}
        dc = ("V", b.V_dcref)
        kinds = {wave(w, p, False): (u, units[u]) for w, u in WAVES.items() for p in PHASES}
        kinds |= {"v_dc": dc, "mid": dc, "i_C": ("A", b.S_n / b.V_dcref)}
        kinds |= {f"u_{p}": dc for p in PHASES}
        rows = {name: x[:-1] for name, x in self.columns.items()}
        rows |= {f"u_{p}": self.legs[:, k] for k, p in enumerate(PHASES)}
        rows["i_C"] = self.capacitor_current()
        named = {
            f"{name}_{kinds[name][0]}" if si else name: x * kinds[name][1] if si else x
            for name, x in rows.items()
        }
        return {"t": self.t[:-1], **named}


#: by which rail and which device a current may flow
WAYS = tuple(sorted({way for one in TOPOLOGIES.values() for ways in one.conducts for way in ways}))


class _Watcher:
    """Follows the timeline of a run, and goes through the ticks of a window once more."""

    running = False
    _kept: Network | None = None

    def __init__(self, bench: Bench, first: int, last: int, steps: int) -> None:
        self._bench, self._first, self._last, self._steps = bench, first, last, steps
        self._seen = np.empty((4 * steps + 100, N_SEEN))
        self._gates = np.empty((len(self._seen), 3), np.int64)
        self.pieces: list[tuple[NDArray[np.float64], NDArray[np.int64]]] = []

    def next_tick(self) -> int:
        return self._first

    def carry_out(self, tick: int) -> None:
        if self._first <= tick < self._last:
            self._kept = self._bench.plant.copy()
            self._first = tick + 1

    def look(self, tick: int) -> None:
        """Go through the tick that has just been done, from the copy of its beginning on."""
        if self._kept is None:
            return
        plant, after = self._bench.plant, self._bench.plant.copy()
        plant.restore(self._kept)
        self._kept = None
        if not plant_is_delayed(plant.records):
            plant_command(plant.records, 0, self._bench.u)
        done = watch_period(plant.records, self._steps, self._seen, self._gates)
        seen = self._seen[: done + 1].copy()
        seen[:, 0] += tick * self._bench.scenario.T_s
        self.pieces.append((seen, self._gates[:done].astype(np.int64)))
        plant.restore(after)

    def checked(self, *_: object) -> None: ...

    def end(self, *_: object) -> None: ...

    def finish(self, *_: object) -> None: ...


def between_ticks(
    run: Run, scenario: Scenario, start: float, stop: float, step: float = 1e-6
) -> BetweenTicks:
    """Repeat a run, and return a window of it between the ticks.

    Args:
        run: of one converter with a switched bridge.
        scenario: what the run repeats, in process.
        start, stop: from when to when, s, whole ticks.
        step: the longest time between two points, s.

    Raises:
        UserError: the bridge is averaged, the window is none, the controller is not ours, or the
            run cannot be repeated, as one in real time with misses.
    """
    T_s = scenario.T_s
    first, last = round(start / T_s), round(stop / T_s)
    where = f"window {start:g}:{stop:g}"
    if run.scenario.plant.bridge.kind == "average":
        raise UserError(
            "plant.bridge.kind = 'average': has nothing between the ticks; must be 'two-level' or"
            " 't-type'"
        )
    if not 0 <= first < last <= run.ticks or stop - start > _LONGEST:
        raise UserError(
            f"{where}: must lie within the run, 0 to {run.ticks * T_s:g} s, and last a tick to"
            f" {_LONGEST:g} s"
        )
    if not _FINEST <= step <= T_s:
        raise UserError(f"step = {step:g}: must lie in [{_FINEST:g}, {T_s:g}] s")
    if run.summary.get("controller", OUR_CONTROLLER) != OUR_CONTROLLER:
        raise UserError(f"controller = {run.summary['controller']!r}: only runs of a law repeat")
    bench = make_bench(scenario)
    what = scenario.ticks, bench.columns
    plant, controller = (
        MemoryPart("plant", *what, only=_SAME),
        MemoryPart("controller", *what, only=()),
    )
    watcher = _Watcher(bench, first, last, max(1, math.ceil(T_s / step - 1e-9)))
    timeline = TimelineInMemory(bench)
    timelines: list[TimelineInMemory] = [timeline, watcher]  # type: ignore[list-item]
    with np.errstate(all="ignore"):  # a diverging run is a result
        done = run_inproc([bench], [plant], [controller], timelines, lambda k: k < last)
    timeline.close()
    for name, x in plant.by_name(min(done, last)).items():
        if len(x) < last or not np.array_equal(x, run.columns[name][:last]):
            raise UserError(f"{where}: {name} differs when the run is repeated in lockstep")
    return _join(watcher.pieces, bench, bases(scenario), T_s, step)


def _join(
    pieces: list[tuple[NDArray[np.float64], NDArray[np.int64]]],
    bench: Bench, b: Bases, T_s: float, step: float,
) -> BetweenTicks:  # fmt: skip
    """The pieces of all ticks, one after the other."""
    rows = np.concatenate([seen[:-1] for seen, _ in pieces] + [pieces[-1][0][-1:]])
    gates = np.concatenate([gates for _, gates in pieces])
    names = [wave(name, phase, False) for name in ("i", "v", "i_o") for phase in PHASES]
    columns = dict(zip(["v_dc", "mid", *names], rows[:, 1:].T, strict=True))
    r = bench.plant.par[0]
    kind = bench.scenario.plant.bridge.kind
    legs, ways = _legs(rows, gates, r, kind)
    if kind == "two-level":
        del columns["mid"]
    return BetweenTicks(rows[:, 0], columns, legs, ways, b, float(r["C_dc"]), T_s, step)


def _legs(
    rows: NDArray[np.float64], gates: NDArray[np.int64], r: np.void, kind: str
) -> tuple[NDArray[np.float64], NDArray[np.int8]]:
    """``legs`` and ``ways`` of `BetweenTicks`."""
    v_dc, mid, per_v = rows[:-1, 1:2], rows[:-1, 2:3], 1.5 * r["leg"]
    i, v = (rows[:-1, 3:6] + rows[1:, 3:6]) / 2, rows[:-1, 6:9] / per_v
    side = (i < 0).astype(int)
    band = r["band"][gates, side]
    legs = band[..., 0] * v_dc + band[..., 1] * mid + band[..., 2] - band[..., 3] * i / per_v
    conducts = TOPOLOGIES[kind].conducts
    places = np.array([[WAYS.index(way) for way in ways] for ways in conducts], np.int8)
    still = (r["wide"][gates] != 0) & (np.abs(i) < _NO_CURRENT)
    alone = still.sum(axis=1) == 1
    others = np.where(still, 0.0, legs - v)
    # a leg without current has the voltage at its end of the filter
    star = np.where(alone, others.sum(axis=1) / 2, v_dc[:, 0] / 2)[:, None]
    legs = np.where(still, star + v, legs) - v_dc / 2
    return legs, places[gates, side]
