"""The folder of a run: whether it may be used, and what is in it in the end."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.errors import UserError
from gfm_hil.recording import (
    CONTROLLER_COLUMNS,
    CONTROLLER_TIMES,
    PLANT_COLUMNS,
    PLANT_TIMES,
    merge,
)
from gfm_hil.scenario import Scenario
from gfm_hil.summary import summarise
from gfm_hil.timeline import Outcome, read_log, worst


@dataclass(frozen=True)
class Run:
    """A finished run: its folder, the content of summary.json, and all signals."""

    folder: Path
    summary: dict[str, Any]
    signals: dict[str, np.ndarray]


def check_free(folder: Path, ticks: int) -> None:
    """See that a run may be recorded in ``folder``, which need not exist.

    Raises:
        UserError: it holds something, cannot be made or written, or the disk is too full; a
            memory-mapped file on a full disk would end the process without a word.
    """
    there = folder
    while not there.exists():
        there = there.parent
    if not there.is_dir() or not os.access(there, os.W_OK):
        raise UserError(f"{folder}: {there} is not a folder that can be written to; choose --out")
    if there == folder and any(folder.iterdir()):
        raise UserError(f"{folder}: is not empty; choose another --out")
    columns = len(PLANT_COLUMNS + CONTROLLER_COLUMNS + PLANT_TIMES + CONTROLLER_TIMES)
    needed = 2 * 8 * columns * ticks  # while the parts are put together there are two of each
    free = shutil.disk_usage(there).free
    if needed > free:
        raise UserError(
            f"{folder}: {ticks} ticks need {needed / 1e9:.3g} GB, free are {free / 1e9:.3g} GB; "
            "shorten duration or choose another --out"
        )


def finish(
    scenario: Scenario,
    folder: Path,
    laws: list[str],
    wall_s: float,
    figures: bool = True,
    outside: Outcome | None = None,
) -> Run:
    """Turn the parts that the sides left in ``folder`` into the files of a run.

    Args:
        scenario, folder: of the run.
        laws: labels of the controller's laws, which the recording refers to by index.
        wall_s: how long it took.
        figures: draw them and write report.html.
        outside: how it ended as seen from outside the sides, which may not have lived to say.
    """
    signals = merge(folder, scenario.T_s, laws)
    with np.load(folder / "timing.npz") as file:
        timing = dict(file)
    logs = sorted(folder.glob("events_*.jsonl"))
    log = read_log(*logs)
    faults, injected, one_clock = {}, {}, True
    for path in sorted(folder.glob("link_*.json")):
        content = json.loads(path.read_text())
        faults[content["side"]] = {k: v for k, v in content["faults"].items() if v}
        one_clock &= content["one_clock"]
        if "injected" in content:
            injected[content["side"]] = content["injected"]
        path.unlink()
    for path in folder.glob("desk_*.json"):  # of a side that was killed
        path.unlink()
    outcome = worst(log, outside)
    (folder / "events.jsonl").write_text("".join(json.dumps(e) + "\n" for e in log), "utf-8")
    for path in logs:
        path.unlink()
    summary = summarise(scenario, signals, timing, log, outcome, faults, wall_s, one_clock)
    if injected:
        summary["injected"] = injected
    (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", "utf-8")
    if figures and len(signals["tick"]):
        # a second of imports, which the sides' processes do without
        from gfm_hil.figures import draw_run
        from gfm_hil.report import write_report

        pictures = draw_run(folder, scenario, signals, timing, summary, laws)
        write_report(folder, scenario, summary, pictures)
    return Run(folder, summary, signals)
