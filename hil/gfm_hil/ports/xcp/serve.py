"""Serves a run in progress to a calibration tool, to the run's end."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable
from pathlib import Path

from gfm_hil.core.stopping import Interrupt
from gfm_hil.engine.announcement import not_running, present
from gfm_hil.ports.commands import Operator
from gfm_hil.ports.xcp.lines import Line, packed
from gfm_hil.ports.xcp.memory import Memory
from gfm_hil.ports.xcp.slave import Slave
from gfm_hil.recording.live import LiveRun

_LOOK_S = 0.1
_NICENESS = 5  # the loop comes first
_TIMEOUT_MS = 7000  # T1: a command to the run may take six seconds
_COMMANDS = (
    "GET_COMM_MODE_INFO", "GET_ID", "SET_MTA", "UPLOAD", "SHORT_UPLOAD", "DOWNLOAD",
    "SHORT_DOWNLOAD",
)  # fmt: skip


def live_a2l(folder: Path, line: Line) -> str:
    """The A2L file of a run in progress, for a slave on that line.

    Raises:
        UserError: no run is going on there.
    """
    operator = Operator(folder, through="xcp")
    try:
        return _a2l(_memory(folder, operator), line)
    finally:
        operator.close()


def serve(folder: Path, line: Line, writes: bool, notice: Callable[[str], None]) -> None:
    """Serve the run in ``folder`` until it ends, or until SIGINT or SIGTERM.

    Raises:
        UserError: no run is in progress there, or the line cannot be opened or is gone.
    """
    operator = Operator(folder, through="xcp")
    with contextlib.ExitStack() as stack:
        stack.callback(operator.close)
        interrupt = stack.enter_context(Interrupt())
        memory = _memory(folder, operator)
        stack.callback(line.close)
        where = line.words()
        kind = "read and write" if writes else "read only"
        slave = Slave(memory, "gfmhil", _a2l(memory, line), writes, notice, most=line.most)
        with contextlib.suppress(OSError):
            os.nice(_NICENESS)
        notice(f"XCP on {where}, {kind}")
        while not interrupt.came and present(folder):
            line.answer(slave, _LOOK_S)


def _memory(folder: Path, operator: Operator) -> Memory:
    run = LiveRun(folder)
    while "laws" not in (now := operator.snapshot()):
        if not present(folder):
            raise not_running(folder)
        time.sleep(_LOOK_S)
    return Memory(operator, now["laws"], "limited" in now, lambda: run.done("controller"))


def _a2l(memory: Memory, line: Line) -> str:
    return memory.a2l("bench", packed(line, _TIMEOUT_MS, _COMMANDS))
