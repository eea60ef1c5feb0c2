"""The delays and misses of a recorded run, tick by tick: ``link.impairment.trace``.

A trace says of each tick k whether the controller computed it, and the tick whose u acts in k: k
itself, or an earlier one after a miss (-1: the u of the start). Both sides then do in lockstep what
they did in real time, so that the run has the same bits each time.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.recording.columns import ACTS as RECORDED_ACTS
from gfm_hil.recording.columns import Columns
from gfm_hil.recording.npz import open_npz
from gfm_hil.recording.timing import MISS_NEEDS
from gfm_hil.scenario import Scenario
from gfm_runtime.compiled import inlined
from gfm_runtime.signals import NU

ACTS, STEPS = range(2)  # columns of ``Trace.plan``


class Trace(NamedTuple):
    """What a run replays; without a trace both have no rows."""

    # the tick whose u acts, and whether the controller computes; shape (ticks, 2)
    plan: NDArray[np.int64]
    # the newest u by tick, and last the one that acts; shape (N + 1, 3), or (N + 1, 4) with an
    # inner stage, p.u.
    kept: NDArray[np.float64]


@inlined
def stands_still(plan, k):
    """Whether the controller does not compute tick k."""
    return len(plan) > 0 and plan[k, STEPS] == 0


@inlined
def replay(plan, kept, k, u, told):
    """Keep u[k], and write the u that acts in tick k into ``told``; whether that is u[k]."""
    places = len(kept) - 1
    newest, acting = kept[(k + 1) % places], kept[(plan[k, ACTS] + 1) % places]
    for j in range(len(u)):
        newest[j] = u[j]
    for j in range(len(u)):
        told[j] = acting[j]
    return plan[k, ACTS] == k


def no_trace() -> Trace:
    """That of a run that replays nothing."""
    return Trace(np.zeros((0, 2), np.int64), np.zeros((0, NU)))


def trace_of(scenario: Scenario, start: NDArray[np.float64]) -> Trace:
    """The trace that a scenario replays; ``start``: u before tick 0, shape (3,) or (4,), p.u.
    Raises UserError: no such file, no timing in it, another T_s, or shorter than the run."""
    impairment = scenario.link.impairment
    if impairment is None or impairment.trace is None:
        return no_trace()
    file = Path(impairment.trace)
    where = f"link.impairment.trace = {impairment.trace!r}"
    plan = _read(file / "timing.npz" if file.is_dir() else file, scenario, where)
    lag = int((np.arange(len(plan)) - plan[:, ACTS]).max())
    if lag > scenario.late_policy.hold:
        raise UserError(
            f"{where}: {lag} misses in a row, but late_policy.hold = {scenario.late_policy.hold}"
        )
    kept = np.zeros((lag + 3, len(start)))
    kept[0] = start
    return Trace(np.ascontiguousarray(plan), kept)


def _read(file: Path, scenario: Scenario, where: str) -> NDArray[np.int64]:
    if scenario.mode != "lockstep":
        raise UserError(f"{where}: is replayed in lockstep; set mode = 'lockstep'")
    if scenario.late_policy.extrapolate:
        raise UserError(f"{where}: replays a u that is held; late_policy.extrapolate must be 0")
    if scenario.parts or scenario.network is not None:
        raise UserError(f"{where}: is of one converter, and the scenario has a network")
    if scenario.link.type == "can" and int(scenario.link.options.get("every", 1)) > 1:
        raise UserError(f"{where}: link.options.every must be 1")
    try:
        columns = open_npz(file)
        if {"acts", "steps"} <= columns.keys():
            plan = np.stack([columns["acts"][:], columns["steps"][:]], axis=1).astype(np.int64)
        else:
            plan = _of_run(columns, scenario, where)
    except FileNotFoundError as problem:
        raise UserError(f"{where}: no such file: {problem.filename}") from None
    except (OSError, ValueError, KeyError) as problem:
        raise UserError(f"{where}: cannot be read: {problem}") from None
    if len(plan) < scenario.ticks:
        raise UserError(
            f"{where}: has {len(plan)} ticks, and the run {scenario.ticks}; shorten duration"
        )
    plan = plan[: scenario.ticks]
    k = np.arange(len(plan))
    if (plan[:, ACTS] > k).any() or (plan[:, ACTS] < -1).any():
        raise UserError(f"{where}: acts must be from -1 to the tick itself")
    if ((plan[:, ACTS] == k) & (plan[:, STEPS] == 0)).any():
        raise UserError(f"{where}: a u acts in a tick that the controller did not compute")
    return plan


def _of_run(columns: Columns, scenario: Scenario, where: str) -> NDArray[np.int64]:
    """The plan of a run in real time, from what its two sides recorded."""
    due_in, computed_in = MISS_NEEDS[0], "controller_computed"
    if due_in not in columns or (columns[due_in][:1] < 0).all():
        raise UserError(f"{where}: has no times of a run in real time")
    for name in (RECORDED_ACTS, computed_in):
        if name not in columns:
            raise UserError(f"{where}: has no column {name}; record the run anew, with both sides")
    due, computed = (np.asarray(columns[name][:]) for name in (due_in, computed_in))
    T_ns = float(np.median(np.diff(due[:1000])))
    if abs(T_ns - 1e9 * scenario.T_s) > 1.0:
        raise UserError(
            f"{where}: has T_s = {1e-9 * T_ns:g} s, and the scenario {scenario.T_s:g} s"
        )
    return np.stack([columns[RECORDED_ACTS][:], computed >= 0], axis=1).astype(np.int64)
