"""The delays and misses of a recorded run, tick by tick: ``link.impairment.trace``.

A trace says of each tick k whether the controller computed it, and the tick whose u acts in k: k
itself, or an earlier one after a miss (-1: the u of the start). Both sides then do in lockstep what
they did in real time, so that the run has the same bits each time.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.recording.columns import Columns
from gfm_hil.recording.npz import open_npz
from gfm_hil.recording.timing import MISS_NEEDS, missed
from gfm_hil.scenario import Scenario
from gfm_runtime.compiled import inlined
from gfm_runtime.signals import NU, carried

ACTS, STEPS = range(2)  # columns of ``Trace.plan``


class Trace(NamedTuple):
    """What a run replays; without a trace both have no rows.

    Attributes:
        plan: the tick whose u acts, and whether the controller computes; shape (ticks, 2).
        kept: the newest u by tick, and last the one that acts; shape (N + 1, 3), or (N + 1, 4) with
            an inner stage, p.u.
    """

    plan: NDArray[np.int64]
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

    Raises:
        UserError: no such file, no timing in it, another T_s, or shorter than the run.
    """
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
            plan = _of_run(columns, file, scenario, where)
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


def _of_run(columns: Columns, file: Path, scenario: Scenario, where: str) -> NDArray[np.int64]:
    """The plan of a run's times, and of the u that its plant recorded.

    A u that was late acts from the next miss on. The newest of those that were sent before the
    plant began its next tick is the one, if u changed at all.
    """
    needs = (*MISS_NEEDS, "plant_woke", "controller_received", "controller_sent")
    if not columns.keys() >= set(needs) or (columns[MISS_NEEDS[0]][:1] < 0).all():
        raise UserError(f"{where}: has no times of a run in real time")
    due, received, woke, computed, sent = (np.asarray(columns[name][:]) for name in needs)
    T_ns = float(np.median(np.diff(due[:1000])))
    if abs(T_ns - 1e9 * scenario.T_s) > 1.0:
        raise UserError(
            f"{where}: has T_s = {1e-9 * T_ns:g} s, and the scenario {scenario.T_s:g} s"
        )
    late = missed({"plant_scheduled": due, "plant_received": received})
    u = _recorded_u(file.parent)
    steps = computed >= 0
    acts = np.arange(len(due))
    for k in np.flatnonzero(late):
        before = acts[k - 1] if k else -1
        acts[k] = before
        if k == 0 or np.array_equal(u[k], u[k - 1]):
            continue
        late_ones = [j for j in range(before + 1, k) if steps[j]]
        end = woke[k + 1] if k + 1 < len(woke) else due[k] + T_ns  # of the plant's last look
        came = [j for j in late_ones if sent[j] <= end]
        if late_ones:  # u has changed, so one has come
            acts[k] = came[-1] if came else late_ones[0]
    return np.stack([acts, steps], axis=1).astype(np.int64)


def _recorded_u(folder: Path) -> NDArray[np.float64]:
    """u as the plant of a run recorded it, shape (ticks, 3) or (ticks, 4)."""
    columns = open_npz(folder / "signals.npz")
    names = [f"u_{name}" for name in carried("u", True) if f"u_{name}" in columns]
    return np.stack([columns[name][:] for name in names], axis=1)
