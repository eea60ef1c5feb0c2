"""What an external controller is to its process, and what those that are not ours share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.controllers.phases import Frame
from gfm_hil.controllers.ports import MODULATION, PortWiring, Vector
from gfm_hil.core.errors import UserError
from gfm_plant import Bases
from gfm_runtime.signals import NU_INNER, PLAIN, Y_V_D, Y_V_DC, Y_V_Q

if TYPE_CHECKING:
    from gfm_runtime.assembly import Controller
    from gfm_runtime.tustin import DiscreteLaw

    PackedLaw = tuple[DiscreteLaw, NDArray[Any]]  # and the record that the kernel takes

State = dict[str, NDArray[Any]]
_LONGEST = 64  # of a name, see gfm_hil.engine.handshake


@dataclass(frozen=True)
class BenchContext:
    """What a controller is connected to."""

    T_s: float = 1e-4  # sampling time of the run, s
    signal_set: int = PLAIN  # of y and u, see ``Scenario.signal_set``
    bases: Bases = field(default_factory=Bases)  # of the converter
    delay: float = 0.0  # from the sampling of y to the moment when u acts, in ticks


class ControllerError(Exception):
    """A controller fails while it runs; the message names it and says what it said."""


class ExternalController:
    """A controller that computes u in place of the process's own."""

    name: str  # what the run calls it: 1 to 64 printable ASCII characters
    real = "float64"  # float64 or float32, for the laws that the controller's process has beside it
    has_laws = False  # it runs the run's own laws, between which events may change
    gives_state = False  # it has ``state`` and ``restore``
    count = -1  # instructions of the law's step in the last tick; -1 where they are not counted

    def begin(self, controller: Controller, changed: Sequence[PackedLaw] = ()) -> None:
        """Get ready for a run; only one that runs its laws has something to do. Raises UserError: a
        program for the laws cannot be built, or does not start.

        Args:
            controller: at rest, with the laws, in the precision ``real``.
            changed: further laws, discretised and packed, that may come into its spare places.
        """

    def has(self, law: PackedLaw) -> bool:
        """Whether it can change to this law, discretised and packed."""
        return False

    def start(self, u: Vector) -> None:
        """Make it ready for tick 0, its outputs beginning at u, p.u., shape (3,) or (4,). Raises
        ControllerError: it refuses."""

    def tick(self, ref: Vector, y: Vector, u: Vector, changed: int = -1) -> None:
        """One tick: u[k] from the references (5,) and the measurements, p.u.; before it one that
        has our laws changes to that of the index ``changed``, or to none at -1. Raises
        ControllerError: it fails, or blocks the bridge."""

    def state(self) -> State:
        """What it remembers between two ticks. Raises ControllerError: it refuses."""
        raise NotImplementedError

    def restore(self, kept: State) -> None:
        """Go on, after ``start``, from what another of its kind remembered. Raises UserError: that
        was another controller; ControllerError: it refuses."""
        raise NotImplementedError

    def close(self) -> None:
        """End it, and remove what it left."""


class MappedController(ExternalController):
    """A controller whose ports a map wires to the signals, and which steps every so many ticks;
    each kind sets the wiring, the outputs' names, how many ticks and the frame of the phases."""

    _wiring: PortWiring
    _names: list[str]
    _every: int
    _frame: Frame
    _T_s: float
    _ticks = 0

    def start(self, u: Vector) -> None:
        self._ticks = self._before = 0
        self._frame.start(float(u[1]))
        phases = self._frame.phases(complex(u[2], u[3])) if self._wiring.bridge else ()
        self._u = np.concatenate((u, phases))

    def tick(self, ref: Vector, y: Vector, u: Vector, changed: int = -1) -> None:
        wiring = self._wiring
        if self._ticks == 0:
            self._watch(ref, y)
        if self._ticks % self._every == 0:
            outputs = self._step(wiring.inputs(self._known(ref, y)))
            for place, good in ((wiring.blocks, False), (wiring.enables, True)):
                if place >= 0 and bool(outputs[place]) is not good:
                    what = f"{self._names[place]} = {outputs[place]:g}"
                    raise ControllerError(f"{self.name}: blocks the bridge: {what}")
            wiring.take(outputs, self._u)
            if wiring.bridge == MODULATION:
                self._u[-3:] *= y[Y_V_DC]
        u[:] = self._u[: len(u)]
        if wiring.bridge:
            e = self._frame.acting(self._u[-3:], self._ticks)
            u[1:NU_INNER] = self._frame.speed, e.real, e.imag
        self._ticks += 1

    def state(self) -> State:
        counted = np.array([self._ticks, self._before])
        turned = np.array([self._frame.speed, self._frame.origin])
        return {"counted": counted, "turned": turned, "commanded": self._u.copy()}

    def restore(self, kept: State) -> None:
        counted, turned = np.zeros(2, np.int64), np.zeros(2)
        for name, into in (("counted", counted), ("turned", turned), ("commanded", self._u)):
            put_back(self.name, kept, name, into)
        self._ticks, self._before = map(int, counted)
        self._frame.speed, self._frame.origin = map(float, turned)

    @property
    def _time(self) -> float:
        """Since the controller's first step, s."""
        return (self._ticks + self._before) * self._T_s

    def _known(self, ref: Vector, y: Vector) -> Vector:
        phases = self._frame.measured(y, self._ticks).ravel() if self._wiring.phases else ()
        return np.concatenate((ref, y, (1.0,), phases))

    def _watch(self, ref: Vector, y: Vector) -> None:
        """Let it see, before tick 0, what is measured there: rising from zero, and then held."""
        wiring = self._wiring
        rising, held = (
            round(s / (self._T_s * self._every)) * self._every
            for s in (wiring.ramp_s, wiring.hold_s)
        )
        self._before = rising + held
        self._ticks = -self._before
        if wiring.angle is not None:
            now = self._frame.angle(self._ticks) + math.atan2(y[Y_V_Q], y[Y_V_D])
            self._frame.origin = wiring.angle - now
        steps = range(self._ticks, 0, self._every)
        for k in steps:
            self._ticks = k
            share = min(1.0, (k + self._before) / rising) if rising else 1.0
            known = self._known(ref, y) * (1.0 + (share - 1.0) * wiring.rises)
            known[len(ref) + len(y)] = share == 1.0
            if k == steps[0]:
                self._first(known)
            self._step(wiring.inputs(known))
        self._ticks = 0
        if not steps:
            self._first(self._known(ref, y))

    def _first(self, known: Vector) -> None:
        """Get ready for the first step, knowing references, measurements and phases."""

    def _step(self, inputs: Vector) -> Vector:
        raise NotImplementedError


def put_back(where: str, kept: State, name: str, into: NDArray[Any]) -> None:
    """Write what was kept under a name where it was. Raises UserError: it does not fit there."""
    found = kept.get(name)
    if found is None or (found.dtype, found.shape) != (into.dtype, into.shape):
        there = "nothing" if found is None else f"{found.dtype} {found.shape}"
        raise UserError(
            f"{where}: the snapshot has {there} for its {name}, and it has {into.dtype}"
            f" {into.shape}: it is of another controller or plant, or of another version"
        )
    into[...] = found


def refuse_source(text: str) -> None:
    """Check that a controller is no source. Raises UserError: it is; the message says how to
    compile it."""
    file = Path(text.partition(":")[2])
    if text.startswith(("c:", "dll:")) and file.suffix in (".c", ".h", ".cc", ".cpp"):
        raise UserError(
            f"controller {text}: is a source, not a library; compile it by cc -O2 -shared -fPIC "
            f'-I"$(gfmhil firmware include)" {file} -o {file.with_suffix(".so")} -lm, and name '
            f"{file.with_suffix('.so')}"
        )


def check_currents(text: str, signal_set: int) -> None:
    """Check that a run carries what a controller takes, see ``Scenario.signal_set``. Raises
    UserError: ``text`` is ``c:FILE``, and the run has no inner stage."""
    refuse_source(text)
    if text.startswith("c:") and not signal_set:
        raise UserError(
            f"controller {text}: measures currents, which only a run with an inner stage carries: "
            "choose --inner virtual-stator"
        )


def text_of(said: bytes | None) -> str:
    """What C code says, NULL for nothing."""
    return (said or b"").decode("utf-8", "replace").strip()


def run_name(kind: str, controller: str) -> str:
    """What a run calls a controller, from what the controller calls itself."""
    plain = "".join(c if " " <= c <= "~" else "?" for c in f"{kind} {controller}")
    return plain[:_LONGEST].strip()


def ticks_a_step(where: str, step_s: float, T_s: float) -> int:
    """How many ticks of T_s [s] pass between two steps of a controller. Raises UserError: its step
    is not a whole number of ticks."""
    ticks = round(step_s / T_s) if step_s > 0 else 0
    if ticks < 1 or abs(step_s - ticks * T_s) > 1e-6 * T_s:
        raise UserError(
            f"{where}: its step of {step_s:g} s must be a multiple of the run's T_s = {T_s:g} s"
        )
    return ticks
