"""A whole run: one process or two, watched, and a run folder in the end, however it ended."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.bench import make_bench
from gfm_hil.errors import UserError
from gfm_hil.figures import draw_run
from gfm_hil.inproc import compile_loop, run_inproc
from gfm_hil.recording import Part, merge
from gfm_hil.report import write_report
from gfm_hil.scenario import Scenario
from gfm_hil.side import compile_side
from gfm_hil.summary import summarise
from gfm_hil.timeline import Outcome, Timeline, read_log, worst
from gfm_hil.toml_out import scenario_toml

#: told (ticks done, misses so far); may be called a few times a second
Progress = Callable[[int, int], None]

SIDES = ("controller", "plant")
_GRACE_S = 5.0  # after one side ended, how long the other may take


@dataclass(frozen=True)
class Run:
    """A finished run: its folder, the content of summary.json, and all signals."""

    folder: Path
    summary: dict[str, Any]
    signals: dict[str, np.ndarray]


def run_scenario(
    scenario: Scenario,
    folder: Path,
    progress: Progress = lambda ticks, misses: None,
    notice: Callable[[str], None] = lambda text: None,
    figures: bool = True,
) -> Run:
    """Run a scenario and leave a run folder.

    Args:
        scenario: checked, from ``load_scenario``.
        folder: where to write; must not hold a run already.
        progress: told how far the run is.
        notice: told what a person should know while waiting.
        figures: draw the figures and write report.html.

    Raises:
        UserError: the folder is in use, no operating point, an endpoint that is occupied.
    """
    if (folder / "summary.json").exists():
        raise UserError(f"{folder}: holds a run already; choose another --out")
    bench = make_bench(scenario)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scenario.toml").write_text(scenario_toml(scenario), encoding="utf-8")
    begin = time.monotonic()
    with Interrupt() as interrupt:
        if scenario.link.type == "inproc":
            parts = {s: Part.create(folder, s, scenario.ticks) for s in SIDES}
            timeline = Timeline(bench, folder / "events_both.jsonl", SIDES)
            notice("compiling the loop (once a machine) …")
            compile_loop(bench, parts["plant"], parts["controller"])
            begin = time.monotonic()

            def go_on(ticks: int) -> bool:
                progress(ticks, 0)
                return not interrupt.came

            run_inproc(bench, parts["plant"], parts["controller"], timeline, go_on)
            timeline.close()
        else:
            begin = _run_processes(scenario, folder, progress, notice, interrupt)
    return finish(scenario, folder, bench.controller.labels, time.monotonic() - begin, figures)


def finish(
    scenario: Scenario, folder: Path, laws: list[str], wall_s: float, figures: bool = True
) -> Run:
    """Turn the parts that the sides left in ``folder`` into the files of a run."""
    signals = merge(folder, scenario.T_s, laws)
    with np.load(folder / "timing.npz") as file:
        timing = dict(file)
    logs = sorted(folder.glob("events_*.jsonl"))
    log = read_log(*logs)
    faults = {}
    for path in sorted(folder.glob("link_*.json")):
        content = json.loads(path.read_text())
        faults[content["side"]] = {k: v for k, v in content["faults"].items() if v}
        path.unlink()
    outcome = worst(log) or Outcome("safe", "both sides ended without a word", len(signals["tick"]))
    (folder / "events.jsonl").write_text("".join(json.dumps(e) + "\n" for e in log), "utf-8")
    for path in logs:
        path.unlink()
    summary = summarise(scenario, signals, timing, log, outcome, faults, wall_s)
    (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", "utf-8")
    if figures and len(signals["tick"]):
        pictures = draw_run(folder, scenario, signals, timing, summary, laws)
        write_report(folder, scenario, summary, pictures)
    return Run(folder, summary, signals)


class Interrupt:
    """Ctrl-C as a flag: the first one ends the run in order, a second one as usual."""

    def __init__(self) -> None:
        self.came = False

    def __enter__(self) -> Interrupt:
        with contextlib.suppress(ValueError):  # not in the main thread: nothing to catch
            self._before = signal.signal(signal.SIGINT, self._note)
        return self

    def _note(self, number: int, frame: Any) -> None:
        if self.came:
            raise KeyboardInterrupt
        self.came = True

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(ValueError, AttributeError):
            signal.signal(signal.SIGINT, self._before)


def _run_processes(
    scenario: Scenario,
    folder: Path,
    progress: Progress,
    notice: Callable[[str], None],
    interrupt: Interrupt,
) -> float:
    """Start both sides as processes, watch them to their end; returns when they began."""
    with contextlib.ExitStack() as stack:
        endpoint = scenario.link.endpoint
        if endpoint is None:  # a Unix socket's path may hold 107 bytes, so not the run folder
            place = stack.enter_context(tempfile.TemporaryDirectory(prefix="gfmhil-"))
            endpoint = f"ipc://{place}/link"
        _compile_once(scenario, notice)
        notice("starting controller and plant …")
        sides = {side: _start(side, folder, endpoint) for side in SIDES}
        try:
            began = _watch(sides, folder, progress, interrupt)
        finally:
            for process in sides.values():
                if process.poll() is None:
                    process.kill()
                    process.wait()
        errors = [
            (folder / f"{side}.log").read_text("utf-8").strip()
            for side, process in sides.items()
            if process.returncode == 2
        ]
        if errors:
            raise UserError("\n".join(errors))
    for side, process in sides.items():
        said = (folder / f"{side}.log").read_text("utf-8")
        if process.returncode < 0:
            name = signal.Signals(-process.returncode).name
            notice(f"the {side} was ended by {name}; what it recorded is kept")
        elif process.returncode not in (0, 3, 130):
            notice(f"the {side} failed, see {folder / f'{side}.log'}")
        if not said:
            (folder / f"{side}.log").unlink()
    return began


def _compile_once(scenario: Scenario, notice: Callable[[str], None]) -> None:
    """Fill numba's cache here, so that two processes do not compile the same at the same time."""
    notice("compiling the kernels (once a machine) …")
    bench = make_bench(scenario)
    with tempfile.TemporaryDirectory(prefix="gfmhil-") as place:
        for side in SIDES:
            compile_side(bench, Part.create(Path(place), side, 1))


def _start(side: str, folder: Path, endpoint: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "gfm_hil", side, str(folder / "scenario.toml")]
    command += ["--endpoint", endpoint, "--out", str(folder), "--part", "--quiet"]
    with (folder / f"{side}.log").open("wb") as log:
        # own session: Ctrl-C reaches the sides through us, once
        return subprocess.Popen(
            command, stdout=log, stderr=log, start_new_session=True, env={**os.environ}
        )


def _watch(
    sides: dict[str, subprocess.Popen[bytes]],
    folder: Path,
    progress: Progress,
    interrupt: Interrupt,
) -> float:
    part, told, since = None, False, None
    began = time.monotonic()
    while True:
        time.sleep(0.05)
        ended = [p for p in sides.values() if p.poll() is not None]
        part = part or Part.open(folder, "plant")
        if part is not None and len(part.progress):
            if int(part.progress[0]) == 0:
                began = time.monotonic()
            progress(int(part.progress[0]), int(part.progress[1]))
        if len(ended) == len(sides):
            return began
        if interrupt.came and not told:
            for process in sides.values():
                if process.poll() is None:
                    process.send_signal(signal.SIGINT)
            told = True
        if ended or told:
            since = since or time.monotonic()
            # a side that failed before the handshake leaves the other waiting for nobody
            if ended and ended[0].returncode in (1, 2):
                since = 0.0
            if time.monotonic() - since > _GRACE_S:
                return began
