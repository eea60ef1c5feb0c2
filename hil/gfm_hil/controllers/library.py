"""A controller in a shared library with the interface of ``gfmhil_controller.h``.

It measures and commands three-phase voltages and currents in V and A, as firmware does; ``phases``
turns them into the plant's frame and out of it. In a run with counts it gets those of the A/D and
gives compare counts, which have no frame.
"""

import ctypes as c
import math
from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.controllers.external import (
    BenchContext,
    ControllerError,
    ExternalController,
    check_currents,
    run_name,
    text_of,
    ticks_a_step,
)
from gfm_hil.controllers.phases import MEASURED, Frame
from gfm_hil.controllers.ports import PortMap, Vector
from gfm_hil.core.errors import UserError
from gfm_runtime.signals import COUNTS, N_ADC, N_LEGS, NU_INNER, Y_V_DC, names

VERSION = 1
_NEEDED = ("version", "name", "new", "start", "free")
_Phases = c.c_double * 3
_Adc, _Compare = c.c_uint16 * N_ADC, c.c_uint16 * N_LEGS


class _Setup(c.Structure):
    _fields_ = tuple(
        (name, c.c_double) for name in ("period", "delay", "S_n", "V_n", "omega_n", "V_dcref")
    )


class _ControllerInput(c.Structure):
    _fields_ = (
        ("t", c.c_double), ("v", _Phases), ("i", _Phases), ("i_o", _Phases),
        *((name, c.c_double) for name in
          ("v_dc", "P_ref", "Q_ref", "V_ref", "omega_ref", "V_dc_ref")),
    )  # fmt: skip


class _ControllerOutput(c.Structure):
    _fields_ = (("e", _Phases), ("i_dc", c.c_double))


class LibraryController(ExternalController):
    """A controller in a shared library. Raises UserError: it cannot be loaded, has not the
    interface or another version of it, refuses this bench, or the run does not carry the currents.

    Args:
        path: of the library.
        ports: of the map only ``step_s``, the time between two calls, s.
        context: what it is connected to.
    """

    def __init__(self, path: Path, ports: PortMap, context: BenchContext) -> None:
        if beyond := sorted(ports.model_fields_set - {"step_s"}):
            raise UserError(
                f"{path.name}: {', '.join(beyond)} in its map: of a map it takes step_s only; its"
                " ports are fixed"
            )
        check_currents(f"c:{path.name}", context.signal_set)
        self._of = _load(path)
        self.name = run_name("c", text_of(self._of.gfmhil_name()) or path.stem)
        self._context, self._counts = context, context.signal_set == COUNTS
        _check_step(self._of, path, self._counts)
        self._every = ticks_a_step(path.name, ports.step_s or context.T_s, context.T_s)
        bases, self._frame = context.bases, Frame(context, self._every)
        self._dc_A = bases.S_n / bases.V_dcref
        setup = _Setup(
            self._every * context.T_s, self._frame.delay * context.T_s,
            bases.S_n, bases.V_n, bases.omega_b, bases.V_dcref,
        )  # fmt: skip
        self._self = self._of.gfmhil_new(c.byref(setup))
        if not self._self:
            offered = ", ".join(f"{key} {getattr(setup, key):.6g}" for key, *_ in _Setup._fields_)
            raise UserError(
                f"{path.name}: {self.name} refuses this bench: gfmhil_new gave NULL; offered were"
                f" {offered} (SI units; step_s in the map file sets the period)"
            )
        self._in, self._out = _ControllerInput(), _ControllerOutput()
        self._adc, self._compare = _Adc(), _Compare()
        self._ticks = 0
        self._ref = {name: k for k, name in enumerate(names("ref"))}

    def start(self, u: Vector) -> None:
        # the library starts at the first tick, with measurements
        self._ticks = 0
        self._frame.start(float(u[1]))
        self._rests = u[:NU_INNER].copy()
        # the output begins at what the plant rests under
        self._out.e[:] = self._frame.phases(complex(u[2], u[3])) * self._frame.peak_V
        self._out.i_dc = float(u[0]) * self._dc_A

    def tick(self, ref: Vector, y: Vector, u: Vector, changed: int = -1) -> None:
        if self._ticks % self._every == 0:
            self._measure(ref, y)
            if self._ticks == 0:
                self._call("gfmhil_start", self._in, self._out)
            if self._counts:
                self._adc[:] = [int(count) for count in y[-N_ADC:]]
                self._call("gfmhil_isr", self._in, self._adc, self._out, self._compare)
            else:
                self._call("gfmhil_step", self._in, self._out)
        if self._counts:
            u[:NU_INNER], u[NU_INNER:] = self._rests, self._compare
            u[0] = self._out.i_dc / self._dc_A
        else:
            e = self._frame.acting(np.array(self._out.e) / self._frame.peak_V, self._ticks)
            u[:] = self._out.i_dc / self._dc_A, self._frame.speed, e.real, e.imag
        self._ticks += 1

    def close(self) -> None:
        self._of.gfmhil_free(self._self)

    def _measure(self, ref: Vector, y: Vector) -> None:
        bases = self._context.bases
        self._in.t = self._ticks * self._context.T_s
        if not self._counts:
            measured = self._frame.measured(y, self._ticks)
            for name, phases in zip(MEASURED, measured, strict=True):
                base = self._frame.peak_V if name == "v" else self._frame.peak_A
                getattr(self._in, name)[:] = phases * base
            self._in.v_dc = y[Y_V_DC] * bases.V_dcref
        for field, name, base in (
            ("P_ref", "P_ref", bases.S_n),
            ("Q_ref", "Q_ref", bases.S_n),
            ("V_ref", "V_ref", bases.V_n),
            ("omega_ref", "omega_g", bases.omega_b),
            ("V_dc_ref", "V_dcref", bases.V_dcref),
        ):
            setattr(self._in, field, ref[self._ref[name]] * base)

    def _call(self, name: str, *arguments: Any) -> None:
        number = getattr(self._of, name)(self._self, *map(c.byref, arguments))
        if number:
            said = None
            if hasattr(self._of, "gfmhil_fault"):
                self._of.gfmhil_fault.restype = c.c_char_p
                said = self._of.gfmhil_fault(c.c_void_p(self._self), c.c_int(number))
            words = text_of(said) or "it does not say what it is"
            raise ControllerError(f"{self.name}: blocks the bridge: fault {number}, {words}")
        given = {**{f"e[{k}]": e for k, e in enumerate(self._out.e)}, "i_dc": self._out.i_dc}
        for field, value in given.items():
            if not math.isfinite(value):
                raise ControllerError(
                    f"{self.name}: out->{field} = {value} at t = {self._in.t:g} s"
                )


def _check_step(of: c.CDLL, path: Path, counts: bool) -> None:
    if counts and not hasattr(of, "gfmhil_isr"):
        raise UserError(
            f"{path}: has no function gfmhil_isr, and the scenario's laws read counts of an A/D: "
            "write it, see gfmhil_controller.h, or set counts = 'none'"
        )
    if not counts and not hasattr(of, "gfmhil_step"):
        other = "; for its gfmhil_isr set counts = 'rig'" if hasattr(of, "gfmhil_isr") else ""
        raise UserError(f"{path}: has no function gfmhil_step; see gfmhil_controller.h{other}")


def _load(path: Path) -> c.CDLL:
    try:
        of = c.CDLL(str(path))
    except OSError as problem:
        raise UserError(f"{path}: cannot be loaded: {problem}") from None
    for name in _NEEDED:
        if not hasattr(of, f"gfmhil_{name}"):
            other = "; it has Model_GetInfo: use dll:" if hasattr(of, "Model_GetInfo") else ""
            raise UserError(
                f"{path}: has no function gfmhil_{name}; see gfmhil_controller.h{other}"
            )
    version = of.gfmhil_version()
    if version != VERSION:
        raise UserError(
            f"{path}: was compiled for version {version} of gfmhil_controller.h; this bench has "
            f"version {VERSION}"
        )
    of.gfmhil_name.restype = c.c_char_p
    of.gfmhil_new.restype = c.c_void_p
    given = (c.c_void_p, c.POINTER(_ControllerInput), c.POINTER(_ControllerOutput))
    of.gfmhil_start.argtypes = given
    if hasattr(of, "gfmhil_step"):
        of.gfmhil_step.argtypes = given
    if hasattr(of, "gfmhil_isr"):
        pins = c.POINTER(_Adc), given[2], c.POINTER(_Compare)
        of.gfmhil_isr.argtypes = (*given[:2], *pins)
    of.gfmhil_free.argtypes = (c.c_void_p,)
    of.gfmhil_free.restype = None
    return of
