"""From named laws to the records that ``control`` runs on."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from gfm_runtime.catalogue import LawSet
from gfm_runtime.controller import MAX_STAGES, control, make_controller, set_reference
from gfm_runtime.counts import begin_counts, calibrate_with
from gfm_runtime.errors import LawError
from gfm_runtime.impedance import make_impedance
from gfm_runtime.inner import settle
from gfm_runtime.inner_tick import inner_tick
from gfm_runtime.kernel import pack_law, state_dtype
from gfm_runtime.signals import COUNTS, INNER, PLAIN, REF_NAMES
from gfm_runtime.states import BAD_SENSOR, OK, READY, RUNNING, SAFE, STATES
from gfm_runtime.tustin import DiscreteLaw, discretise

SPARE = 2  # places for laws with other gains: one may be in force while the other is filled
NO_END = 10.0  # p.u.; up to which a schedule's last stage is in force


def copied(records: NDArray[Any]) -> NDArray[Any]:
    """A copy of records without gaps between them; as bytes, since numpy takes 50 us to copy laws
    by their fields."""
    own = np.ndarray(records.nbytes, np.uint8, records).copy()
    return np.ndarray(records.shape, records.dtype, own)


def _nothing() -> None:
    """Of laws that no other controller shares."""


class Controller:
    """A controller with several laws ready, one of them active.

    The records ``ctl``, ``laws``, ``states`` and ``est`` hold all that a tick needs, and are the
    arguments of ``gfm_runtime.controller.control``.

    ``asked`` is what the law that was requested last is asked for by, and ``gains`` are its gains
    that differ from its file. ``names`` and ``changed`` are the same for every entry of ``laws``;
    ``labels`` are their names in reports, ``titles`` those of ``sets``. ``inner`` says what y and u
    have besides, whichever law is active: ``PLAIN`` nothing, ``INNER`` the signals of an inner
    stage, ``COUNTS`` also those of laws that measure and modulate.

    Args:
        sets: the laws that may become active, each asked for by its ``asked``; the first starts.
        T_s: sampling time, s.
        references: Y_ref at the start, shape (5,), p.u.
        hold: ticks in a row without a fresh measurement before the safe state.
        real: float64 or float32 for the laws' arithmetic.
        omega_b: base frequency of the converter, rad/s, for the estimate of the grid's reactance.

    Raises:
        LawError: a law that does not discretise at T_s, or some of the laws, but not all, measure
            and modulate.
    """

    def __init__(
        self,
        sets: Sequence[LawSet],
        T_s: float,
        references: Sequence[float],
        hold: int = 0,
        real: DTypeLike = np.float64,
        omega_b: float = 100 * math.pi,
    ) -> None:
        self.T_s, self.omega_b = T_s, omega_b
        self.sets = {s.asked or s.name: s for s in sets}
        self.titles = {asked: s.name for asked, s in self.sets.items()}
        self.asked, self.gains = "", dict[str, float]()
        self.discrete: list[DiscreteLaw] = []
        self.labels: list[str] = []
        self.names: list[str] = []
        self._first: dict[str, int] = {}
        for asked, s in self.sets.items():
            self._first[asked] = len(self.discrete)
            self.discrete += [discretise(law, T_s) for law in s.laws]
            self.names += [asked] * len(s.laws)
            if (count := len(s.laws)) > MAX_STAGES:
                why = f"{count} stages; the controller holds {MAX_STAGES}"
                raise LawError(f"law {s.name}", why)
            self.labels += [s.name] if count == 1 else [f"{s.name}[{k}]" for k in range(count)]
        self.discrete += [self.discrete[0]] * SPARE
        self.names += [next(iter(self.sets))] * SPARE
        self.changed: list[dict[str, float]] = [{} for _ in self.discrete]
        self.labels += [f"other gains {k + 1}" for k in range(SPARE)]
        self.laws = np.concatenate([pack_law(d, real, omega_b) for d in self.discrete])
        #: called before ``laws`` change, which other controllers may share
        self.before_retuning: Callable[[], None] = _nothing
        self.states = np.zeros(len(self.laws), state_dtype(real))
        self.signal_set = INNER if any(d.law.inner is not None for d in self.discrete) else PLAIN
        counts = [d.law.counts is not None for d in self.discrete]
        if all(counts):
            self.signal_set = COUNTS
        elif any(counts):
            without = self.labels[counts.index(False)]
            why = "has no [measure] and [modulate], which others have; give the scenario counts"
            raise LawError(f"law {without}", why)
        self.ctl = make_controller(hold)
        self.ctl["ref"] = self.ctl["ref_target"] = np.asarray(references, dtype=float)
        self.est = make_impedance(T_s, 1.0, omega_b)
        self.select(next(iter(self.sets)))
        self.ctl["active"], self.ctl["request"] = self.ctl["request"], -1
        self.ctl["state"] = READY

    def anew(self, references: Sequence[float]) -> Controller:
        """Another controller with the same laws, which starts from other references, shape (5,),
        p.u.; it shares with this one what neither changes."""
        other = copy(self)
        other.labels, other.names = list(self.labels), list(self.names)
        other.discrete, other.changed = list(self.discrete), [dict(one) for one in self.changed]
        other.laws, other.states = copied(self.laws), copied(self.states)
        other.before_retuning = _nothing
        other.ctl, other.est = copied(self.ctl), copied(self.est)
        other.ctl["ref"] = other.ctl["ref_target"] = np.asarray(references, dtype=float)
        return other

    @property
    def active(self) -> str:
        """Label of the active law; of a scheduled one with its stage."""
        return self.labels[int(self.ctl["active"][0])]

    @property
    def active_law(self) -> DiscreteLaw:
        """The active law itself."""
        return self.discrete[int(self.ctl["active"][0])]

    def select(self, name: str) -> None:
        """Request a law; the controller changes to it at the next tick, bumpless. Raises LawError:
        the law is not one of ``sets``."""
        if name not in self.sets:
            raise LawError(f"law {name!r}", f"not ready; ready are {list(self.sets)}")
        self.asked, self.gains = name, {}
        first, schedule = self._first[name], self.sets[name].schedule
        self.ctl["request"], self.ctl["stages"] = first, 0
        if schedule is not None:
            n = len(schedule.stages)
            ends = np.array([*schedule.ends[:-1], NO_END])
            self.ctl["stages"] = n
            self.ctl["stage_law"][0, :n] = range(first, first + n)
            self.ctl["by_V"] = schedule.by_V
            self.ctl["above"][0, :n] = ends * (1 + schedule.hysteresis)
            self.ctl["below"][0, :n] = ends * (1 - schedule.hysteresis)
            self.ctl["since"] = 0
            self.ctl["dwell"] = round(schedule.dwell_s / self.T_s)
            if schedule.X_0 is not None:
                self.est[:] = make_impedance(self.T_s, schedule.X_0, self.omega_b, schedule.X_f)
            self.ctl["request"] = first + schedule.start

    def retune(self, discrete: DiscreteLaw, packed: NDArray[Any], gains: dict[str, float]) -> int:
        """Request the law that was requested last with other gains; bumpless, at the next tick.

        Args:
            discrete, packed: that law discretised and as ``pack_law`` gives it.
            gains: those that differ from its file, by name.

        Returns:
            Its index from now on.
        """
        slot = len(self.laws) - SPARE
        slot += int(self.ctl["active"][0]) == slot
        self.before_retuning()
        self.laws[slot], self.discrete[slot] = packed[0], discrete
        self.names[slot], self.changed[slot] = self.asked, dict(gains)
        self.ctl["request"], self.gains = slot, dict(gains)
        return slot

    def set(self, name: str, value: float, ramp_s: float = 0.0) -> None:
        """New reference by name, p.u., reached at once or evenly over ``ramp_s``."""
        j = REF_NAMES.index(name)
        away = value - float(self.ctl["ref"][0, j])
        set_reference(self.ctl, j, value, abs(away) * self.T_s / ramp_s if ramp_s > 0 else 0.0)

    def start(
        self,
        x_law: NDArray[Any],
        u: NDArray[Any],
        y: NDArray[Any] | None = None,
        e: complex | None = None,
        angle: complex = 1.0,
        rows: NDArray[Any] | None = None,
    ) -> None:
        """Go from READY to RUNNING, at rest.

        Args:
            x_law, u: the active law's state (n,) and output (3,), p.u.
            y, e: with an inner stage: measurements (11,) and the bridge's voltage e_d + j e_q, p.u.
            angle: for a law that measures itself: the unit phasor of its frame.
            rows: likewise, counts without current, (``calibrations``, 10), by which it calibrates.
                An offset that is too large leads to SAFE.

        Raises:
            LawError: the controller is not READY; SAFE is latched until ``reset``.
        """
        state = int(self.ctl["state"][0])
        if state != READY:
            raise LawError("controller", f"is {STATES[state]}; only READY can start, see reset()")
        k = int(self.ctl["active"][0])
        self.states[k] = np.zeros((), self.states.dtype)
        self.states["x"][k, : len(x_law)] = x_law
        self.states["u"][k], self.states["ref"][k] = u, self.ctl["ref"][0]
        self.ctl["u"] = u
        if y is not None and e is not None:
            settle(self.laws[k : k + 1], self.states[k : k + 1], np.asarray(u), y, e.real, e.imag)
            self.ctl["out"] = [u[0], u[1], e.real, e.imag]
            begin_counts(self.states[k], y, angle)
        self.ctl["state"] = RUNNING
        if rows is not None and len(rows):
            suspect = calibrate_with(self.laws, self.states, k, rows)
            if suspect >= 0:
                self.ctl["state"], self.ctl["reason"] = SAFE, BAD_SENSOR
                self.ctl["channel"] = suspect

    def find_inner_tick(self) -> None:
        """Compile, or load, what `control` calls of laws with an inner stage, if there are any;
        before the first tick in this process."""
        if self.signal_set:
            self.ctl["inner_tick"] = inner_tick(self.laws.dtype, self.states.dtype)

    @property
    def calibrations(self) -> int:
        """How many counts without current the active law takes at its start."""
        return int(self.laws["calibrate"][self.ctl["active"][0]])

    def reset(self) -> None:
        """Re-arm: go from SAFE or STOPPED to READY, clear the reason, and keep the laws."""
        self.ctl["state"], self.ctl["reason"], self.ctl["channel"] = READY, OK, 0
        self.ctl["stale"] = 0

    def step(self, y: NDArray[np.float64], u: NDArray[np.float64]) -> None:
        """One tick from Python: y (5,) in, u (3,) in and out, p.u.; (11,) and (4,) with an inner
        stage, (21,) and (7,) with counts."""
        if not self.ctl["inner_tick"][0]:
            self.find_inner_tick()
        y = np.ascontiguousarray(y, np.float64)
        control(self.ctl, self.laws, self.states, self.est, y, u)
