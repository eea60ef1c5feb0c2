"""Both sides of a run in two threads of this process, over any link."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.core.roles import SIDES, Side
from gfm_hil.engine.handshake import shake_hands
from gfm_hil.engine.loop_thread import run_loop
from gfm_hil.engine.process import compile_side
from gfm_hil.engine.setup import make_bench
from gfm_hil.engine.timeline import Timeline
from gfm_hil.links import Link, link_kind, open_link
from gfm_hil.links.impaired import ImpairedLink
from gfm_hil.recording.log import read_log
from gfm_hil.recording.merge import merge
from gfm_hil.recording.parts import Part
from gfm_hil.recording.run import read_recording
from gfm_hil.scenario.model import Scenario

from .test_links import in_threads

PATIENT = {"type": "inproc", "peer_timeout_s": 30.0, "start_timeout_s": 60.0}
Touch = Callable[[Side, Link], Link]


@dataclass
class Pair:
    """The results of a run in two threads.

    Attributes:
        signals, timing: as in signals.npz and timing.npz.
        faults: each side's counters of frames.
        injected: counters of each side's impairment stage.
        log: lines of both event logs.
    """

    signals: dict[str, np.ndarray] = field(default_factory=dict)
    timing: dict[str, np.ndarray] = field(default_factory=dict)
    faults: dict[Side, dict[str, int]] = field(default_factory=dict)
    injected: dict[Side, dict[str, int]] = field(default_factory=dict)
    log: list[dict[str, Any]] = field(default_factory=list)

    def ends(self) -> dict[str, tuple[str, str, int]]:
        """How each side ended: status, reason, tick."""
        return {
            e["side"]: (e["status"], e["reason"], e["tick"])
            for e in self.log
            if e["event"] == "end"
        }


def run_pair(
    scenario: Scenario,
    folder: Path,
    link: str,
    options: dict[str, Any] | None = None,
    touch: Touch = lambda side, link: link,
    stopped: Callable[[], bool] = lambda: False,
) -> Pair:
    """Run a scenario over a new link; ``touch`` may wrap an end after the handshake."""
    folder.mkdir(parents=True, exist_ok=True)
    endpoint = link_kind(link).fresh(folder)
    benches = {side: make_bench(scenario) for side in SIDES}
    parts = {side: Part.create(folder, side, scenario.ticks) for side in SIDES}
    for side in SIDES:
        compile_side(side, benches[side], parts[side])
    pair = Pair()

    def call(side: Side) -> None:
        bench, part, impairment = benches[side], parts[side], scenario.link.impairment
        end = open_link(link, side, endpoint, options)
        timeline = Timeline(bench, folder / f"events_{side}.jsonl", (side,))
        used = touch(side, end)
        if impairment is not None and impairment.hits(side):
            used = ImpairedLink(used, impairment, side)
        try:
            t0 = shake_hands(side, end, scenario, lambda: False, lambda text: None).t0_ns
            reader = run_loop(side, bench, used, part, timeline, t0, stopped)
            pair.faults[side] = dict(reader.faults)
            if isinstance(used, ImpairedLink):
                pair.injected[side] = used.injected
        finally:
            end.close()
            timeline.close()

    for problem in in_threads(call).values():
        if problem is not None:
            raise problem
    pair.log = read_log(*sorted(folder.glob("events_*.jsonl")))
    merge(folder, scenario.T_s, benches["controller"].controller.labels)
    pair.signals = {name: x[:] for name, x in read_recording(folder)[0].items()}
    with np.load(folder / "timing.npz") as file:
        pair.timing = dict(file)
    return pair
