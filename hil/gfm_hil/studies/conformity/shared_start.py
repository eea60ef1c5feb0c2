"""The start that runs of a model have in common, and the part of a run that is judged.

A model that is not ours settles in the loop before a test begins, and each test of a set waits a
second or two more before its first event. Runs that differ in nothing up to there share one run of
it, and go on from its snapshot. A law begins at its operating point, in process, and needs no such
start.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.core.errors import UserError
from gfm_hil.recording.run import Run, bases
from gfm_hil.run.runner import run_scenario
from gfm_hil.scenario import Scenario

_HELD = 1e-9  # p.u.; by so much a voltage that is held may differ, by rounding
CHECKED_S = 0.05  # how long a run from the snapshot has to repeat the start, s
_FREE = {"title", "description", "duration", "events"}  # what may differ after the start


@dataclass(frozen=True)
class SharedStart:
    """A run without events, up to the first event of all runs that go on from it."""

    scenario: Scenario  # of one of them
    ticks: int  # where its snapshot is
    folder: Path  # of the run
    command: tuple[str, ...]  # the program that steps the model

    def make(self) -> Path | None:
        """Run it; returns its folder if runs from its snapshot go on with its bits. A model that
        keeps some of its state where the snapshot has none of it does not, one that gives no state
        cannot, and neither does one that ends the run."""
        cut_s = self.ticks * self.scenario.T_s
        known = {"events": [], "duration": cut_s + CHECKED_S, "snapshot": cut_s}
        again = {"events": [], "duration": CHECKED_S, "start_from": str(self.folder)}
        try:
            run = self._run(self.scenario, known, self.folder)
            rest = self._run(self.scenario, again, self.folder.with_suffix(".again"))
        except UserError:
            return None
        same = run.status == rest.status == "completed" and all(
            run.columns[name][self.ticks :].tobytes() == rest.columns[name][:].tobytes()
            for name in run.columns.keys() - {"tick", "t"}
        )
        return self.folder if same else None

    def go_on(self, scenario: Scenario, folder: Path) -> Run:
        """What a scenario does from the snapshot on. Raises UserError: as ``run_scenario``."""
        later = scenario.shifted(-self.ticks * scenario.T_s)
        return self._run(later, {"start_from": str(self.folder)}, folder)

    def _run(self, scenario: Scenario, changes: dict[str, Any], folder: Path) -> Run:
        changed = scenario.model_copy(update=changes)
        return run_scenario(changed, folder, controller_command=self.command)


def first_event(scenario: Scenario) -> int:
    """Tick of a scenario's first event, or of its end."""
    return min((event.at(scenario.T_s) for event in scenario.events), default=scenario.ticks)


def alike(scenario: Scenario) -> str:
    """The same text for scenarios that begin alike, up to the first event of either."""
    content = scenario.model_dump(mode="json", exclude=_FREE)
    return json.dumps([content, scenario.laws()], sort_keys=True)


def after_settling(scenario: Scenario, run: Run, settle_s: float, start: SharedStart | None) -> Run:
    """The run of a scenario after its first ``settle_s``, as a run of its own. Raises UserError: it
    did not last so long.

    Args:
        scenario: all of it, with the time to settle.
        run: of all of it, or of what follows the start.
        start: its first ticks, or None.
    """
    first = round(settle_s / scenario.T_s)
    begin, after = (None, 0) if start is None else (Run.load(start.folder), start.ticks)
    ticks = after + run.ticks
    if ticks <= first:
        raise UserError(
            f"the controller does not settle in {settle_s:g} s; the run ended as"
            f" {run.status}: {run.summary['reason']}"
        )
    pieces = [(run, max(first - after, 0), run.ticks, after - first)]
    if begin is not None:
        pieces.insert(0, (begin, first, after, -first))
    columns: dict[str, Any] = {
        name: np.concatenate([piece.columns[name][a:b] for piece, a, b, _ in pieces])
        for name in run.columns
    }
    columns["tick"] = np.arange(ticks - first)
    columns["t"] = columns["tick"] * scenario.T_s
    if "u_E_q" in columns and len(columns["t"]) > 1 and not np.ptp(columns["true_omega_u"]):
        columns |= _of_bridge(columns, scenario)
    events = [
        line
        for k, (piece, a, b, by) in enumerate(pieces)
        for line in _shift_lines(piece.events, by, scenario.T_s)
        if a <= line["tick"] - by < b + (piece is run) and not (k and line["event"] == "handshake")
    ]
    moved = _shift_lines(run.summary["events"], after - first, scenario.T_s)
    summary = {**run.summary, "events": [*moved], "ticks": ticks - first}
    shifted = scenario.shifted(-settle_s)
    return replace(
        run, scenario=shifted, columns=columns, events=events, summary=summary, timing={}
    )


def _of_bridge(columns: Mapping[str, Any], scenario: Scenario) -> dict[str, Any]:
    """Angle and frequency of the bridge's voltage, in place of the frame's: a controller that
    commands phases has the frame turn at one speed, and they show nothing of it."""
    radians = bases(scenario).omega_b * scenario.T_s
    e = columns["u_E_u"] + 1j * columns["u_E_q"]
    angle = np.unwrap(np.angle(e))
    # a voltage that is held for several ticks turns back in the frame in the meantime
    held = np.abs(e[1:] - e[:-1] * np.exp(-1j * radians * columns["true_omega_u"][0])) < _HELD
    new = 1 + np.flatnonzero(~held)
    if len(new) > 1:
        at, there = (
            np.pad(x[new], 1, "reflect", reflect_type="odd") for x in (columns["tick"], angle)
        )
        angle = np.interp(columns["tick"], at, np.unwrap(there))
    speed = np.gradient(angle, radians)
    return {
        "true_delta": columns["true_delta"] + angle,
        "true_omega_u": columns["true_omega_u"] + speed,
    }


def _shift_lines(lines: Sequence[dict[str, Any]], by: int, T_s: float) -> Iterator[dict[str, Any]]:
    """Lines of a log, or entries of a summary, so many ticks later."""
    for line in lines:
        tick = line["tick"] + by
        yield {**line, "tick": tick, **({"t": tick * T_s} if "t" in line else {})}
