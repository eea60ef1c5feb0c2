"""CAN frames of a run as BLF, what Vector's tools log, rebuilt from the recording.

The CAN link's own codec makes the frames again from what each side recorded: measurements from y,
commands from the u that the plant took, states from the controller's. A run over CAN exchanged
these frames bit by bit, a run over another link would have. Rebuilt are the frames that were used:
not the handshake, not what was said again or arrived damaged, not a command that came too late,
not the words that end a run. All that is on a bus is for a logger on that bus, e.g.
``python -m can.logger``.
"""

import heapq
from bisect import bisect_right
from collections.abc import Iterator
from pathlib import Path

import can
import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.links.can import CanOptions
from gfm_hil.links.can.dbc import write_dbc
from gfm_hil.links.can.layout import Plan, load_plan
from gfm_hil.links.can.vectors import CanFrame, VectorSender
from gfm_hil.links.frame import FrameWriter
from gfm_hil.recording.run import Run
from gfm_runtime.signals import VectorName, carried
from gfm_runtime.states import INIT, PLANT_TRIP, REASONS, SAFE

_PIECE = 1 << 16  # ticks

#: a CAN frame and when it was sent, s from tick 0
Timed = tuple[float, CanFrame]


def write_blf(run: Run, file: Path) -> None:
    """Write a run; times are of each sender's clock since tick 0, in lockstep those of the run."""
    options = can_options(run)
    with can.BLFWriter(file) as writer:
        for t, (number, payload) in can_frames(run, options):
            writer.on_message_received(
                can.Message(
                    timestamp=t, arbitration_id=number, data=payload, is_extended_id=False,
                    is_fd=options.fd, bitrate_switch=options.fd,
                )
            )  # fmt: skip


def write_dbc_file(run: Run, file: Path) -> None:
    """Write the DBC by which the frames are to be read."""
    options = can_options(run)
    own = options.dbc
    text = write_dbc(options.fd) if own is None else Path(own).read_text(encoding="utf-8")
    file.write_text(text, encoding="utf-8")


def can_options(run: Run) -> CanOptions:
    """The run's own if it went over CAN, else the link's defaults."""
    link, inner = run.scenario.link, "u_E_q" in run.recorded
    return CanOptions(**(link.options if link.type == "can" else {})).of_run(inner)


def can_frames(run: Run, options: CanOptions) -> Iterator[Timed]:
    """The frames of both sides in the order of their times. Raises UserError: a side did not
    record, or the DBC is not to be had."""
    if not {"y_p", "state"} <= set(run.recorded):
        raise UserError(f"{run.folder}: holds the recording of one side; frames need both")
    try:
        plan = load_plan(options)
    except ValueError as problem:
        raise UserError(f"link.options.{problem}") from None
    roles = _measurements(run, options, plan), _commands(run, options, plan)
    return heapq.merge(*roles, key=lambda timed: timed[0])


def _measurements(run: Run, options: CanOptions, plan: Plan) -> Iterator[Timed]:
    """The plant's: one vector a tick, or every n-th."""
    writer, sender = FrameWriter("y", plan.signal_set), VectorSender(plan, "y", options.heartbeat)
    begin = _begin(run, "plant")
    for first, last in _pieces(run):
        rows, times = _vector(run, "y", first, last), _times(run, "plant", begin, first, last)
        tripped = run.recorded["true_trip"][first:last] != 0
        for k, row in enumerate(rows, first):
            state, reason = (SAFE, PLANT_TRIP) if tripped[k - first] else (INIT, 0)
            message = writer.pack(k, state, reason, row)
            if k % options.every == 0 and not np.isnan(row[0]):
                yield from ((times[k - first], frame) for frame in sender.frames(message))


def _commands(run: Run, options: CanOptions, plan: Plan) -> Iterator[Timed]:
    """The controller's: an answer to every vector that it got.

    With n ticks to an exchange the plant takes u[k] at k + n, as the link has it.
    """
    writer, sender = FrameWriter("u", plan.signal_set), VectorSender(plan, "u", options.heartbeat)
    n = options.every
    # codes of the reasons for which it was in SAFE; the log has them in words
    told = [e for e in run.events if "controller" in e.get("role", "") and "reason" in e]
    ticks, codes = [e["tick"] for e in told], [0, *(_code(e["reason"]) for e in told)]
    begin = _begin(run, "controller")
    for first, last in _pieces(run):
        times = _times(run, "controller", begin, first, last)
        state = run.recorded["state"][first:last]
        beyond = last + n  # u[k] may be taken as late as that
        rows, taken = _vector(run, "u", first, beyond), _took_in_time(run, first, beyond)
        for j in np.flatnonzero(~np.isnan(state)).tolist():
            k = first + j
            at = j + n if n > 1 and k else j
            known = at < len(rows) and bool(taken[at])
            now = int(state[j])
            values = rows[at] if known else np.zeros(rows.shape[1])
            reason = codes[bisect_right(ticks, k)] if now == SAFE else 0
            message = writer.pack(k, now, reason, values)
            if k % n == 0:
                frames = sender.frames(message)
                if known:
                    yield from ((times[j], frame) for frame in frames)


def _pieces(run: Run) -> Iterator[tuple[int, int]]:
    """The ticks of a run, first and last of a piece that is held in memory."""
    return ((a, min(a + _PIECE, run.ticks)) for a in range(0, run.ticks, _PIECE))


def _vector(run: Run, group: VectorName, first: int, last: int) -> NDArray[np.float64]:
    """Rows of a vector, shape (ticks, n), p.u."""
    carries = carried(group, "u_E_q" in run.recorded)
    return np.column_stack([run.recorded[f"{group}_{n}"][first:last] for n in carries])


def _took_in_time(run: Run, first: int, last: int) -> NDArray[np.bool_]:
    """Ticks at which the plant took a command in time; in process it always does."""
    received = run.recorded.get("plant_received", run.recorded["tick"])
    return received[first:last] >= 0


def _begin(run: Run, role: str) -> int:
    """When a side's tick 0 was due, ns; 0 in lockstep."""
    if run.summary["mode"] != "lockstep":
        due = run.recorded[f"{role}_scheduled"]
        for first, last in _pieces(run):
            known = np.flatnonzero(due[first:last] >= 0)
            if len(known):
                k = first + int(known[0])
                return int(due[k : k + 1][0]) - round(k * run.summary["T_s"] * 1e9)
    return 0


def _times(run: Run, role: str, begin: int, first: int, last: int) -> NDArray[np.float64]:
    """When a side sent its frames of ticks [first, last), s from tick 0, shape (ticks,)."""
    if run.summary["mode"] == "lockstep":
        return run.recorded["t"][first:last]
    return (run.recorded[f"{role}_sent"][first:last] - begin) * 1e-9


def _code(reason: str) -> int:
    return next((k for k, text in enumerate(REASONS) if text and reason.startswith(text)), 0)
