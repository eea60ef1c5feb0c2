"""What the scope's server costs: a run that records at 10 kHz, one page that takes every picture.

The run is played back into its recording at the pace of the clock, so that nothing but the server
is measured; the server is the one that `gfmhil scope` starts, a process of its own. Its processor
time is the kernel's own count, over the seconds in which the page looks on.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
from websockets.asyncio.client import connect

from gfm_hil.engine.inproc import compile_loop, run_inproc
from gfm_hil.engine.setup import make_bench
from gfm_hil.engine.timeline import Timeline
from gfm_hil.recording.parts import RolePart
from gfm_hil.scenario import check_scenario, scenario_toml

TRACES = ("p", "q", "V", "omega_u", "v_dc")
BINS = 900  # as a page on a desk asks for
T_S = 1e-4


def record(folder: Path, seconds: float) -> tuple[RolePart, RolePart]:
    """A run's recording of which no tick is done yet, though all are there."""
    content = {"title": "benchmark", "duration": seconds, "T_s": T_S, "link": {"type": "inproc"}}
    content["plant"] = {"sensors": {"noise_std": {"p": 5e-4, "q": 5e-4, "V": 1e-4}}}
    scenario = check_scenario(content, "benchmark")
    (folder / "scenario.toml").write_text(scenario_toml(scenario), encoding="utf-8")
    plant, controller = (
        RolePart.create(folder, s, scenario.ticks) for s in ("plant", "controller")
    )
    bench = make_bench(scenario)
    compile_loop([bench])
    timeline = Timeline(bench, folder / "events_both.jsonl", ("plant", "controller"))
    run_inproc([bench], [plant], [controller], [timeline], lambda ticks: True)
    timeline.close()
    deadlines = np.arange(scenario.ticks) * round(T_S * 1e9)
    for column, after in enumerate((0, 2_000, 4_000, 30_000)):
        plant.times[:, column] = deadlines + after
    plant.progress[0] = controller.progress[0] = 0
    return plant, controller


def play(parts: tuple[RolePart, RolePart], over: threading.Event) -> None:
    """Let ticks be done at the pace of the clock."""
    began = time.monotonic()
    while not over.wait(1e-3):
        done = min(len(parts[0].signals), round((time.monotonic() - began) / T_S))
        for part in parts:
            part.progress[0] = done


def processor_s(pid: int) -> float:
    """Processor time that a process has had so far, s."""
    fields = Path(f"/proc/{pid}/stat").read_text("ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


async def look(address: str, pid: int, span: float, seconds: float) -> dict[str, float]:
    """Take every picture for a while; what that came to."""
    async with connect(address, compression=None) as socket:
        message: dict[str, Any] = {"kind": "look", "id": 1, "channels": list(TRACES)}
        message |= {"bins": BINS, "mode": "roll", "span": span}
        await socket.send(json.dumps(message))
        frames = size = 0
        began = before = 0.0
        while not began or time.monotonic() - began < seconds:
            frame = await socket.recv()
            if not began and frames >= 10:  # it has come into its stride
                began, before, frames, size = time.monotonic(), processor_s(pid), 0, 0
            if isinstance(frame, bytes):
                frames, size = frames + 1, size + len(frame)
        took = time.monotonic() - began
        return {
            "span_s": span,
            "frames_per_s": round(frames / took, 2),
            "kB_per_frame": round(size / frames / 1e3, 1),
            "core_pct": round(100 * (processor_s(pid) - before) / took, 2),
        }


def measure(spans: list[float], seconds: float) -> list[dict[str, float]]:
    """One row a length of the window."""
    rows = []
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        parts = record(folder, max(spans) + len(spans) * (seconds + 4.0))
        command = [sys.executable, "-m", "gfm_hil", "scope", str(folder), "--port", "0"]
        server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        over = threading.Event()
        try:
            assert server.stdout is not None
            found = re.search(r"http://\S+", server.stdout.readline())
            assert found is not None
            address = found[0].replace("http", "ws") + "socket"
            player = threading.Thread(target=play, args=(parts, over))
            player.start()
            time.sleep(max(spans))  # windows are full
            for span in spans:
                rows.append(asyncio.run(look(address, server.pid, span, seconds)))
        finally:
            over.set()
            server.terminate()
            server.wait()
        player.join()
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--spans", default="0.1,2,20", help="lengths of the window, s")
    parser.add_argument("--seconds", type=float, default=10.0, help="how long to look at each")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = measure([float(text) for text in options.spans.split(",")], options.seconds)
    if options.json:
        print(json.dumps(rows))
        return
    for row in rows:
        print(
            f"window {row['span_s']:g} s: {row['frames_per_s']:.1f} frames/s of "
            f"{row['kB_per_frame']:.1f} kB, {row['core_pct']:.1f} % of a core"
        )


if __name__ == "__main__":
    main()
