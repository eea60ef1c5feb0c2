"""Our laws on another processor as the controller: processor in the loop.

The laws of the run are built as one program for a target of ``gfmhil firmware check``. QEMU runs it
and gives it two pipes, through which it gets references and measurements tick by tick and answers
with u. Before tick 0 the program has to say that it has the run's laws, and to give the kernel's
bits in golden rows. The bench keeps what
is not a law: ramps, checks, the choice of a scheduled law's stage.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.controllers.external import ControllerError, ExternalController
from gfm_hil.controllers.ports import Vector
from gfm_hil.core import temporary as scratch
from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import our_controller_on
from gfm_runtime import LawError
from gfm_runtime.assembly import SPARE, Controller
from gfm_runtime.children import end_now, guarded
from gfm_runtime.counts import COUNTS_STATE
from gfm_runtime.firmware import loop
from gfm_runtime.firmware.check import TARGETS, need_tools
from gfm_runtime.firmware.golden import SHIPPED, Golden, golden
from gfm_runtime.firmware.module import RESULTS, Module
from gfm_runtime.signals import COUNTS, N_ADC, REF_NAMES, carried, names
from gfm_runtime.states import BAD_SENSOR, BAD_U, BAD_Y, OK

if TYPE_CHECKING:
    from gfm_hil.controllers.external import PackedLaw

_SHOWN = 120  # characters of an identification
_START_S, _POLL_S = 30.0, 0.05
_LINES, _BYTES = 3, 2000  # of what QEMU says, at most
_SIGNALS = {BAD_Y: carried("y", True), BAD_SENSOR: names("adc"), RESULTS["BAD_REF"][0]: REF_NAMES}
_SAID = dict(RESULTS.values())


class PilController(ExternalController):
    """The laws of a run on a target; a context in which its program runs. Raises UserError: there
    is no such target or firmware, or its tools are missing (the packages are named).

    Args:
        target: one of ``gfm_runtime.firmware.TARGETS``, or ``TARGET:FOLDER`` with a firmware that
            calls the laws, see ``loop.h``.
    """

    has_laws = True

    def __init__(self, target: str) -> None:
        target, _, firmware = target.partition(":")
        self._firmware = Path(firmware) if firmware else None
        if target not in TARGETS:
            raise UserError(
                f"controller pil:{target}: must be pil: and one of {', '.join(TARGETS)}"
            )
        if TARGETS[target].order != "<":
            raise UserError(
                f"controller pil:{target}: has the other order of bytes than a run's frames; "
                f"gfmhil firmware check DIR --target {target} steps it through golden rows"
            )
        if self._firmware is not None and not any(self._firmware.glob("*.c")):
            raise UserError(f"controller pil:{target}:{firmware}: is no folder with C sources")
        try:
            self.real = need_tools(target).real
        except LawError as problem:
            raise UserError(f"controller pil: {problem}") from None
        self.name = our_controller_on(target)
        self._starts: select.poll | None = None
        self._rests: tuple[int, np.void] | None = None  # the law at the start, and its state
        self._target = target
        self._ends = contextlib.ExitStack()

    def begin(self, controller: Controller, changed: Sequence[PackedLaw] = ()) -> None:
        """Build the program for a controller's laws, on whose records it then works, and start it.
        Raises UserError: it cannot be built, does not start, or gives other bits than the
        kernel."""
        self._controller, kind = controller, controller.laws.dtype
        ready = [*zip(controller.discrete, controller.laws, strict=True)][:-SPARE]
        ready += [(discrete, packed.astype(kind)[0]) for discrete, packed in changed]
        #: law of the program by its numbers
        self._places = {_numbers(record): k for k, (_, record) in enumerate(ready)}
        modules = [
            Module(
                # a firmware calls a law by its name
                f"{k} {discrete.law.name}" if self._firmware is None else discrete.law.name,
                discrete.law,
                record,
                controller.signal_set > 0,
                controller.signal_set == COUNTS,
            )
            for k, (discrete, record) in enumerate(ready)
        ]
        try:
            folder = self._ends.enter_context(scratch.temporary("gfmhil-pil-"))
            program = loop.build_loop(modules, controller.T_s, self._target, folder, self._firmware)
            self._run(program)
            self._identify()
            self._check(modules, golden(modules, SHIPPED))
        except (LawError, ControllerError) as problem:
            self.close()
            raise UserError(f"controller pil: {problem}") from None

    def has(self, law: PackedLaw) -> bool:
        return _numbers(law[1].astype(self._controller.laws.dtype)[0]) in self._places

    def _run(self, program: loop.LoopProgram) -> None:
        folder = program.folder
        self._program = program
        self._request, self._state, self._answer = (
            np.zeros(1, kind) for kind in (program.request, program.state, program.answer)
        )
        self._none = 0  # what reading the clock takes
        for name in (loop.TO, loop.FROM):
            os.mkfifo(folder / name)
        # we keep both ends of the one, so that none waits for the other to open it
        self._to = os.open(folder / loop.TO, os.O_RDWR)
        self._ends.callback(os.close, self._to)
        self._from = os.open(folder / loop.FROM, os.O_RDONLY | os.O_NONBLOCK)
        self._ends.callback(os.close, self._from)
        self._log = self._ends.enter_context((folder / "log").open("w+b"))
        try:
            self._process = subprocess.Popen(
                guarded(program.target.run, bounded=True), cwd=folder, stdin=subprocess.DEVNULL,
                stdout=self._log, stderr=self._log, start_new_session=True,
            )  # fmt: skip
        except OSError as problem:
            raise ControllerError(f"{self.name}: cannot be started: {problem.strerror}") from None
        self._ends.callback(self._end)
        self._starts = select.poll()
        self._starts.register(self._from, select.POLLIN)
        self._give_up = time.monotonic() + _START_S
        self._receive()
        self._none = int(self._answer["count"][0])

    def _identify(self) -> None:
        """Ask the program which laws it has. Raises ControllerError: another one, as a
        firmware that brings its own code may have."""
        text: NDArray[Any] = np.zeros(1, self._program.identification)
        for k, expected in enumerate(self._program.identifications):
            self._request["what"], self._request["law"] = loop.IDENTIFY, k
            self._give_up = time.monotonic() + _START_S
            self._send(self._request)
            self._receive()
            self._receive(text)
            found = text[0].decode("ascii", "replace")
            if found != expected:
                raise ControllerError(
                    f"{self.name}: its code is of another law: {found[:_SHOWN]!r}, the run has "
                    f"{expected!r}"
                )

    def _check(self, modules: Sequence[Module], rows: Golden) -> None:
        """Step the program through golden rows; from then on reading waits for ever. Raises
        ControllerError: a bit is not the kernel's, or the program has ended."""
        differ = []
        for row in rows.words:
            self._request["what"], self._give_up = loop.CHECK, time.monotonic() + _START_S
            self._send(self._request)
            self._send(row)
            self._receive()
            differ.append(int(self._answer["result"][0]))
            if not 0 <= differ[-1] <= len(row):
                raise self._problem(f"answers a golden row with {differ[-1]}, which no law does")
        if any(differ):
            first = np.flatnonzero(differ)[0]
            name = modules[int(rows.words[first, 1])].name
            name = name.partition(" ")[2] or name
            raise self._problem(
                f"its program does not compute the kernel's bits: {sum(differ):,} words differ in"
                f" {len(differ):,} golden rows, the first in law {name}; a compiler that fuses"
                " multiply-add (-ffp-contract=fast, -ffast-math) does this"
            )
        self._starts = None
        os.set_blocking(self._from, True)

    def start(self, u: Vector) -> None:
        """Load the controller's active law in its state at rest, in which u is; at a reset, too,
        when the controller has measured already."""
        c, self._aligns = self._controller, self._rests is not None
        if self._rests is None:
            active = int(c.ctl["active"][0])
            self._rests = active, c.states[active].copy()
        k, rests = self._rests
        self._aligns &= c.signal_set == COUNTS
        request, state = self._request, self._state
        request["what"], request["law"] = loop.START, self._place(k)
        request["limited"] = rests["limited"]
        for name in state.dtype.names or ():
            state[name] = rests[name]
        self._send(request)
        self._send(state)

    def tick(self, ref: Vector, y: Vector, u: Vector, changed: int = -1) -> None:
        """u from the controller's records, where what a run records of a law is then; NaN in what
        is not finite."""
        ctl, states = self._controller.ctl, self._controller.states
        request, answer = self._request, self._answer
        request["what"], self._aligns = loop.ALIGN if self._aligns else loop.TICK, False
        if changed >= 0:
            request["what"], request["law"] = loop.CHANGE, self._place(changed)
        request["ref"] = ctl["ref"]
        if counts := len(u) > ctl["out"].shape[1]:
            request["y"], request["measured"] = y[-N_ADC:], ctl["y"]
        else:
            request["y"] = ctl["y"][:, : request["y"].shape[1]]
        self._send(request)
        self._receive()
        one = answer[0]
        if one["result"] != OK:
            self._refuse(int(one["result"]), int(one["channel"]), len(u))
        count = int(one["count"])
        if count:
            self.count = self._program.target.instructions(count - self._none)
        u[:] = one["u"]
        if one["result"] == BAD_U:
            u[one["channel"]] = np.nan
        k = changed if changed >= 0 else int(ctl["active"][0])
        ctl["u"], ctl["out"][0, : len(u)] = one["own"], u[: ctl["out"].shape[1]]
        for name, *_ in COUNTS_STATE if counts else ():
            states[name][k] = one[name]
        states["i_ref"][k], states["limited"][k] = one["i_ref"], one["limited"]
        if changed >= 0:
            ctl["bump"] = one["bump"]

    def close(self) -> None:
        self._ends.close()

    def _send(self, what: NDArray[Any]) -> None:
        os.write(self._to, what.view(np.uint8).data)

    def _receive(self, what: NDArray[Any] | None = None) -> None:
        """The next answer, or what follows it. Raises ControllerError: the program has ended."""
        into = (self._answer if what is None else what).view(np.uint8).data
        while len(into):
            while self._starts and not self._starts.poll(_POLL_S * 1e3):
                if self._process.poll() is not None:
                    raise self._ending()
                if time.monotonic() > self._give_up:
                    raise self._problem(f"has not answered for {_START_S:g} s")
            got = os.readv(self._from, [into])
            if not got:
                raise self._ending()
            into = into[got:]

    def _ending(self) -> ControllerError:
        """How the program has ended."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)
        code = self._process.returncode
        how = f"by {signal.Signals(-code).name}" if code and code < 0 else f"with code {code}"
        return self._problem(f"{self._program.target.run[0]} has ended {how}")

    def _problem(self, what: str) -> ControllerError:
        """What is wrong, and what QEMU and the program have said first."""
        # pread: QEMU writes on where the file's position is
        log = os.pread(self._log.fileno(), _BYTES, 0).decode("utf-8", "replace").strip()
        lines = log.partition("\n\n")[0].splitlines()[:_LINES]
        said = "".join(c if c.isprintable() else " " for c in "; ".join(lines))
        return ControllerError(": ".join([self.name, what, *filter(None, [said])]))

    def _place(self, k: int) -> int:
        """The program's number of the controller's law k."""
        return self._places[_numbers(self._controller.laws[k])]

    def _refuse(self, result: int, channel: int, n_u: int) -> None:
        """Say why there is no u; an output that is not finite the controller itself reports. Raises
        ControllerError: the law refuses its inputs, or the answer is none."""
        names = {**_SIGNALS, BAD_U: range(n_u)}.get(result, ())
        if not 0 <= channel < len(names):
            raise self._problem(f"answers {result} for signal {channel}, which no law does")
        if result != BAD_U:
            raise ControllerError(f"{self.name}: refuses: {_SAID[result]}: {names[channel]}")

    def _end(self) -> None:
        end_now(self._process)
        self._process.wait()


def _numbers(record: np.void) -> bytes:
    """All numbers of a record, without what lies between its fields."""
    return b"".join(record[name].tobytes() for name in record.dtype.names or ())
